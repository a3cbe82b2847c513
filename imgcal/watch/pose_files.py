"""Poses in a file: a table, or lines of JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.watch.line_file import LONGEST, LineFile
from imgcal.watch.poses import COLUMNS, PoseRecord, PoseSink

SUFFIXES = (".csv", ".jsonl")


class PoseFile(PoseSink):
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

    @property
    def table(self) -> tuple[str, int] | None:
        """See `PoseSink`."""
        size = self._file.size
        return None if size is None else (str(self._path.resolve()), size)

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


def forget_rows(path: Path, size: int, snapshot: int) -> None:
    """Remove the rows of later snapshots than one with this number: those snapshots will be processed again.

    Args:
        path: table of poses.
        size: bytes that are kept, as other runs may have written them.
        snapshot: number of the last snapshot to keep.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        if not path.is_file() or path.stat().st_size <= size:
            return
        with open(path, "rb") as file:
            file.seek(max(size - 1, 0))
            if size and file.read(1) != b"\n":  # another file
                return
            for line in file:
                number = _snapshot_of(line)
                if number is None or number > snapshot:
                    break
                size += len(line)
        os.truncate(path, size)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _snapshot_of(line: bytes) -> int | None:
    """Number of the snapshot of a row, or of a line of JSON; None = it is neither."""
    try:
        return int(json.loads(line)["snapshot"] if line.startswith(b"{") else line.split(b",")[1])
    except (ValueError, IndexError, KeyError, TypeError):
        return None
