"""Poses in a file: a table, or lines of JSON."""

from __future__ import annotations

from pathlib import Path

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.watch.line_file import LONGEST, LineFile
from imgcal.watch.poses import COLUMNS, PoseRecord

SUFFIXES = (".csv", ".jsonl")


class PoseFile:
    """Appends poses to a table (.csv) or to lines of JSON (.jsonl); see `LineFile`."""

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
            self._file = LineFile(path)
            if self._table and not self._file.size:
                self._append(header)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error

    def send(self, record: PoseRecord) -> None:
        """See `PoseSink`."""
        self._append(record.to_row() if self._table else record.to_json())

    def close(self) -> None:
        """See `PoseSink`."""
        self._file.close()

    def _check(self, header: str) -> None:
        with open(self._path, "rb") as file:
            first = file.readline(LONGEST).decode(errors="replace").rstrip("\r\n")
        known = first == header if self._table else first.startswith('{"time": ')
        if not known:
            expected = "the columns of poses" if self._table else "poses, a line of JSON each"
            raise InputError(f"{self._path}: found {shorten(first)!r}, expected a new file or {expected}")

    def _append(self, text: str) -> None:
        self._file.append(text.encode(errors="replace") + b"\n")
