"""The table of captures that a fleet sends: one row each, read in batches, however long it is."""

from __future__ import annotations

import contextlib
import csv
import datetime
import math
import posixpath
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from imgcal.errors import InputError
from imgcal.io import is_shipped
from imgcal.messages import list_names, quote
from imgcal.types import limits

REQUIRED = ("capture",)
PARQUET = (".parquet", ".pq")
KNOWN = ("capture", "rig", "object", "device", "time")
HOURS = "hours"
"""Column of the manifest: since the factory calibration. With it, rates of drift are learned."""
EARLIEST, LATEST = -2_208_988_800.0, 7_258_118_400.0  # s since 1970: the years 1900 and 2200
PROBLEMS = (
    (r"Empty CSV file|file size is 0 bytes", "found an empty file"),
    (r"Row #(\d+): Expected (\d+) columns, got (\d+)", r"found \3 cells in line \1, expected \2 as in the first line"),
    (r"Row #(\d+):.*invalid UTF8", r"found bytes in line \1 that are not UTF-8 text"),
    (r"invalid UTF8", "found bytes that are not UTF-8 text"),
    (r"straddl", "found a line of a megabyte or more"),
    (r"magic bytes not found", "found another kind of file, or the end is missing"),
)
"""What Arrow says, and what that means."""


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
        """Count rows if that is cheap; None if not."""
        import pyarrow.parquet

        if self.url.endswith(PARQUET):
            with self._read() as file:
                return int(pyarrow.parquet.ParquetFile(file).metadata.num_rows)
        if "://" in self.url:
            return None
        with open_file(self.url) as file:
            lines = sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))
        return max(lines - 1, 0)

    def check(self) -> None:
        """Check the first rows, so that an error common to all is reported before any work starts.

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
                    f"{self.url}: found columns {list_names(table.column_names)}; expected {', '.join(lacking)} "
                    "among them"
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

        # A cell that is no number must not end a fleet: all cells of a CSV file are text here, and read one by one.
        as_text = {} if self.url.endswith(PARQUET) else dict.fromkeys(self._header(), pa.string())
        with self._read() as file:
            if self.url.endswith(PARQUET):
                batches: Any = pa.parquet.ParquetFile(file).iter_batches(4096)
            else:
                batches = pa.csv.open_csv(
                    file,
                    read_options=pa.csv.ReadOptions(use_threads=False),
                    convert_options=pa.csv.ConvertOptions(
                        column_types=as_text, null_values=[""], strings_can_be_null=True
                    ),
                )
            yield from batches

    def _header(self) -> list[str]:
        with self._read() as file:
            line = file.read(1 << 20).partition(b"\n")[0].decode("utf-8-sig", errors="replace")
        return next(csv.reader([line.rstrip("\r")]), [])

    @contextlib.contextmanager
    def _read(self) -> Iterator[Any]:
        """Open the file; Arrow's errors become an `InputError`."""
        import pyarrow as pa

        with open_file(self.url) as file:
            try:
                yield file
            except (pa.ArrowException, OSError, csv.Error) as error:
                kind = "Parquet" if self.url.endswith(PARQUET) else "CSV"
                raise InputError(f"{self.url}: {_problem(str(error))}, expected a {kind} table") from error

    def _item(self, row: int, values: dict[str, Any]) -> Item:
        given = tuple((n, number) for n, v in values.items() if n not in KNOWN and (number := _number(v)) is not None)
        faults = [
            f"found {name} {quote(repr(values[name]))}, expected text"
            for name in KNOWN[:-1]
            if not isinstance(values.get(name), str | int | float | None)
        ]
        text = {name: str(values[name]) if values.get(name) not in (None, "") else None for name in KNOWN[:-1]}
        named = {
            "capture": text["capture"] and _base_folder(self.url, text["capture"]),
            "rig": _base_folder(self.url, text["rig"]) if text["rig"] else self.rig,
            "object": _base_folder(self.url, text["object"]) if text["object"] else self.object,
        }
        faults += [
            f"found no {name}, expected one in its column{'' if name == 'capture' else f', or --{name} for all rows'}"
            for name, value in named.items()
            if not value
        ]
        moment = None
        try:
            moment = _seconds(values.get("time"))
        except ValueError as error:
            faults.append(str(error))
        hours = dict(given).get(HOURS, 0.0)
        if not limits.AGE.low <= hours <= limits.AGE.high:
            faults.append(f"{HOURS}: found {hours:g}, expected {limits.AGE}")
        paths = {name: value or "" for name, value in named.items()}
        fault = f"row {row}: {faults[0]}" if faults else None
        return Item(row, paths["capture"], paths["rig"], paths["object"], text["device"] or "", moment, given, fault)


@lru_cache(maxsize=4096)
def _base_folder(url: str, path: str) -> str:
    """Take relative paths from the folder of the manifest at an address; names of shipped files stay."""
    if "://" in path or posixpath.isabs(path):
        return path
    if "://" in url:
        return path if is_shipped(path) else posixpath.join(posixpath.dirname(url), path)
    found = Path(url).parent / path
    try:
        is_file = "/" in path or "." in path or found.exists()
    except (OSError, ValueError):  # too long for a name, or no text: opening it reports the error
        is_file = True
    return str(found) if is_file else path


def open_file(url: str) -> Any:
    """Open a local or remote file for reading.

    Raises:
        InputError: it cannot be.
    """
    import fsspec

    try:
        return fsspec.open(url, "rb").open()
    except Exception as error:  # what fsspec's file systems raise is not theirs alone
        raise InputError(f"{url}: cannot be read: {short_reason(error)}") from error


def short_reason(error: BaseException) -> str:
    """Shorten an error to a few words."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return quote(" ".join(str(text).split()))


def _problem(text: str) -> str:
    """Put Arrow's complaint about a table into plain words."""
    for pattern, meaning in PROBLEMS:
        if match := re.search(pattern, text, re.DOTALL):
            return match.expand(meaning)
    return "found something else, or damage"


def _number(value: Any) -> float | None:
    """The finite number that a cell holds; None where it holds something else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _seconds(value: Any) -> float | None:
    """Seconds since 1970 of a time stamp, an ISO date, or a number.

    Raises:
        ValueError: it is none of these, or not in the years 1900 to 2200.
    """
    if value is None or value == "":
        return None
    moment = value
    try:
        if not isinstance(value, datetime.datetime):
            try:
                moment = float(value)
            except (TypeError, ValueError):
                moment = datetime.datetime.fromisoformat(str(value))
        if isinstance(moment, datetime.datetime):
            moment = (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()
    except (ValueError, OverflowError) as error:
        raise ValueError(
            f"found time {quote(repr(value))}, expected 2026-01-31T12:00:00 (UTC without an offset) or seconds"
        ) from error
    if not EARLIEST <= moment <= LATEST:
        raise ValueError(f"found time {quote(str(value))}, expected seconds since 1970, in the years 1900 to 2200")
    return float(moment)


def write_manifest(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write a manifest as CSV."""
    import pyarrow as pa
    import pyarrow.csv

    pa.csv.write_csv(pa.Table.from_pylist(list(rows)), path)
