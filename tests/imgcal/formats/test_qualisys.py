from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import brown, put, rig_of

AXES = rotation_from_vector(np.array([1.2, 0.3, -0.4]))  # rows: camera axes in the world; x right, y up, back
PLACE = np.array([1000.0, -2000.0, 1500.0])


def camera(
    serial: str = "17", more: str = "", unit: float = 64.0, attributes: str = 'active="1" viewrotation="0"'
) -> str:
    rows = " ".join(f'r{i + 1}{j + 1}="{float(AXES[i, j])!r}"' for i in range(3) for j in range(3))
    return f"""<camera serial="{serial}" {attributes}><fov_video left="10" top="20" right="1289" bottom="819"/>
      <transform x="{1000 if serial == "17" else 1100}" y="-2000" z="1500" {rows}/>
      <intrinsic focallength="9" sensorMinU="0" sensorMaxU="{unit * 1300 - 1}"
       sensorMinV="0" sensorMaxV="{unit * 840 - 1}"
       focalLengthU="{900 * unit}" focalLengthV="{901 * unit}" centerPointU="{650 * unit}" centerPointV="{420 * unit}"
       skew="0" radialDistortion1="-0.1" radialDistortion2="0.02" radialDistortion3="0.001"
       tangentalDistortion1="0.0003" tangentalDistortion2="-0.0004"/>{more}</camera>"""


def read(tmp_path: Path, *cameras: str):
    text = f"<calibration source='x'><cameras>{''.join(cameras)}</cameras></calibration>"
    return read_foreign_rig(put(tmp_path, a__qca__txt=text) / "a.qca.txt")


def test_the_sensor_s_numbers(tmp_path: Path) -> None:
    rig = read(
        tmp_path,
        camera("17"),
        camera("18", attributes='active="1" viewrotation="90"'),
        camera("19", attributes='active="0"'),
    )
    assert (rig.format, rig.unit, rig.names) == ("qualisys", "mm", ["17", "18"])
    one = rig.cameras[0]
    assert one.image_size == (1280, 800)
    assert one.lens.principal_point == (640.0, 400.0)  # fov's corner taken off
    assert one.lens.coefficients == (-0.1, 0.02, 0.0003, -0.0004, 0.001)  # not divided by 64
    assert np.allclose(one.centre, PLACE)
    ahead = PLACE - AXES[2] * 500.0  # it looks along -z of its axes, y is up
    assert np.allclose(one.in_camera(ahead[None]), [[0, 0, 500.0]])
    assert one.in_camera((ahead + AXES[1])[None])[0, 1] < 0
    said = " ".join(rig.notes)
    assert "camera 18: mounted rotated" in said
    assert "camera 19: left out" in said
    assert "half a pixel" in said


def test_theia_s_variant_has_plain_pixels(tmp_path: Path) -> None:
    rig = read(tmp_path, camera(unit=1.0))
    assert rig.cameras[0].lens.focal_length == (900.0, 901.0)
    assert np.allclose(rig.cameras[0].translation, PLACE)
    assert any("Theia3D" in note for note in rig.notes)


def test_it_is_only_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Qualisys calibration can only be read"):
        convert_rig(rig_of(brown(), brown()), "qualisys", "x")
    with pytest.raises(InputError, match="this is a Qualisys calibration: 17: no focalLengthU"):
        read(tmp_path, camera().replace("focalLengthU", "x"))
    with pytest.raises(InputError, match="no active camera"):
        read(tmp_path, camera(attributes='active="0"'))
