from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import put

WORLD_FROM_CAMERA = rotation_from_vector(np.array([0.2, 1.1, -0.3]))
HEAD = '<?xml version="1.0" encoding="UTF-16LE"?>\n'


def camera(serial: str, lens: bool = True) -> str:
    axes = " ".join(f'OrientMatrix{n}="{value!r}"' for n, value in enumerate(WORLD_FROM_CAMERA.ravel().tolist()))
    model = """<IntrinsicStandardCameraModel HorizontalFocalLength="900" VerticalFocalLength="901" LensCenterX="640"
        LensCenterY="400" k1="0.1" k2="-0.2" k3="0.01" TangentialX="0.001" TangentialY="0.002"/>"""
    return f"""<Camera Serial="{serial}"><Attributes ImagerPixelWidth="1280" ImagerPixelHeight="800"/>
        <Extrinsic X="1" Y="2" Z="3" {axes}/>{model if lens else ""}</Camera>"""


def read(tmp_path: Path, *cameras: str):
    inside = f"<Calibration><Cameras>{''.join(cameras)}</Cameras></Calibration>"
    text = f"{HEAD}<calibrationProfile>{inside}</calibrationProfile>"
    return read_foreign_rig(put(tmp_path, a__mcal=text.encode("utf-16")) / "a.mcal")


def test_metres_y_up_and_what_is_not_documented(tmp_path: Path) -> None:
    rig = read(tmp_path, camera("M1"), camera("M2", lens=False))
    assert (rig.format, rig.unit, rig.names) == ("motive", "m", ["M1"])
    one = rig.cameras[0]
    assert np.allclose(one.centre, [1, 2, 3])
    ahead = np.array([1.0, 2, 3]) - WORLD_FROM_CAMERA[:, 2] * 4.0  # along -z of its axes
    assert np.allclose(one.in_camera(ahead[None]), [[0, 0, 4]])
    assert one.in_camera((ahead + WORLD_FROM_CAMERA[:, 1])[None])[0, 1] < 0
    assert one.lens.coefficients == (0.1, -0.2, 0.001, 0.002, 0.01)
    said = " ".join(rig.notes)
    assert "UNCONFIRMED" in said
    assert "camera M2: left out" in said


def test_the_older_binary_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="binary"):
        read_foreign_rig(put(tmp_path, old__cal=bytes(range(256))) / "old.cal")
    with pytest.raises(InputError, match=r"this is an OptiTrack Motive calibration .*: M1: no LensCenterX"):
        read(tmp_path, camera("M1").replace("LensCenterX", "x"))
