from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from imgcal.errors import InputError
from imgcal.io import load_object, save_object
from imgcal.types import CalibrationObject
from renderers.palette import palette

GOOD = "x,y,z\n0,0,0\n1.5,0,0\n0,1,0\n0,0,1\n"


@pytest.mark.parametrize(("name", "count"), [("cube8", 8), ("cube27", 27), ("sphere64", 64), ("asymmetric8", 8)])
def test_shipped_objects_load_by_name(name: str, count: int) -> None:
    obj = load_object(name)
    assert (obj.name, obj.num_fiducials) == (name, count)
    assert obj.points.dtype == torch.float64
    torch.testing.assert_close(obj.colours, palette(count).double())


def test_optional_columns_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "o.csv"
    path.write_text("radius,name,z,y,x\n1,p,3,2,1\n2,q,6,5,4\n1,r,0,0,0\n\n1,s,9,0,1e1\n")
    obj = load_object(path)
    assert obj.points.tolist() == [[1, 2, 3], [4, 5, 6], [0, 0, 0], [10, 0, 9]]
    assert obj.radius is not None
    assert obj.radius.tolist() == [1, 2, 1, 1]
    assert obj.fiducial_names == ("p", "q", "r", "s")


def test_tolerances_are_read_and_written(tmp_path: Path) -> None:
    path = tmp_path / "o.csv"
    path.write_text("x,y,z,tolerance\n0,0,0,0.2\n1,0,0,0\n0,1,0,0.1\n0,0,1,0.1\n")
    obj = load_object(path)
    assert obj.tolerance.tolist() == [0.2, 0, 0.1, 0.1] and not obj.exact
    save_object(obj, tmp_path / "again.csv")
    assert load_object(tmp_path / "again.csv").tolerance.tolist() == obj.tolerance.tolist()
    path.write_text("x,y,z,tolerance\n0,0,0,-0.2\n1,0,0,0\n0,1,0,0.1\n0,0,1,0.1\n")
    with pytest.raises(InputError, match=r"line 2: tolerance: found -0\.2, expected a tolerance, 0 to 1000 mm"):
        load_object(path)


@pytest.mark.parametrize(("text", "rank"), [("0,0,0\n", 3), ("0,0,0\n500,0,0\n", 5), ("0,0,0\n1,2,3\n2,4,6\n", 5)])
def test_a_light_and_a_stick_are_objects(tmp_path: Path, text: str, rank: int) -> None:
    (tmp_path / "o.csv").write_text("x,y,z\n" + text)
    assert load_object(tmp_path / "o.csv").pose_rank == rank


def test_planar_object_is_fine(tmp_path: Path) -> None:
    (tmp_path / "o.csv").write_text("\ufeffx,y,z\r\n0,0,0\r\n1,0,0\r\n0,1,0\r\n1,1,0\r\n", encoding="utf-8")
    assert load_object(tmp_path / "o.csv").planar


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found an empty file, expected the columns x,y,z"),
        ("x,y,z\n", "found 0 points, expected 1 to 1000"),
        ("x,y\n0,0\n", "found no column z"),
        ("x,y,z,raduis\n0,0,0,1\n", "unknown column 'raduis', nearest: radius"),
        ("x;y;z\n0;0;0\n", "found semicolons between the columns, expected commas"),
        ("x,y,z,z\n0,0,0,0\n", "column z more than once"),
        (GOOD + "a,0,0\n", "line 6: x: found 'a', expected a finite coordinate"),
        (GOOD + "\n\n0,nan,7\n", "line 8: y: found nan"),
        (GOOD + "0,0,inf\n", "line 6: z: found inf"),
        (GOOD + ",0,0\n", "line 6: x: found ''"),
        (GOOD + "5,5\n", "line 6: found 2 cells, expected 3: x,y,z"),
        (GOOD + "1.50,0,0\n", "line 6: found the same point as in row 2"),
        ("x,y,z,radius\n0,0,0,1\n1,0,0,1\n0,1,0,-2\n0,0,1,1\n", "line 4: radius: found -2, expected a radius > 0"),
        ("x,y,z,name\n0,0,0,a\n1,0,0,b\n0,1,0,a\n0,0,1,c\n", "line 4: name: found 'a'"),
        ('x,y,z\n"0,0,0\n', "not valid CSV"),
        ("x,y,z\n\x00\x01", r"not valid CSV|line 2|found 0 points"),
    ],
)
def test_bad_files_give_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        load_object(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["lights", "charuco", "cube8"])
def test_a_folder_of_the_same_name_is_no_object(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    assert load_object(name).name == name


def test_unknown_name_offers_the_nearest() -> None:
    with pytest.raises(InputError, match=r"cube9: no such file.*nearest: cube8"):
        load_object("cube9")


def named(*names: str) -> CalibrationObject:
    points = torch.cat((torch.zeros(1, 3), torch.eye(3)))[: len(names)].double()
    return CalibrationObject(points, palette(len(names)).double(), None, "o", names)


@settings(deadline=None)
@given(st.lists(st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1), min_size=4, max_size=4, unique=True))
@example(["a,b", 'c"d', '"e"', "f'g"])
@example(["a b", '"', "'", ","])
def test_names_come_back_whatever_they_are(names: list[str]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "o.csv"
        save_object(named(*names), path)
        assert load_object(path).fiducial_names == tuple(names)


@pytest.mark.parametrize("name", ["a\nb", "a\rb", "", " a", "x" * 1000, "p"])
def test_names_that_could_not_be_read_again_are_not_written(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"o\.csv: not written: found the name"):
        save_object(named("p", "q", "r", name), tmp_path / "o.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"points": torch.full((8, 3), torch.nan)}, "line 2: x: found nan"),
        ({"radius": torch.full((8,), -1.0)}, r"line 2: radius: found -1\.0"),
        ({"labels": (1, 2, 3)}, "3 labels, expected 8, or none"),
        ({"fiducial_names": ("a", "b", "c")}, "3 names, expected 8, or none"),
        ({"labels": (1,) * 8}, "fiducial: found 1 again"),
        ({"scale_tolerance": 0.01}, r"a scale tolerance of 0\.01, for which a file has no place"),
    ],
)
def test_objects_that_could_not_be_read_again_are_not_written(change: Any, found: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"o\.csv: not written: .*{found}"):
        save_object(replace(load_object("asymmetric8"), **change), tmp_path / "o.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["light", "Lights", "ligths"])
def test_a_slip_in_the_name_of_unknown_markers_is_told(name):
    with pytest.raises(InputError, match=rf"^{name}: no such file, nor lights, nor .*, nearest: lights$"):
        load_object(name)
