"""Reading CSV, plain or compressed by gzip, as text columns in chunks; every problem names its line."""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io.names import check_regular, nearest
from imgcal.messages import shorten
from imgcal.types import Range

Numbers = NDArray[np.float64]

CHUNK = 1000  # rows: larger ones leave the processor cache and wake the garbage collector, half as fast
GZIP_MAGIC = b"\x1f\x8b"

MOST_ROWS = 10_000_000
LONGEST_LINE = 2**20  # characters
BOMB = 2**24, 100  # bytes, and times its compressed size: what unpacks to more is no table of measurements


@dataclass(frozen=True)
class Chunk:
    """Consecutive rows of a CSV file as text columns of equal length."""

    path: Path
    first_row: int  # data rows before this chunk
    columns: dict[str, tuple[str, ...]]
    content: bytes | None = None  # of the file, where there is none at `path`

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def fail(self, row: int, problem: str) -> NoReturn:
        """Raise the error of a row of this chunk."""
        fail_row(self.path, self.first_row + row, problem, self.content)

    def numbers(self, name: str, plausible: Range, expected: str, whole: bool = False) -> Numbers:
        """Convert a column to numbers.

        Args:
            name: of the column.
            plausible: which values are acceptable.
            expected: says so in words.
            whole: only whole numbers.

        Raises:
            InputError: with the line of the first value that is not.
        """
        column = self.columns[name]
        try:
            values = np.fromiter(map(float, column), dtype=np.float64, count=len(column))
        except ValueError:
            row = next(i for i, text in enumerate(column) if not _is_float(text))
            self.fail(row, f"{name}: found {shorten(column[row])!r}, expected {expected}")
        wrong = ~((values >= plausible.low) & (values <= plausible.high))
        if whole:
            wrong |= values != np.trunc(values)
        if wrong.any():
            row = int(wrong.argmax())
            self.fail(row, f"{name}: found {shorten(column[row])}, expected {expected}")
        return values


def read_chunks(
    path: Path, required: Sequence[str], optional: Sequence[str], content: bytes | None = None
) -> Iterator[Chunk]:
    """Read a CSV file with a header; blank lines are skipped.

    Args:
        path: the file, with or without gzip compression.
        required: columns that must be there, in any order.
        optional: columns that may be there.
        content: what the file holds, where there is none: `path` is then only what errors begin with.

    Yields:
        Chunks of at most `CHUNK` rows; none when the file has only a header.

    Raises:
        InputError: unreadable, truncated or binary file, wrong header, a row of another length.
    """
    with _Text(path, content) as rows:
        header = [cell.strip() for cell in next(rows, [])]
        _check_header(path, header, required, optional)
        for first in itertools.count(0, CHUNK):
            chunk = list(itertools.islice(rows, CHUNK))
            if not chunk:
                return
            lengths = np.fromiter(map(len, chunk), dtype=np.int64, count=len(chunk))
            if (lengths != len(header)).any():
                row = int((lengths != len(header)).argmax())
                problem = f"found {lengths[row]} cells, expected {len(header)}: {','.join(header)}"
                fail_row(path, first + row, problem, content)
            yield Chunk(path, first, dict(zip(header, zip(*chunk, strict=True), strict=True)), content)


class _Text:
    """Context manager: the non-blank rows of a CSV file; every reading failure becomes an `InputError`."""

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        self.path, self.content = path, content

    def __enter__(self) -> Iterator[list[str]]:
        self.file = self._open_file()
        magic = self.file.read(2)
        self.file.seek(0)
        self.binary = gzip.GzipFile(fileobj=self.file) if magic == GZIP_MAGIC else self.file
        # utf-8-sig: spreadsheets put a byte order mark in front of the header.
        self.text = io.TextIOWrapper(self.binary, encoding="utf-8-sig", newline="")
        self.reader = csv.reader(self._lines(), strict=True)
        return filter(None, self.reader)

    def _open_file(self) -> BinaryIO:
        if self.content is not None:
            return io.BytesIO(self.content)
        check_regular(self.path)
        try:
            return open(self.path, "rb")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror or error}") from error

    def _lines(self) -> Iterator[str]:
        for number in itertools.count(1):
            line = self.text.readline(LONGEST_LINE)
            if not line:
                return
            if len(line) == LONGEST_LINE and not line.endswith("\n"):
                raise csv.Error(f"a line of more than {LONGEST_LINE:,} characters")
            if number % CHUNK == 0:
                self._check_size(number)
            yield line

    def _check_size(self, lines: int) -> None:
        """Refuse a file that is too long or unpacks to too much; `lines` have been read, blank ones included."""
        if lines > MOST_ROWS:
            raise InputError(f"{self.path}: found more than {MOST_ROWS:,} rows, expected fewer: split the file")
        packed, unpacked = max(self.file.tell(), 1), self.binary.tell()
        least, times = BOMB
        if unpacked > max(least, times * packed):
            raise InputError(
                f"{self.path}: found {unpacked:,} bytes and more, compressed to {packed:,}, expected at most {times} "
                "times as many"
            )

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.file.close()
        match error:
            case UnicodeDecodeError():
                problem = "not a text file in UTF-8"
            case EOFError():
                problem = "compressed file is truncated"
            case gzip.BadGzipFile() | zlib.error():
                problem = f"compressed file is damaged: {error}"
            case csv.Error():
                problem = f"line {self.reader.line_num}: not valid CSV: {error}"
            case _:
                return
        raise InputError(f"{self.path}: {problem}, expected CSV with a header line") from error


def _check_header(path: Path, header: list[str], required: Sequence[str], optional: Sequence[str]) -> None:
    expected = f"expected the columns {','.join(required)}" + (f", optional {', '.join(optional)}" if optional else "")
    if not header:
        raise InputError(f"{path}: found an empty file, {expected}")
    known = (*required, *optional)
    if len(header) == 1:
        for separator, what in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
            if header[0].split(separator)[0].strip() in known and separator in header[0]:
                raise InputError(f"{path}: found {what} between the columns, expected commas (and decimal points)")
    if all(_is_float(name) for name in header):
        raise InputError(f"{path}: found no header line; {expected}")
    for name in header:
        if name not in known:
            raise InputError(f"{path}: unknown column {shorten(name)!r}{nearest(name, known)}; {expected}")
        if header.count(name) > 1:
            raise InputError(f"{path}: found the column {name} more than once, {expected}")
    missing = [name for name in required if name not in header]
    if missing:
        raise InputError(f"{path}: found no column {', '.join(missing)}; {expected}")


def fail_row(path: Path, row: int, problem: str, content: bytes | None = None) -> NoReturn:
    """Raise the error of a data row; blank lines and quoted line breaks shift its line, found by reading again."""
    text = _Text(path, content)
    with text as rows:
        next(itertools.islice(rows, row + 1, None))
        line = text.reader.line_num
    raise InputError(f"{path}: line {line}: {problem}")


def _is_float(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
