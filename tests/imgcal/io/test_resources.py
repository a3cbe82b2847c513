from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.io import data_path, load_object, names, open_capture, open_input, read_rig, sample_path, shipped_names


def test_what_ships_is_there_and_can_be_read() -> None:
    rigs, objects = shipped_names("rigs", ".yaml"), shipped_names("objects", ".csv")
    assert "O10" in rigs and "asymmetric8" in objects
    assert list(rigs) == sorted(rigs)
    for name in rigs:
        assert read_rig(name).num_cameras == read_rig(data_path("rigs", f"{name}.yaml")).num_cameras > 0
    for name in objects:
        assert load_object(name).num_fiducials >= 3
    assert shipped_names("nothing", ".yaml") == ()


def test_an_installed_package_carries_its_data(tmp_path: Path, monkeypatch) -> None:
    room = tmp_path / "imgcal" / "io"
    room.mkdir(parents=True)
    monkeypatch.setattr(names, "__file__", str(room / "names.py"))
    assert data_path("rigs", "a.yaml") == tmp_path / "data" / "rigs" / "a.yaml"  # a checkout: beside the package
    (tmp_path / "imgcal" / "data").mkdir()
    assert data_path("rigs", "a.yaml") == tmp_path / "imgcal" / "data" / "rigs" / "a.yaml"


def test_a_sample_is_found_by_its_name_from_any_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder, rig = data_path("samples", "O10"), read_rig("sample:O10")
    assert sample_path("sample:O10") == folder and sample_path("sample") == Path("sample")
    assert rig.name == read_rig(folder / "rig.yaml").name != read_rig("O10").name
    assert bool((load_object("sample:O10").points == load_object(folder / "object.csv").points).all())
    assert open_input("sample:O10", rig).folder == open_capture("sample:O10", rig).folder == folder


@pytest.mark.parametrize("load", [read_rig, load_object, open_input])
def test_a_sample_that_does_not_exist_is_refused_with_those_that_do(load) -> None:
    with pytest.raises(InputError, match="sample:O11: no such sample, expected sample:O10"):
        load("sample:O11")
