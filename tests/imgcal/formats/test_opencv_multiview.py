from pathlib import Path

import cv2
import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.file_storage import storage_text
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of

K = np.array([[900.5, 0, 640], [0, 905, 400], [0, 0, 1.0]])
TURNS = [np.zeros(3), np.array([0.01, 0.4, -0.03])]
SIZES = np.array([[1280, 800], [1280, 800]])
CONTENT = {
    "Ks": np.stack([K.ravel(), K.ravel()]), "Ts": np.array([[0, 0, 0], [-0.3, 0.01, 0.05]]),
    "distortions": np.array([[-0.1, 0.05, 0.001, -0.002, 0.01] * 2]), "image_sizes": SIZES,
}  # fmt: skip


@pytest.mark.parametrize("as_matrices", [False, True])
def test_rotations_are_vectors_or_matrices(tmp_path: Path, as_matrices: bool) -> None:
    turns = [rotation_from_vector(turn).ravel() for turn in TURNS] if as_matrices else TURNS
    rig = read_foreign_rig(put(tmp_path, a__yaml=storage_text({**CONTENT, "Rs": np.array(turns)})))
    assert (rig.format, rig.unit, rig.names) == ("opencv-multiview", None, ["0", "1"])
    points = np.array([[0.01, 0.02, 0.9], [-0.2, 0.1, 1.5]])
    expected = cv2.projectPoints(points, TURNS[1], CONTENT["Ts"][1], K, CONTENT["distortions"][0, :5])[0][:, 0]
    assert np.abs(rig.cameras[1].project(points) - expected).max() < 1e-9


def test_what_does_not_fit_together_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Ts: found 3 numbers for 2 cameras|Ts: found 4 numbers"):
        bad = {**CONTENT, "Rs": np.array(TURNS), "Ts": np.array([[0.0, 1, 2]])}
        read_foreign_rig(put(tmp_path, a__yaml=storage_text(bad)))
    with pytest.raises(InputError, match="found the model 2"):
        bad = {**CONTENT, "Rs": np.array(TURNS), "models": np.array([[0], [2]])}
        read_foreign_rig(put(tmp_path, a__yaml=storage_text(bad)))


@pytest.mark.parametrize("value", ["4", '"ab"', "{ a: 1 }"])
def test_names_that_are_no_list(tmp_path: Path, value: str) -> None:
    content = storage_text({**CONTENT, "Rs": np.array(TURNS)}) + f"cam_ids: {value}\n".encode()
    with pytest.raises(InputError, match=r"a\.yaml: this is an OpenCV .*: cam_ids: found .*, expected a list of names"):
        read_foreign_rig(put(tmp_path, a__yaml=content) / "a.yaml")


def test_opencv_reads_what_is_written(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02), fisheye(0.01, -0.02), brown(0.1, 0, 0, 0, 0, 0.2))
    path = put_files(tmp_path, convert_rig(rig, "opencv-multiview", "x", unit="mm").files)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    turns, shifts = (storage.getNode(key).mat().reshape(3, 3) for key in ("Rs", "Ts"))
    matrices, bent = storage.getNode("Ks").mat().reshape(3, 3, 3), storage.getNode("distortions").mat().reshape(3, -1)
    points = np.array([[10.0, 20.0, 900.0], [-100.0, 100.0, 1500.0]])
    in_rig = (points - rig.cameras[0].translation) @ rig.cameras[0].rotation
    for i, camera in enumerate(rig.cameras):
        if storage.getNode("models").mat().ravel()[i]:
            uv = cv2.fisheye.projectPoints(points[:, None], turns[i], shifts[i], matrices[i], bent[i, :4])[0][:, 0]
        else:
            uv = cv2.projectPoints(points, turns[i], shifts[i], matrices[i], bent[i])[0][:, 0]
        assert np.abs(camera.project(in_rig) - uv).max() < 1e-8
    assert apart(rig, read_in_mm(path, "mm")) < 1e-8
