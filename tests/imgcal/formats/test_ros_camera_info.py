from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of

K1, K2 = (
    np.array([[900.5, 0, 640], [0, 905, 400], [0, 0, 1.0]]),
    np.array([[910.5, 0, 630], [0, 915, 410], [0, 0, 1.0]]),
)
D1, D2 = np.array([-0.1, 0.05, 0.001, -0.002, 0.01]), np.array([-0.12, 0.04, 0.0, 0.001, 0.0])
R, T = rotation_from_vector(np.array([0.01, 0.05, -0.03])), np.array([-0.12, 0.003, 0.005])


def info(name: str, k: np.ndarray, d: np.ndarray, r: np.ndarray, p: np.ndarray, model: str = "plumb_bob") -> str:
    def block(value: np.ndarray) -> dict[str, object]:
        rows, columns = np.atleast_2d(value).shape
        return {"rows": rows, "cols": columns, "data": np.ravel(value).tolist()}

    return yaml.safe_dump(
        {
            "image_width": 1280, "image_height": 800, "camera_name": name, "camera_matrix": block(k),
            "distortion_model": model, "distortion_coefficients": block(d), "rectification_matrix": block(r),
            "projection_matrix": block(p),
        }
    )  # fmt: skip


def pair() -> tuple[str, str]:
    """What ROS's calibrator writes: OpenCV's rectification."""
    r1, r2, p1, p2, *_ = cv2.stereoRectify(K1, D1, K2, D2, (1280, 800), R, T[:, None])
    return info("left", K1, D1, r1, p1), info("right", K2, D2, r2, p2)


def test_the_pair_is_what_was_rectified(tmp_path: Path) -> None:
    left, right = pair()
    folder = put(tmp_path, left__yaml=left, right__yaml=right)
    for given in (folder, [folder / "right.yaml", folder / "left.yaml"]):
        rig = read_foreign_rig(given)
        assert (rig.format, rig.unit, rig.names) == ("ros", "m", ["left", "right"])
        assert np.abs(rig.cameras[1].rotation - R).max() < 1e-12
        assert np.abs(rig.cameras[1].translation - T).max() < 1e-12


def test_one_file_is_one_camera(tmp_path: Path) -> None:
    left, _ = pair()
    rig = read_foreign_rig(put(tmp_path, left__yaml=left) / "left.yaml")
    assert rig.names == ["left"]
    assert any("give both files" in note for note in rig.notes)


def test_binning_and_a_region_of_interest_are_noted(tmp_path: Path) -> None:
    left, right = pair()
    plain = "binning_x: 0\nbinning_y: 1\nroi: {x_offset: 0, y_offset: 0, width: 0, height: 0, do_rectify: false}\n"
    for more, noted in (
        (plain, False),
        (plain.replace("width: 0, height: 0", "width: 1280, height: 800"), False),
        (plain.replace("_x: 0", "_x: 2"), True),
        (plain.replace("x_offset: 0", "x_offset: 100"), True),
        (plain.replace("height: 0", "height: 400"), True),
    ):
        folder = put(tmp_path, left__yaml=left, right__yaml=right + more)
        for given, names in ((folder, "camera right"), (folder / "right.yaml", "camera right")):
            found = [note for note in read_foreign_rig(given).notes if "binning" in note]
            assert [note.startswith(names) for note in found] == [True] * noted


def test_the_message_itself_is_read_too(tmp_path: Path) -> None:
    text = yaml.safe_dump({"width": 640, "height": 480, "distortion_model": "equidistant", "D": [0.1, 0.2, 0.0, 0.0],
                           "K": K1.ravel().tolist(), "R": [0.0] * 9, "P": [0.0] * 12})  # fmt: skip
    rig = read_foreign_rig(put(tmp_path, cam__yaml=text) / "cam.yaml")
    assert (rig.names, rig.cameras[0].lens.model, rig.cameras[0].image_size) == (["cam"], "fisheye", (640, 480))


def test_what_is_no_rig_is_said(tmp_path: Path) -> None:
    left, right = pair()
    plain = np.concatenate((K1, np.zeros((3, 1))), axis=1)
    singles = {f"{name}__yaml": info(name, K1, D1, np.eye(3), plain) for name in "ab"}
    with pytest.raises(InputError, match="two files without Tx"):
        read_foreign_rig(put(tmp_path / "a", **singles))
    with pytest.raises(InputError, match=r"3 files: .*/tf"):
        read_foreign_rig(put(tmp_path / "b", left__yaml=left, right__yaml=right, a__yaml=singles["a__yaml"]))
    with pytest.raises(InputError, match="distortion_model 'thin'"):
        read_foreign_rig(put(tmp_path / "c", a__yaml=info("a", K1, D1, np.eye(3), plain, "thin")))


@pytest.mark.parametrize("backwards", [False, True])
def test_written_as_a_rectified_pair(tmp_path: Path, backwards: bool) -> None:
    """By ROS's own formula, a point of the rectified frame comes to where the cameras see it."""
    rig = rig_of(brown(-0.1, 0.02, 0.001, 0, 0.003), brown(0.05, 0, 0, 0, 0, 0.1), names=("a", "b"))
    if backwards:
        rig = type(rig)(rig.format, rig.cameras[::-1], rig.unit, rig.frame)
    folder = put_files(tmp_path, convert_rig(rig, "ros", "x").files)
    contents = [yaml.safe_load((folder / f"{name}.yaml").read_text()) for name in rig.names]
    points = np.array([[150.0, 30.0, 1200.0], [50.0, -80.0, 1000.0], [100.0, 160.0, 2500.0]])
    left_r = np.array(contents[0]["rectification_matrix"]["data"]).reshape(3, 3)
    rectified = rig.cameras[0].in_camera(points) @ left_r.T / 1000
    for content, camera in zip(contents, rig.cameras, strict=True):
        k, d, r, p = (
            np.array(content[key]["data"]).reshape(content[key]["rows"], -1)
            for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
        )
        assert p[1, 2] == contents[0]["projection_matrix"]["data"][6]  # rows agree
        here = (rectified + np.array([p[0, 3] / p[0, 0], 0, 0])) @ r
        assert (
            np.abs(cv2.projectPoints(here, np.zeros(3), np.zeros(3), k, d)[0][:, 0] - camera.project(points)).max()
            < 1e-8
        )
    focal, tx = contents[1]["projection_matrix"]["data"][0], contents[1]["projection_matrix"]["data"][3]
    baseline = np.linalg.norm(rig.cameras[0].centre - rig.cameras[1].centre) / 1000
    assert tx == pytest.approx(focal * baseline * (1 if backwards else -1))
    back = read_in_mm(folder)
    assert back.names == rig.names
    assert apart(rig, back) < 1e-8


def test_a_fisheye_is_equidistant(tmp_path: Path) -> None:
    rig = rig_of(fisheye(0.01, -0.02), fisheye(0.02))
    folder = put_files(tmp_path, convert_rig(rig, "ros", "x").files)
    assert yaml.safe_load((folder / "side0.yaml").read_text())["distortion_model"] == "equidistant"
    assert apart(rig, read_in_mm(folder)) < 1e-8


def test_cameras_one_behind_the_other_are_no_pair() -> None:
    rig = rig_of(brown(), brown())
    first, second = rig.cameras
    behind = type(second)(
        second.name, second.lens, second.image_size, first.rotation, first.translation + np.array([0, 0, 500.0])
    )
    with pytest.raises(
        InputError, match=r"--to ros: camera \S+ is above, below, before or behind camera \S+, .*side by side"
    ):
        convert_rig(type(rig)("test", (first, behind), "mm", "x"), "ros", "x")
