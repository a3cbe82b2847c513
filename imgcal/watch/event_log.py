"""`events.jsonl`: one line per event."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from pathlib import Path

from imgcal.errors import InputError
from imgcal.online import Event
from imgcal.watch.line_file import LineFile

MOST_BYTES = 2**26
"""File size at which a new file is started; the previous one is kept as `events.1.jsonl`."""
MOST_WAITING = 10_000
"""Maximum number of unwritten events; the oldest is dropped beyond that."""


class EventLog:
    """Appends events to a file; see `LineFile`. Those that could not be written wait for the next attempt."""

    def __init__(self, path: Path, most_bytes: int = MOST_BYTES) -> None:
        """Open or create the file.

        Raises:
            InputError: the file cannot be written.
        """
        self.path, self._most = path, most_bytes
        try:
            self._file = LineFile(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._waiting: deque[bytes] = deque()
        self._lost = 0  # events that waited until there were too many

    @property
    def unwritten(self) -> int:
        """Number of events that are not in the file."""
        return self._lost + len(self._waiting)

    @property
    def size(self) -> int | None:
        """Size of the file in bytes; None = closed."""
        return self._file.size

    def add(self, event: Event) -> None:
        """Take an event, for the next `write`."""
        self._waiting.append(event.to_json().encode(errors="replace") + b"\n")
        if len(self._waiting) > MOST_WAITING:
            self._waiting.popleft()
            self._lost += 1

    def write(self) -> None:
        """Write the events that wait.

        Raises:
            OSError: some could not be written, for example because the disk is full, and still wait. Or they were
                written, but the file, which has become long, could not be renamed.
        """
        while self._waiting:
            problem = self._append(self._waiting[0])
            self._waiting.popleft()
            if problem is not None:
                raise problem

    def _append(self, line: bytes) -> OSError | None:
        """Append a line; return why the long file before it could not be put aside, None = it could.

        Raises:
            OSError: nothing of the line was written.
        """
        problem: OSError | None = None
        size = self._file.size
        if size and size + len(line) > self._most:
            try:
                self._put_aside()
            except OSError as error:
                problem = error
        self._file.append(line)
        return problem

    def _put_aside(self) -> None:
        """Start a new file; if that fails, the old one stays open."""
        aside = self.path.with_name(f"{self.path.stem}.1{self.path.suffix}")
        os.replace(self.path, aside)
        try:
            new = LineFile(self.path)
        except OSError:
            with contextlib.suppress(OSError):
                os.replace(aside, self.path)
            raise
        self._file.close()
        self._file = new

    def close(self) -> None:
        """Close the file."""
        self._file.close()


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
