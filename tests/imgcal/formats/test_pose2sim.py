import tomllib
from pathlib import Path

import pytest

from imgcal.errors import InputError, RefusedError
from imgcal.formats import convert_rig, read_foreign_rig
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of
from tests.imgcal.formats.test_anipose import TEXT

FOUR = TEXT.replace(", 0.0, 0.0, 0.0, 0.0]\nrot", ", 0.0, 0.0, 0.0]\nrot")


def test_four_coefficients_are_pose2sim_s(tmp_path: Path) -> None:
    rig = read_foreign_rig(put(tmp_path, Calib__toml=FOUR) / "Calib.toml")
    assert (rig.format, rig.unit) == ("pose2sim", "m")
    assert read_foreign_rig(put(tmp_path, Calib__toml=TEXT) / "Calib.toml").format == "anipose"
    assert read_foreign_rig(tmp_path / "Calib.toml", "pose2sim").unit == "m"


def test_extrinsics_of_zeros_are_refused(tmp_path: Path) -> None:
    zeros = FOUR.replace("[0.0, 0.3, 0.0]", "[0.0, 0.0, 0.0]").replace("[-200.0, 0.0, 10.0]", "[0.0, 0.0, 0.0]")
    with pytest.raises(InputError, match=r"this is a Pose2Sim Calib.toml: cameras left, right: .*never calibrated"):
        read_foreign_rig(put(tmp_path, Calib__toml=zeros) / "Calib.toml")


def test_fisheyes_alone_could_be_anipose_s(tmp_path: Path) -> None:
    rig = rig_of(fisheye(0.01), fisheye(0.02))
    path = put_files(tmp_path, convert_rig(rig, "pose2sim", "x").files)
    with pytest.raises(
        InputError, match=r"unit of length \(of fisheyes, .*: --from pose2sim reads metres\): give imgcal"
    ):
        read_in_mm(path)
    assert apart(rig, read_in_mm(path, name="pose2sim")) < 1e-8


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0.001, 0.0), brown(), names=("int_cam1_img", "Miqus (1): a, b"))
    path = put_files(tmp_path, convert_rig(rig, "pose2sim", "x").files)
    tables = tomllib.loads(path.read_text())
    assert {len(tables[name]["distortions"]) for name in rig.names} == {4}
    assert abs(tables["Miqus (1): a, b"]["translation"][2]) < 1.0  # metres
    assert apart(rig, read_in_mm(path)) < 1e-8
    with pytest.raises(RefusedError, match=r"Pose2Sim Calib.toml cannot express"):
        convert_rig(rig_of(brown(-0.3, 0.1, 0, 0, -0.05), brown()), "pose2sim", "x")
