import os
import stat
from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.io import replacing, write_bytes, write_text


def test_replaces_the_content(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "älter")
    write_text(path, "neuer")
    assert path.read_text("utf-8") == "neuer"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_failure_in_the_middle_keeps_the_previous_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_bytes(path, b"before")
    with pytest.raises(ZeroDivisionError), replacing(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_failed_rename_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise PermissionError(1, "not permitted")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match=r"a\.txt: cannot be written: not permitted"):
        write_text(tmp_path / "a.txt", "x")
    assert not list(tmp_path.iterdir())


def test_other_people_may_read_the_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "x")
    (tmp_path / "plain.txt").write_text("x")
    modes = {stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert len(modes) == 1


def test_missing_folder_and_device_are_input_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere.*No such file"):
        write_text(tmp_path / "nowhere" / "a.txt", "x")
    with pytest.raises(InputError, match="found a folder or device"):
        write_text(tmp_path, "x")
    with pytest.raises(InputError, match="found a folder or device"):
        write_text(os.devnull, "x")
