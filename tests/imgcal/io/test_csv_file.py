"""Reading tables: against Python's csv, in any chunk; every problem with its line."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io.csv_file import CHUNK, LONGEST_LINE, read_chunks
from imgcal.types import Range


def table(rows: int, seed: int = 0) -> list[list[str]]:
    random = np.random.default_rng(seed)
    numbers = zip(random.normal(size=rows).tolist(), random.integers(0, 99, rows).tolist(), strict=True)
    return [[repr(x), str(n), f'name "{n}", {n}'] for x, n in numbers]


def write(path: Path, rows: list[list[str]], blank_after: int | None = None) -> Path:
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x", "n", "name"])
        for number, row in enumerate(rows):
            writer.writerow(row)
            if number == blank_after:
                file.write("\n\n")
    return path


@pytest.mark.parametrize("rows", [0, 1, CHUNK, CHUNK + 1, 2 * CHUNK + 7])
@pytest.mark.parametrize("packed", [False, True])
def test_all_cells_come_back_in_order(rows: int, packed: bool, tmp_path: Path) -> None:
    expected = table(rows)
    path = write(tmp_path / "t.csv", expected, blank_after=3)
    if packed:
        path.write_bytes(gzip.compress(path.read_bytes()))
    chunks = list(read_chunks(path, ["x", "n"], ["name", "more"]))
    assert [chunk.first_row for chunk in chunks] == list(range(0, rows, CHUNK))
    assert sum(map(len, chunks)) == rows
    found = []
    for chunk in chunks:
        found += map(list, zip(*(chunk.columns[name] for name in ("x", "n", "name")), strict=True))
    assert found == expected
    for chunk in chunks:
        given = [float(row[0]) for row in expected[chunk.first_row : chunk.first_row + len(chunk)]]
        np.testing.assert_array_equal(chunk.numbers("x", Range(-1e9, 1e9, ""), "a number"), given)


def test_spreadsheets_put_a_mark_before_the_header_and_columns_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(b"\xef\xbb\xbf n , x\r\n4,1.5\r\n")
    [chunk] = read_chunks(path, ["x", "n"], [])
    assert chunk.columns == {"n": ("4",), "x": ("1.5",)}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x;n\n1,5;2\n", "found semicolons between the columns, expected commas"),
        ("x\tn\n1\t2\n", "found tabs between the columns"),
        ("1.5,2\n3,4\n", "found no header line; expected the columns x,n"),
    ],
)
def test_another_separator_and_a_missing_header_are_named(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=expected):
        list(read_chunks(tmp_path / "t.csv", ["x", "n"], []))


@pytest.mark.parametrize("row", [0, 4, CHUNK - 1, CHUNK + 3])
def test_a_bad_value_is_told_with_its_line(row: int, tmp_path: Path) -> None:
    for cell, message in (("word", "x: found 'word'"), ("1e9", "x: found 1e9"), ("nan", "x: found nan")):
        rows = table(CHUNK + 10)
        rows[row][0] = cell
        rows[2][2] = "two\nlines"
        path = write(tmp_path / "t.csv", rows, blank_after=1)
        line = 2 + row + (2 if row > 1 else 0) + (1 if row > 2 else 0)
        with pytest.raises(InputError, match=rf"line {line}: {message}, expected -9 to 9"):
            for chunk in read_chunks(path, ["x", "n"], ["name"]):
                chunk.numbers("x", Range(-9, 9, ""), "-9 to 9")
    with pytest.raises(InputError, match=r"found 0\.5, expected whole"):
        rows[row][:2] = ["0", "0.5"]
        for chunk in read_chunks(write(tmp_path / "t.csv", rows), ["x", "n"], ["name"]):
            chunk.numbers("n", Range(0, 99, ""), "whole", whole=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file, expected the columns x,n, optional name"),
        (b"x,m\n", "unknown column 'm'"),
        (b"x,x,n\n", "the column x more than once"),
        (b"x,name\n", "found no column n"),
        (b"x,n\n1,2,3\n", "line 2: found 3 cells, expected 2: x,n"),
        (b"x,n\n1,2\n\n1\n", "line 4: found 1 cells"),
        (b"x,n\n\xff\xfe,2\n", "not a text file in UTF-8"),
        (b'x,n\n"1,2\n', "not valid CSV"),
        (b"x,n\n" + b"1" * (LONGEST_LINE + 1), "not valid CSV: a line of more than"),
        (gzip.compress(b"x,n\n" + b"1,2\n" * 5000, mtime=0)[:-20], "compressed file is truncated"),
        (gzip.compress(b"x,n\n1,2\n", mtime=0)[:12] + b"\x00\xff" * 8, "compressed file is damaged"),
    ],
)
def test_what_is_no_table_is_told_in_a_line(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        list(read_chunks(path, ["x", "n"], ["name"]))
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read: No such file"):
        list(read_chunks(tmp_path / "absent.csv", ["x"], []))
    with pytest.raises(InputError, match="expected a file"):
        list(read_chunks(tmp_path, ["x"], []))
