"""A file to which whole lines are appended; an unfinished line of a killed process is removed on reopening."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

LONGEST = 2**16
"""Bytes of a line, more than any event or pose needs."""


class LineFile:
    """Appends lines of text to a file.

    Each line is written by one system call, so all but the last are whole whatever happens to the process. A last line
    that is incomplete because of a kill or a power failure is removed when the file is opened again. A file that has
    been deleted meanwhile is created again.
    """

    def __init__(self, path: Path) -> None:
        """Open or create the file.

        Raises:
            OSError: it cannot be written.
        """
        self.path = path
        _cut(path)
        self._descriptor: int | None = _open(path)  # None = closed

    @property
    def size(self) -> int | None:
        """Size of the file in bytes; None = closed."""
        return None if self._descriptor is None else os.fstat(self._descriptor).st_size

    def append(self, line: bytes) -> None:
        """Write a line, its end included.

        Raises:
            OSError: nothing of it was written, for example because the disk is full.
        """
        if self._descriptor is None:
            raise OSError(f"{self.path}: closed")
        if not os.fstat(self._descriptor).st_nlink:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            deleted, self._descriptor = self._descriptor, _open(self.path)
            os.close(deleted)
        write_whole(self._descriptor, line, self.path)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)


def _open(path: Path) -> int:
    # Without O_BINARY, Windows would convert line ends.
    return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)


def write_whole(descriptor: int, content: bytes, path: Path) -> None:
    """Write at the current position, all or nothing.

    Args:
        descriptor: of the open file.
        content: what to write.
        path: for the message.

    Raises:
        OSError: the file did not grow, for example because the disk is full.
    """
    size = os.fstat(descriptor).st_size
    written = os.write(descriptor, content)
    if written < len(content):
        os.ftruncate(descriptor, size)
        raise OSError(f"{path}: {written} of {len(content)} bytes could be written")


def create_whole(path: Path, content: bytes) -> BinaryIO:
    """Create a file with this content, and open it without a buffer; nothing is left where that fails.

    Raises:
        OSError: it exists, or cannot be written.
    """
    file = open(path, "x+b", buffering=0)  # noqa: SIM115  # the caller closes it
    try:
        write_whole(file.fileno(), content, path)
    except OSError:
        file.close()
        path.unlink()
        raise
    return file


def _cut(path: Path) -> None:
    """Remove an unfinished line."""
    if not path.exists() or not (size := path.stat().st_size):
        return
    with open(path, "r+b") as file:
        file.seek(max(size - LONGEST, 0))
        end = file.read()
        file.truncate(size - len(end) + end.rfind(b"\n") + 1)
