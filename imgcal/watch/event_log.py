"""`events.jsonl`: one line an event; what a killed process left of a line is cut off when the file is opened again."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from imgcal.errors import InputError
from imgcal.online import Event

MOST_BYTES = 2**26
"""Size from which on events go to a new file; the one before is kept, `events.1.jsonl`."""
LONGEST = 2**16  # bytes of a line, more than any event takes


class EventLog:
    """Appends events to a file.

    A line is written by one call of the system, so all but the last are whole whatever happens to the process. What a
    kill in the midst of that call, or a power failure, left of the last is cut off when the file is opened again.
    """

    def __init__(self, path: Path, most_bytes: int = MOST_BYTES) -> None:
        """Open or make the file.

        Raises:
            InputError: it cannot be written.
        """
        self.path, self._most = path, most_bytes
        self._descriptor: int | None = None  # None = closed
        try:
            self._cut()
            self._descriptor = self._opened()
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error

    @property
    def size(self) -> int | None:
        """Bytes of the file; None = closed."""
        return None if self._descriptor is None else os.fstat(self._descriptor).st_size

    def append(self, event: Event) -> None:
        """Write an event.

        Raises:
            OSError: the disk is full, for example; nothing of the line is there then. Or the line is there, and the
                file, which has become long, could not be put aside.
        """
        if self._descriptor is None:
            raise OSError(f"{self.path}: closed")
        line = event.to_json().encode(errors="replace") + b"\n"
        size = os.fstat(self._descriptor).st_size
        problem: OSError | None = None
        if size and size + len(line) > self._most:
            try:
                self._put_aside()
                size = 0
            except OSError as error:
                problem = error
        written = os.write(self._descriptor, line)
        if written < len(line):
            os.ftruncate(self._descriptor, size)
            raise OSError(f"{self.path}: {written} of {len(line)} bytes could be written")
        if problem is not None:
            raise problem

    def _put_aside(self) -> None:
        """Begin a new file; where that fails, the old one stays open."""
        aside = self.path.with_name(f"{self.path.stem}.1{self.path.suffix}")
        os.replace(self.path, aside)
        try:
            new = self._opened()
        except OSError:
            with contextlib.suppress(OSError):
                os.replace(aside, self.path)
            raise
        assert self._descriptor is not None
        old, self._descriptor = self._descriptor, new
        os.close(old)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)

    def _opened(self) -> int:
        # Windows would write line ends of its own.
        return os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)

    def _cut(self) -> None:
        """Cut off an unfinished line."""
        if not self.path.exists() or not (size := self.path.stat().st_size):
            return
        with open(self.path, "r+b") as file:
            file.seek(max(size - LONGEST, 0))
            end = file.read()
            file.truncate(size - len(end) + end.rfind(b"\n") + 1)


def forget_after(path: Path, size: int) -> None:
    """Cut off the events that came after the file had a size: those of snapshots that will be worked on once more.

    Nothing happens where the file is shorter: since then, a new one has been begun.

    Raises:
        InputError: it cannot be written.
    """
    try:
        if path.is_file() and path.stat().st_size > size >= 0:
            os.truncate(path, size)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
