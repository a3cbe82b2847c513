"""Names that users type: sorted as people count, guessed when misspelt, never a way out of a folder."""

import os
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imgcal.errors import InputError
from imgcal.io import MODEL, find_file, is_file_name, model_file, model_name, natural_key, nearest, title_from_name
from imgcal.io.names import LONGEST_NAME, check_regular


def test_numbers_in_names_count() -> None:
    expected = ["1", "01", "2", "10", "cam1", "cam2", "cam10", "cam10b", "cam11a"]
    shuffled = random.Random(0).sample(expected, len(expected))
    found = sorted(shuffled, key=natural_key)
    assert set(found[:2]) == {"1", "01"} and found[2:] == expected[2:]


@given(st.lists(st.text(), max_size=6))
def test_any_names_can_be_sorted_in_one_way(names: list[str]) -> None:
    backwards = list(reversed(names))
    assert sorted(names, key=natural_key) == sorted(backwards, key=natural_key)


def test_what_was_probably_meant() -> None:
    known = ["cam01", "cam02", "Overview"]
    assert nearest("cam1", known) == ", nearest: cam01"
    assert nearest("OVERVEIW", known) == ", nearest: Overview"
    assert nearest("zzzz", known) == nearest("cam01", []) == ""


@pytest.mark.parametrize("name", ["cam01", "Größe 3", "a.b", "x" * LONGEST_NAME, "-", "a..b"])
def test_good_file_names(name: str) -> None:
    assert is_file_name(name)


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".hidden", "a/b", "a\\b", " a", "a ", "a\n", "a\0", "x" * (LONGEST_NAME + 1), "ä" * 101]
)
def test_bad_file_names(name: str) -> None:
    assert not is_file_name(name)


@given(st.text(max_size=300))
def test_a_good_name_stays_in_its_folder(name: str) -> None:
    if is_file_name(name):
        assert Path("folder", name).name == name and Path("folder", name).parent == Path("folder")
        assert os.path.normpath(f"folder/{name}") == f"folder/{name}"


def test_titles_are_text() -> None:
    assert title_from_name(Path("some/rig one.yaml")) == "rig one"
    assert title_from_name(Path(os.fsdecode(b"a\xffb\n.csv"))) == "a?b?"
    assert len(title_from_name(Path("x" * 250 + ".csv"))) == LONGEST_NAME


def test_folders_and_pipes_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "pipe", Path("/dev/null")):
        with pytest.raises(InputError, match="expected a file"):
            check_regular(path)
    check_regular(tmp_path / "file")
    check_regular(tmp_path / "absent")  # what is not there is said by who opens it


def test_files_go_before_shipped_names_which_need_no_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = find_file("O10", "rigs", ".yaml")
    assert shipped.name == "O10.yaml" and shipped.is_file()
    (tmp_path / "O10").write_text("mine")
    assert find_file("O10", "rigs", ".yaml") == Path("O10")


def test_what_is_nowhere_is_told_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"O1O: no such file, nor one of the shipped rigs \(.*O10.*\), nearest: O10"):
        find_file("O1O", "rigs", ".yaml")
    with pytest.raises(InputError, match="found a folder"):
        find_file(tmp_path, "rigs", ".yaml")


def test_networks_are_files_folders_of_runs_or_shipped_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "one"
    run.mkdir(parents=True)
    with pytest.raises(InputError, match=f"one: found a folder without {MODEL}"):
        model_file(run)
    (run / MODEL).touch()
    assert model_file(run) == model_file(run / MODEL) == run / MODEL
    assert model_name(run / MODEL) == "one" and model_name(Path("a/b.safetensors")) == "b"
    assert model_file("points-O10-cube8").is_file()
    assert model_name(model_file("points-O10-cube8")) == "points-O10-cube8"
    assert model_file("nothing") == Path("nothing")  # who reads it says what is wrong
