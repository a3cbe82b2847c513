import re
from datetime import datetime
from pathlib import Path

import pytest

from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.patching import Change, Style, TextFile, number_style, write_like


@pytest.mark.parametrize(
    ("token", "value", "digits", "expected"),
    [
        ("1.250", 2.00049, 0, "2.000"),
        ("+1.250", 2.0, 0, "+2.000"),
        ("1.25E-008", -3.14159e-9, 0, "-3.14E-009"),
        ("1.25e+01", 31.4159, 0, "3.14e+01"),
        ("1500", 1501.0, 0, "1501"),
        ("1.", 3.0, 0, "3."),
        ("0", 0.123456789012345, 0, "0.123456789012"),
        ("1.25", 3.14159265358979, 9, "3.14159265"),
    ],
)
def test_a_number_keeps_its_form(token: str, value: float, digits: int, expected: str) -> None:
    assert write_like(token, value, digits=digits) == expected


def test_the_style_of_a_file() -> None:
    assert number_style(["0.1234567890123456", "0.55", "0.0"]) == Style(shortest=True)
    assert write_like("0.0", 1e-5, Style(shortest=True)) == "1.0e-05"  # without a point it is a text to YAML
    assert number_style(["0.123", "7.500", "0"]) == Style(usual="0.123")
    assert write_like("0", 0.25, Style(usual="0.123")) == "0.250"


def test_bytes_around_numbers_stay() -> None:
    content = b"\xef\xbb\xbf# \xc3\xa9 1.0\r\na: [1.00, 2.00]   # 3\r\nb: &x 1.0\r\nc: *x\r\n"
    file = TextFile(content, Path("a.yaml"))
    made = file.patch([Change(("a",), [1.0, 2.0], [1.5, 2.0])], 0)
    assert made == content.replace(b"1.00", b"1.50")
    with pytest.raises(FormatError, match=re.escape("a.yaml: a: found 2 plain numbers, expected 3")):
        file.patch([Change(("a",), [1.0, 2.0, 3.0], [1.5, 2.0, 3.0])], 0)
    with pytest.raises(FormatError, match="one value in the file stands for several cameras"):
        file.patch([Change(("b",), [1.0], [1.5]), Change(("c",), [1.0], [1.7])], 0)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("2020-01-02 03:04:05", "2026-11-24 03:30:05"),
        ("2020-01-02T03:04:05.123", "2026-11-24T03:30:05.000"),
        ("Thu Jan  2 03:04:05 2020", "Tue Nov 24 03:30:05 2026"),
        ("last summer", "last summer"),
    ],
)
def test_times(before: str, after: str) -> None:
    file = TextFile(f'calibration_time: "{before}"\nother: "{before}"\n'.encode(), Path("a.yaml"))
    made, replaced, left = file.stamp(datetime(2026, 11, 24, 3, 30, 5))
    assert made.decode() == f'calibration_time: "{after}"\nother: "{before}"\n'
    assert bool(replaced) != bool(left)
