from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.formats.source import MOST_FILES, Source
from tests.imgcal.formats.rigs import put


def test_a_partner_comes_along(tmp_path: Path) -> None:
    folder = put(tmp_path, my_intrinsics__yml="a: 1", my_extrinsics__yml="b: 2", other__yml="c: 3")
    source = Source([folder / "my_extrinsics.yml"])
    assert source.merge() == {"a": 1, "b": 2}
    assert Source([folder / "other.yml"]).merge() == {"c": 3}


def test_colmap_s_files_belong_together_and_are_not_parsed(tmp_path: Path) -> None:
    folder = put(tmp_path, cameras__txt="1 PINHOLE", images__txt=": [", rigs__txt="")
    source = Source([folder / "cameras.txt"])
    assert source.find_file("images.txt") == folder / "images.txt"
    assert source.documents == []


def test_a_folder_may_hold_other_things(tmp_path: Path) -> None:
    folder = put(tmp_path, a__yaml="a: 1", b__yaml=": [", readme__md="# x", picture__png=b"\x89PNG")
    source = Source([folder])
    assert source.merge() == {"a": 1}
    assert len(source.unreadable) == 1
    assert "a.yaml, b.yaml" in source.describe()


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Source([tmp_path / "nothing"])
    with pytest.raises(InputError, match="device or pipe"):
        Source([Path("/dev/null")])
    for number in range(MOST_FILES + 1):
        (tmp_path / str(number)).touch()
    with pytest.raises(InputError, match="1,001 files"):
        Source([tmp_path])


def test_a_file_that_is_given_twice(tmp_path: Path) -> None:
    path = put(tmp_path, left__yaml="a: 1") / "left.yaml"
    with pytest.raises(InputError, match=r"left.yaml: found it twice"):
        Source([path, path])
