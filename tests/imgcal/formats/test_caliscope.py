import tomllib
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of

CAMERA = """
[{head}{n}]
{key} = {n}
rotation_count = {count}
size = [1280, 800]
matrix = [[900.0, 0.0, 640.0], [0.0, 900.0, 400.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.02, 0.0, 0.0, 0.01]
rotation = {rotation}
translation = {translation}
"""
VECTOR = [0.1, 0.3, -0.2]


def text(new: bool, n: int, rotation: object = tuple(VECTOR), translation: object = None, count: int = 0) -> str:
    translation = (0.1, 0.2, 0.3 * n) if translation is None else translation
    shown = [f'"{v}"' if isinstance(v, str) else str(list(v)) for v in (rotation, translation)]
    return CAMERA.format(head="cameras." if new else "cam_", key="cam_id" if new else "port", n=n, rotation=shown[0],
                         translation=shown[1], count=count)  # fmt: skip


def test_vectors_and_matrices_new_and_old(tmp_path: Path) -> None:
    matrix = rotation_from_vector(np.array(VECTOR)).tolist()
    for new in (True, False):
        for rotation in (VECTOR, matrix):
            content = "".join(text(new, n, rotation) for n in (1, 10, 2))
            rig = read_foreign_rig(put(tmp_path, a__toml=content) / "a.toml")
            assert (rig.format, rig.unit, rig.names) == ("caliscope", "m", ["1", "10", "2"])
            assert np.allclose(rig.cameras[0].rotation, matrix)


def test_who_has_no_pose_is_said(tmp_path: Path) -> None:
    content = text(True, 1) + text(True, 2) + text(True, 4, "null", "null")
    rig = read_foreign_rig(put(tmp_path, a__toml=content) / "a.toml")
    assert rig.names == ["1", "2"]
    assert any("camera 4: left out" in note for note in rig.notes)


def test_turned_images_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="caliscope camera array: camera 2: rotation_count"):
        read_foreign_rig(put(tmp_path, a__toml=text(True, 1) + text(True, 2, count=-1)) / "a.toml")


@pytest.mark.parametrize("name", ["caliscope", "caliscope-config"])
def test_written_and_read(tmp_path: Path, name: str) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0.001, 0, 0.01), fisheye(0.01), brown(), names=("1", "10", "2"))
    path = put_files(tmp_path, convert_rig(rig, name, "x").files)
    back = read_in_mm(path)
    assert (back.format, back.names) == ("caliscope", rig.names)
    assert apart(rig, back) < 1e-8
    tables = tomllib.loads(path.read_text())
    table = tables["cameras"]["10"] if name == "caliscope" else tables["cam_10"]
    assert np.shape(table["rotation"]) == ((3,) if name == "caliscope" else (3, 3))


def test_cameras_with_other_names_are_numbered() -> None:
    made = convert_rig(rig_of(brown(), brown()), "caliscope", "x")
    assert any("the cameras have other names in the files, in this order: 0, 1" in note for note in made.notes)


def test_caliscope_reads_what_is_written(tmp_path: Path) -> None:
    array = pytest.importorskip("caliscope.cameras.camera_array", exc_type=ImportError)
    rig = rig_of(brown(-0.1, 0.02, 0.001, 0, 0.01), brown(), names=("1", "7"))
    path = put_files(tmp_path, convert_rig(rig, "caliscope", "x").files)
    found = array.CameraArray.from_toml(path)
    for camera in rig.cameras:
        other = found.cameras[int(camera.name)]
        assert np.allclose(other.rotation, camera.rotation, atol=1e-9)
        assert np.allclose(np.ravel(other.translation) * 1000, camera.translation)
