from pathlib import Path

import cv2
import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import Lens, convert_rig, read_foreign_rig
from imgcal.formats.file_storage import storage_text
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, put, put_files, read_in_mm, rig_of

K = np.array([[900.5, 0, 640], [0, 905, 400], [0, 0, 1.0]])
D = np.array([[-0.1, 0.05, 0.001, -0.002, 0.01]])
K2 = K + np.array([[1, 0, 2], [0, 1, 3], [0, 0, 0]])
R = rotation_from_vector(np.array([0.01, 0.2, -0.03]))
T = np.array([[-120.0], [3.0], [5.0]])


@pytest.mark.parametrize("keys", [("M1", "D1", "M2", "D2"), ("K1", "D1", "K2", "D2"),
                                  ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
                                  ("left_camera_matrix", "left_distortion", "right_camera_matrix", "right_distortion"),
                                  ("K_left", "dist_left", "K_right", "dist_right")])  # fmt: skip
def test_keys_as_they_are_met(tmp_path: Path, keys: tuple[str, ...]) -> None:
    inside = dict(zip(keys, (K, D, K2, -D), strict=True))
    folder = put(tmp_path, one__yml=storage_text({**inside, "R": R, "T": T}))
    rig = read_foreign_rig(folder / "one.yml")
    assert (rig.format, rig.unit, rig.names) == ("opencv-stereo", None, ["1", "2"])
    points = np.array([[10.0, 20.0, 900.0], [-200.0, 100.0, 1500.0]])
    expected = cv2.projectPoints(points, R, T, K2, -D)[0][:, 0]
    assert np.abs(rig.cameras[1].project(points) - expected).max() < 1e-9
    assert (
        np.abs(
            rig.cameras[0].project(points) - cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]
        ).max()
        < 1e-9
    )


def test_two_files_are_one_calibration(tmp_path: Path) -> None:
    inside, outside = (
        storage_text({"M1": K, "D1": D, "M2": K, "D2": D}),
        storage_text({"R": R, "T": -T, "Q": np.eye(4)}),
    )
    folder = put(tmp_path, intrinsics__yml=inside, extrinsics__yml=outside)
    for given in (folder, folder / "intrinsics.yml", folder / "extrinsics.yml"):
        rig = read_foreign_rig(given)
        assert any("left of camera 1" in note for note in rig.notes)  # and it is not "corrected"
        assert np.allclose(rig.cameras[1].translation, -T[:, 0])
    with pytest.raises(InputError, match="found only extrinsics"):
        read_foreign_rig(put(tmp_path / "a", x__yml=outside))
    with pytest.raises(InputError, match="found only intrinsics"):
        read_foreign_rig(put(tmp_path / "b", x__yml=inside))


def test_a_rotation_vector_and_four_coefficients(tmp_path: Path) -> None:
    content = {"M1": K, "D1": D[:, :4], "M2": K, "D2": D[:, :4], "R": cv2.Rodrigues(R)[0], "T": T}
    rig = read_foreign_rig(put(tmp_path, a__yml=storage_text(content)))
    assert np.allclose(rig.cameras[1].rotation, R)
    assert any("cv2.fisheye look alike" in note for note in rig.notes)
    content["fisheye"] = 1
    fish = read_foreign_rig(put(tmp_path, a__yml=storage_text(content)))
    assert fish.cameras[0].lens.model == "fisheye"


def test_opencv_reads_what_is_written(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0, 0, 0.001, 0.1), brown(0.1))
    folder = put_files(tmp_path / "out", convert_rig(rig, "opencv-stereo", "x").files)
    inside = cv2.FileStorage(str(folder / "intrinsics.yml"), cv2.FILE_STORAGE_READ)
    outside = cv2.FileStorage(str(folder / "extrinsics.yml"), cv2.FILE_STORAGE_READ)
    points = np.array([[10.0, 20.0, 900.0], [-100.0, 100.0, 1500.0]])
    turn, shift = outside.getNode("R").mat(), outside.getNode("T").mat()
    uv = cv2.projectPoints(points, turn, shift, inside.getNode("M2").mat(), inside.getNode("D2").mat())[0][:, 0]
    first = rig.cameras[0]
    in_rig = (points - first.translation) @ first.rotation
    assert np.abs(rig.cameras[1].project(in_rig) - uv).max() < 1e-9
    assert apart(rig, read_in_mm(folder, "mm")) < 1e-9


def test_a_pair_is_two(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds 2 cameras, found 3"):
        convert_rig(rig_of(brown(), brown(), Lens((900, 900), (640, 480))), "opencv-stereo", "x")
