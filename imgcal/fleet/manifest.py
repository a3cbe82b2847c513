"""The table of captures that a fleet sends: one row each, read in batches, however long it is."""

from __future__ import annotations

import datetime
import math
import posixpath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imgcal.errors import InputError
from imgcal.messages import listed, quoted

REQUIRED = ("capture",)
PARQUET = (".parquet", ".pq")
KNOWN = ("capture", "rig", "object", "device", "time")


@dataclass(frozen=True)
class Item:
    """A capture to recalibrate from: paths, or URLs that fsspec knows."""

    row: int  # in the manifest, from 0
    capture: str  # folder of frames, or table of blobs
    rig: str
    object: str
    device: str  # "" = not said
    time: float | None  # seconds since 1970
    given: tuple[tuple[str, float], ...] = ()  # further columns of numbers, temperature for example
    fault: str | None = None  # why this row cannot be used


@dataclass(frozen=True)
class Manifest:
    """A CSV or Parquet file with a column `capture`, and `rig`, `object`, `device`, `time` and numbers where known."""

    url: str
    rig: str | None = None  # for rows that name none
    object: str | None = None

    def count(self) -> int | None:
        """Count rows where that costs next to nothing; None elsewhere."""
        import pyarrow.parquet

        if self.url.endswith(PARQUET):
            with opened(self.url) as file:
                return int(pyarrow.parquet.ParquetFile(file).metadata.num_rows)
        if "://" in self.url:
            return None
        with opened(self.url) as file:
            lines = sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))
        return max(lines - 1, 0)

    def check(self) -> None:
        """Look at the first rows: what is wrong with all of them is told before anything is started.

        Raises:
            InputError: the file cannot be read, lacks a column, or has no rows.
        """
        if next(self.batches(1), None) is None:
            raise InputError(f"{self.url}: found no rows, expected captures")

    def batches(self, size: int) -> Iterator[list[Item]]:
        """Read items, some at a time.

        Raises:
            InputError: the file cannot be read, or lacks a column. A row that cannot be used is an item that says so.
        """
        row = 0
        for table in self._tables():
            lacking = [name for name in REQUIRED if name not in table.column_names]
            if lacking:
                raise InputError(
                    f"{self.url}: found columns {listed(table.column_names)}; expected {', '.join(lacking)} among them"
                )
            columns = table.to_pydict()
            items = [
                self._item(row + i, {name: column[i] for name, column in columns.items()})
                for i in range(table.num_rows)
            ]
            row += table.num_rows
            for first in range(0, len(items), size):
                yield items[first : first + size]

    def _tables(self) -> Iterator[Any]:
        import pyarrow as pa
        import pyarrow.csv
        import pyarrow.parquet

        try:
            with opened(self.url) as file:
                if self.url.endswith(PARQUET):
                    batches: Any = pa.parquet.ParquetFile(file).iter_batches(4096)
                else:
                    as_text = {name: pa.string() for name in KNOWN}
                    batches = pa.csv.open_csv(
                        file,
                        read_options=pa.csv.ReadOptions(use_threads=False),
                        convert_options=pa.csv.ConvertOptions(column_types=as_text, strings_can_be_null=True),
                    )
                yield from batches
        except pa.ArrowInvalid as error:
            kind = "Parquet" if self.url.endswith(PARQUET) else "CSV"
            raise InputError(f"{self.url}: no {kind} table: {quoted(str(error))}") from error

    def _item(self, row: int, values: dict[str, Any]) -> Item:
        text = {name: str(values[name]) if values.get(name) else None for name in KNOWN}
        named = {
            "capture": text["capture"] and self._beside(text["capture"]),
            "rig": self._beside(text["rig"]) if text["rig"] else self.rig,
            "object": self._beside(text["object"]) if text["object"] else self.object,
        }
        lacking = next((name for name, value in named.items() if not value), None)
        fault = (
            f"row {row}: found no {lacking}, expected one in its column, or for all by an option" if lacking else None
        )
        moment = None
        try:
            moment = _seconds(values.get("time"))
        except ValueError as error:
            fault = f"row {row}: {error}"
        given = tuple((n, float(v)) for n, v in values.items() if n not in KNOWN and _is_number(v))
        paths = {name: value or "" for name, value in named.items()}
        return Item(row, paths["capture"], paths["rig"], paths["object"], text["device"] or "", moment, given, fault)

    def _beside(self, path: str) -> str:
        """Take relative paths from the manifest's folder; names of shipped files stay."""
        if "://" in path or posixpath.isabs(path):
            return path
        if "://" in self.url:
            return posixpath.join(posixpath.dirname(self.url), path)
        found = Path(self.url).parent / path
        return str(found) if found.exists() or "/" in path or "." in path else path


def opened(url: str) -> Any:
    """Open a file for reading, wherever it is.

    Raises:
        InputError: it cannot be.
    """
    import fsspec

    try:
        return fsspec.open(url, "rb").open()
    except Exception as error:  # what fsspec's file systems raise is not theirs alone
        raise InputError(f"{url}: cannot be read: {reason_of(error)}") from error


def reason_of(error: BaseException) -> str:
    """Say in a few words what went wrong."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return quoted(" ".join(str(text).split()))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _seconds(value: Any) -> float | None:
    """Seconds since 1970 of a time stamp, an ISO date, or a number."""
    if value is None or value == "":
        return None
    if not isinstance(value, datetime.datetime):
        try:
            return float(value)
        except ValueError:
            pass
        try:
            value = datetime.datetime.fromisoformat(str(value))
        except ValueError as error:
            raise ValueError(
                f"found time {quoted(repr(value))}, expected 2026-01-31T12:00:00 (UTC without an offset) or seconds"
            ) from error
    return (value if value.tzinfo else value.replace(tzinfo=datetime.UTC)).timestamp()


def write_manifest(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write a manifest as CSV."""
    import pyarrow as pa
    import pyarrow.csv

    pa.csv.write_csv(pa.Table.from_pylist(list(rows)), path)
