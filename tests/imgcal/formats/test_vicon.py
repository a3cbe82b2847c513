from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, in_millimetres, read_foreign_rig
from imgcal.formats.values import quaternion_from_rotation, rotation_from_vector
from tests.imgcal.formats.rigs import put

R = rotation_from_vector(np.array([1.3, 0.4, -0.2]))
W, X, Y, Z = quaternion_from_rotation(R).tolist()
RADIAL = "ViconRadial2 642 399 -3.0e-8 1.0e-14 0"


def camera(device: str, frames: int = 1, radial: str = RADIAL, aspect: float = 1.0) -> str:
    place = "1000 -2000 1500" if device == "21" else "1100 -2000 1500"
    frame = f"""<KeyFrame FRAME="0" FOCAL_LENGTH="1500" ORIENTATION="{X!r} {Y!r} {Z!r} {W!r}" POSITION="{place}"
        PRINCIPAL_POINT="640 400" VICON_RADIAL2="{radial}" WORLD_ERROR="0.2"/>"""
    return f"""<Camera DEVICEID="{device}" PIXEL_ASPECT_RATIO="{aspect}" SENSOR_SIZE="1280 800" SKEW="0">
        <KeyFrames>{frame * frames}</KeyFrames></Camera>"""


def read(tmp_path: Path, *cameras: str):
    return read_foreign_rig(
        put(tmp_path, a__xcp=f'<?xml version="1.0"?><Cameras VERSION="1">{"".join(cameras)}</Cameras>') / "a.xcp"
    )


def test_poses_and_the_direction_of_the_distortion(tmp_path: Path) -> None:
    rig = read(tmp_path, camera("21"), camera("22", frames=0), camera("23", aspect=1.25))
    assert (rig.format, rig.unit, rig.names) == ("vicon", "mm", ["21", "23"])
    one = rig.cameras[0]
    assert np.allclose(one.rotation, R)
    assert np.allclose(one.centre, [1000, -2000, 1500])
    assert rig.cameras[1].lens.focal_length == (1500, 1200)
    uv = np.array([[1042.0, 699.0]])  # 400, 300 px from the centre of its distortion: r = 500 px
    factor = 1 - 3e-8 * 500**2 + 1e-14 * 500**4
    ray = one.lens.rays(uv)[0]
    assert np.allclose(ray[:2] * 1500 + [640, 400], [642 + 400 * factor, 399 + 300 * factor])
    assert any("camera 22: left out" in note for note in rig.notes)


def test_another_model_takes_the_lens_s_place(tmp_path: Path) -> None:
    rig = in_millimetres(read(tmp_path, camera("21"), camera("23", radial="ViconRadial2 640 400 0 0 0")), "x")
    made = convert_rig(rig, "imgcal", "x")
    assert 0 < made.between_models < 0.05
    assert sum("fitted over the image" in note for note in made.notes) == 1


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"this is a Vicon calibration .*: no camera has a KeyFrame"):
        read(tmp_path, camera("21", frames=0))
    with pytest.raises(InputError, match="PIXEL_ASPECT_RATIO"):
        read(tmp_path, camera("21", aspect=0.0))
