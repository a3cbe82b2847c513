from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of

TEXT = """
[cam_0]
name = "left"
size = [1280, 800]
matrix = [[900.0, 0.0, 640.0], [0.0, 900.0, 400.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 0.0]

[cam_1]
name = "right"
size = [1280, 800]
matrix = [[900.0, 0.0, 640.0], [0.0, 900.0, 400.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.3, 0.0]
translation = [-200.0, 0.0, 10.0]

[metadata]
adjusted = false
error = 0.6
"""


def test_the_unit_is_asked_for(tmp_path: Path) -> None:
    path = put(tmp_path, calibration__toml=TEXT) / "calibration.toml"
    rig = read_foreign_rig(path)
    assert (rig.format, rig.unit, rig.names) == ("anipose", None, ["left", "right"])
    with pytest.raises(InputError, match="--unit mm, cm, m"):
        read_in_mm(path)
    assert read_in_mm(path, "cm").cameras[1].translation.tolist() == [-2000.0, 0.0, 100.0]


def test_aniposelib_reads_what_is_written(tmp_path: Path) -> None:
    cameras = pytest.importorskip("aniposelib.cameras", exc_type=ImportError)
    rig = rig_of(brown(-0.1, 0.02, 0.001, 0.0, 0.01), fisheye(0.01, 0.02), brown())
    path = put_files(tmp_path, convert_rig(rig, "anipose", "x").files)
    group = cameras.CameraGroup.load(str(path))
    points = np.array([[10.0, 20.0, 900.0], [-100.0, 100.0, 1500.0]])
    for camera, other in zip(rig.cameras, group.cameras, strict=True):
        assert other.get_name() == camera.name
        assert np.abs(other.project(points)[:, 0] - camera.project(points)).max() < 1e-6


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0.001, 0.0, 0.01), fisheye(0.01, 0.02), brown())
    back = read_in_mm(put_files(tmp_path, convert_rig(rig, "anipose", "x", unit="cm").files), "cm")
    assert apart(rig, back) < 1e-8
    assert back.names == rig.names
