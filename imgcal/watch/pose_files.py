"""Poses in a file: a table, or lines of JSON."""

from __future__ import annotations

import os
from pathlib import Path

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.watch.poses import COLUMNS, PoseRecord

SUFFIXES = (".csv", ".jsonl")
LONGEST = 2**16  # bytes of a line, more than any pose needs


class PoseFile:
    """Appends poses to a table (.csv) or to lines of JSON (.jsonl).

    Each line is written by one system call. An unfinished line of a killed process is removed when the file is opened
    again.
    """

    def __init__(self, path: Path) -> None:
        """Open or create the file.

        Raises:
            InputError: it cannot be written, has another suffix, or is a table of something else.
        """
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"{path}: expected a name that ends in .csv, .jsonl, .c3d or .trc")
        self._path, self._table = path, path.suffix.lower() == ".csv"
        header = ",".join(COLUMNS)
        try:
            if path.exists() and path.stat().st_size:
                self._check(header)
                _cut(path)
            # Without it, Windows would convert line ends.
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
            self._descriptor: int | None = os.open(path, flags, 0o644)
            if self._table and not os.fstat(self._descriptor).st_size:
                self._append(header)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error

    def send(self, record: PoseRecord) -> None:
        """See `PoseSink`."""
        self._append(record.to_row() if self._table else record.to_json())

    def close(self) -> None:
        """See `PoseSink`."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)

    def _check(self, header: str) -> None:
        with open(self._path, "rb") as file:
            first = file.readline(LONGEST).decode(errors="replace").rstrip("\r\n")
        known = first == header if self._table else first.startswith('{"time": ')
        if not known:
            expected = "the columns of poses" if self._table else "poses, a line of JSON each"
            raise InputError(f"{self._path}: found {shorten(first)!r}, expected a new file or {expected}")

    def _append(self, text: str) -> None:
        if self._descriptor is None:
            raise OSError(f"{self._path}: closed")
        line = text.encode(errors="replace") + b"\n"
        written = os.write(self._descriptor, line)
        if written < len(line):
            os.ftruncate(self._descriptor, os.fstat(self._descriptor).st_size - written)
            raise OSError(f"{self._path}: {written} of {len(line)} bytes could be written")


def _cut(path: Path) -> None:
    """Remove an unfinished line."""
    with open(path, "r+b") as file:
        size = path.stat().st_size
        file.seek(max(size - LONGEST, 0))
        end = file.read()
        file.truncate(size - len(end) + end.rfind(b"\n") + 1)
