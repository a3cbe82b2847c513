"""Strict YAML: round trips, and one-line errors with their place."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from imgcal.errors import InputError
from imgcal.io import Flow, StrictModel, is_prose, parse_yaml, read_yaml, yaml_text
from imgcal.io.yaml_file import FlowMap


class Lens(StrictModel):
    focal: list[float]


class Camera(StrictModel):
    name: str
    lens: Lens
    weight: int = 1


class Rig(StrictModel):
    format: str
    cameras: list[Camera]


GOOD = """
format: test/1
cameras:
- name: left
  lens: {focal: [1.5, 2.0]}
- name: right
  lens: {focal: [3.0]}
  weight: 4
"""


def read(path: Path, text: str) -> Rig:
    path.write_text(text)
    return read_yaml(path, Rig, "test/1")


def test_what_is_there_is_read(tmp_path: Path) -> None:
    rig = read(tmp_path / "rig.yaml", GOOD)
    assert [camera.name for camera in rig.cameras] == ["left", "right"]
    assert rig.cameras[1].lens.focal == [3.0] and [camera.weight for camera in rig.cameras] == [1, 4]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1.5, 2.0]", "[1.5, two]", r"camera left: lens: focal\[1\]: found 'two', expected a valid number"),
        ("weight: 4", "wieght: 4", "camera right: unknown key `wieght`, nearest: weight"),
        ("weight: 4", "weight: 4.5", "camera right: weight: found 4.5"),
        ("weight: 4", "weight: '4'", "camera right: weight: found '4', expected a valid integer"),
        ("  lens: {focal: [3.0]}\n", "", "camera right: key `lens` is missing"),
        ("- name: right", "- other: right", r"camera number 2: unknown key `other`.*\(and 1 more\)"),
        ("format: test/1", "format: test/2", "found `format: 'test/2'`, expected `format: test/1`"),
        ("format: test/1", "", "found no key `format`"),
        ("weight: 4", "weight: 4\n  weight: 5", "not valid YAML in line 9"),
        ("weight: 4", "weight: [", "not valid YAML in line"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    with pytest.raises(InputError, match=message) as error:
        read(path, GOOD.replace(old, new))
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [("", "found an empty file"), ("[1, 2]", r"found list \[1, 2\]"), ("\x00", "not a YAML text file")],
)
def test_what_is_no_mapping(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path / "rig.yaml", content)


README = """# Two cameras: a README
It says: what this folder holds, and how it was made. See [the page](https://x.y/z).
- `rig.yaml` is the rig that the factory has measured.
"""


def test_a_text_for_people_is_told_from_damaged_values(tmp_path: Path) -> None:
    expected = "found text for people .it begins `# Two cameras: a README`., expected a file that starts with `format"
    with pytest.raises(InputError, match=expected):
        read(tmp_path / "README.md", README)
    with pytest.raises(InputError, match="not valid YAML in line"):
        read(tmp_path / "rig.yaml", GOOD.replace("weight: 4", "weight: [") + "# where the cameras were last year\n")


def test_files_that_are_not_there_or_no_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_yaml(tmp_path / "absent.yaml", Rig, "test/1")
    with pytest.raises(InputError, match="expected a file"):
        read_yaml(tmp_path, Rig, "test/1")


def test_a_flood_of_problems_is_counted(tmp_path: Path) -> None:
    text = "format: test/1\ncameras:\n" + "- {}\n" * 1000
    with pytest.raises(
        InputError, match="found 2,000 values that do not belong there, expected the keys format, camera"
    ):
        read(tmp_path / "rig.yaml", text)


scalars = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(max_size=20)


@given(st.dictionaries(st.text(min_size=1, max_size=8), scalars | st.lists(scalars, max_size=3), max_size=4))
def test_values_come_back_exactly_whoever_reads_them(content: dict) -> None:
    text = yaml_text(content)
    assert yaml.safe_load(text) == content
    try:
        found = parse_yaml(text, "here")
    except InputError:
        # Our reader takes no control characters, and no number that overflows.
        assert not text.isascii() or "\\" in text or ".inf" in text
        return
    assert found == content


def test_flow_values_stand_in_one_line_in_the_order_given() -> None:
    text = yaml_text({"b": Flow([1.0, 0.1, 1e-5]), "a": FlowMap(y=2, x="1e-5"), "plain": [1]})
    assert text == "b: [1.0, 0.1, 1.0e-05]\na: {y: 2, x: '1e-5'}\nplain:\n- 1\n"


def test_a_value_that_is_none_says_where_it_was(tmp_path: Path) -> None:
    assert parse_yaml("{a: [1, 2]}", "--set") == {"a": [1, 2]}
    with pytest.raises(InputError, match=r"--set: found '\{a: ', expected a value in YAML"):
        parse_yaml("{a: ", "--set")


@pytest.mark.parametrize(
    ("text", "prose"),
    [
        ("This tool recalibrates several cameras.\n", True),
        ("(Please read this first!)\n\n=====\n", True),
        ("# The camera's place, roughly\nformat: x\n", True),
        ("format: imgcal-rig/1\nname: a rig of ours\ncameras: []\n", False),
        ("a b c d e f\n", False),
        ("left 1 right 2 left 3 right 4\n", False),
        ("one two three\nfour five six\n", False),
        ("", False),
    ],
)
def test_prose_is_told_from_values(text: str, prose: bool) -> None:
    assert is_prose(text) is prose


@pytest.mark.parametrize(
    "text", ["'a' * n + ': ['", "'abc ' * n + ': ['", "'ab.' * n", "'ab, ' * n + ' - ['", "'a\u2019' * n"]
)
def test_a_long_word_stops_nobody(text: str) -> None:
    code = f"from imgcal.io import is_prose; n = 1_000_000; is_prose({text})"
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


@pytest.mark.parametrize(
    "text", ["'1:' * n + '1'", "'!!int ' + '1:' * n + '1'", "'1:' * n + '1.5'", "'0x' + 'f' * n", "'1_' * n"]
)
def test_a_long_number_stops_nobody(text: str) -> None:
    code = f"from imgcal.io import parse_yaml; n = 1_000_000; parse_yaml({text}, 'x')"
    done = subprocess.run([sys.executable, "-c", code], timeout=60, check=False, capture_output=True, text=True)
    assert done.returncode == 0 or "InputError" in done.stderr
