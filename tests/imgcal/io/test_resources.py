from pathlib import Path

from imgcal.io import load_object, load_rig, resources
from imgcal.io.resources import data_path, shipped_names


def test_what_ships_is_there_and_can_be_read() -> None:
    rigs, objects = shipped_names("rigs", ".yaml"), shipped_names("objects", ".csv")
    assert "O10" in rigs and "asymmetric8" in objects
    assert list(rigs) == sorted(rigs)
    for name in rigs:
        assert load_rig(name).num_cameras == load_rig(data_path("rigs", f"{name}.yaml")).num_cameras > 0
    for name in objects:
        assert load_object(name).num_fiducials >= 3
    assert shipped_names("nothing", ".yaml") == ()


def test_an_installed_package_carries_its_data(tmp_path: Path, monkeypatch) -> None:
    room = tmp_path / "imgcal" / "io"
    room.mkdir(parents=True)
    monkeypatch.setattr(resources, "__file__", str(room / "resources.py"))
    assert data_path("rigs", "a.yaml") == tmp_path / "data" / "rigs" / "a.yaml"  # a checkout: beside the package
    (tmp_path / "imgcal" / "data").mkdir()
    assert data_path("rigs", "a.yaml") == tmp_path / "imgcal" / "data" / "rigs" / "a.yaml"
