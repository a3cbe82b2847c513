"""`events.jsonl`: one line per event; an unfinished line of a killed process is removed on reopening."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from imgcal.errors import InputError
from imgcal.online import Event

MOST_BYTES = 2**26
"""File size at which a new file is started; the previous one is kept as `events.1.jsonl`."""
LONGEST = 2**16  # bytes of a line, more than any event needs


class EventLog:
    """Appends events to a file.

    Each line is written by one system call, so all but the last are whole whatever happens to the process. A last line
    that is incomplete because of a kill or a power failure is removed when the file is opened again.
    """

    def __init__(self, path: Path, most_bytes: int = MOST_BYTES) -> None:
        """Open or create the file.

        Raises:
            InputError: the file cannot be written.
        """
        self.path, self._most = path, most_bytes
        self._descriptor: int | None = None  # None = closed
        try:
            self._cut()
            self._descriptor = self._open_file()
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error

    @property
    def size(self) -> int | None:
        """Size of the file in bytes; None = closed."""
        return None if self._descriptor is None else os.fstat(self._descriptor).st_size

    def append(self, event: Event) -> None:
        """Write an event.

        Raises:
            OSError: nothing of the line was written, for example because the disk is full. Or the line was written, but
                the file, which has become long, could not be renamed.
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
        """Start a new file; if that fails, the old one stays open."""
        aside = self.path.with_name(f"{self.path.stem}.1{self.path.suffix}")
        os.replace(self.path, aside)
        try:
            new = self._open_file()
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

    def _open_file(self) -> int:
        # Without it, Windows would convert line ends.
        return os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)

    def _cut(self) -> None:
        """Remove an unfinished line."""
        if not self.path.exists() or not (size := self.path.stat().st_size):
            return
        with open(self.path, "r+b") as file:
            file.seek(max(size - LONGEST, 0))
            end = file.read()
            file.truncate(size - len(end) + end.rfind(b"\n") + 1)


def forget_after(path: Path, size: int) -> None:
    """Remove the events after the first `size` bytes: their snapshots will be processed again.

    Does nothing if the file is shorter: a new one has been started since.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        if path.is_file() and path.stat().st_size > size >= 0:
            os.truncate(path, size)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
