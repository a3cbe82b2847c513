import json
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, put, put_files, read_in_mm, rig_of

K = np.array([[900.5, 0, 640], [0, 905, 400], [0, 0, 1.0]])
Q = rotation_from_vector(np.array([0.1, 0.2, 0.3]))
RECTIFIED = rotation_from_vector(np.array([0.02, -0.03, 0.01]))
P = np.array([[800.0, 0, 600, -90], [0, 820, 410, 8], [0, 0, 1, 0]])


def entry(**change: object) -> dict[str, object]:
    return {
        "name": "a", "width": 1280, "height": 800, "K": K.tolist(), "D": [-0.1, 0.02, 0, 0, 0.01], "P": P.tolist(),
        "R": RECTIFIED.tolist(), "Q": Q.tolist(), "translation": [0.1, 0.2, 3.0],
        **change,
    }  # fmt: skip


def read(tmp_path: Path, *cameras: object):
    return read_foreign_rig(put(tmp_path, a__json=json.dumps({"camera_system": cameras})) / "a.json")


def test_pymvg_projects_alike_through_a_rectification(tmp_path: Path) -> None:
    pymvg = pytest.importorskip("pymvg.multi_camera_system", exc_type=ImportError)
    rig = read(tmp_path, entry(), entry(name="b", P=None, R=None, translation=[0, 0, 2]))
    content = {"__pymvg_file_version__": "1.0", "camera_system": [entry()]}
    system = pymvg.MultiCameraSystem.from_pymvg_str(json.dumps(content))
    points = np.array([[0.1, 0.2, 0.9], [-0.2, 0.1, 1.5]])
    assert np.abs(rig.cameras[0].project(points) - [system.find2d("a", point) for point in points]).max() < 1e-8


def test_a_rectification_in_between_is_another_pose(tmp_path: Path) -> None:
    """By hand: rectified pixel by P, back to a ray by P's left part, turned back by R, then K."""
    camera = read(tmp_path, entry()).cameras[0]
    point = np.array([0.1, 0.2, 0.9])
    u, v, w = P @ [*(Q @ point + entry()["translation"]), 1.0]
    ray = RECTIFIED.T @ [(u / w - 600) / 800, (v / w - 410) / 820, 1.0]
    assert np.abs(camera.project(point[None])[0] - camera.lens.project(ray[None])[0]).max() < 1e-9


def test_what_is_refused(tmp_path: Path) -> None:
    for change, said in (({"Q": None}, "no pose"), ({"D": [1, 2, 3]}, "found 3"), ({"P": [[0] * 4] * 3}, "P: found")):
        with pytest.raises(InputError, match=f"this is a PyMVG camera system: a: .*{said}"):
            read(tmp_path, entry(**change))
    with pytest.raises(InputError, match="found no camera"):
        read(tmp_path)


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0, 0, 0.01), brown())
    assert apart(rig, read_in_mm(put_files(tmp_path, convert_rig(rig, "pymvg", "x").files), "m")) < 1e-8
