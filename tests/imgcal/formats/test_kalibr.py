from pathlib import Path

import numpy as np
import pytest
import yaml

from imgcal.errors import InputError, RefusedError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.chains import compose, inverse
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of

DRAW = np.random.default_rng(8)


def camera(**more: object) -> dict[str, object]:
    return {
        "camera_model": "pinhole", "intrinsics": [900.0, 901.0, 640.0, 400.0], "distortion_model": "radtan",
        "distortion_coeffs": [-0.1, 0.02, 0.001, -0.002], "resolution": [1280, 800], **more,
    }  # fmt: skip


def pose() -> tuple[np.ndarray, np.ndarray]:
    return rotation_from_vector(DRAW.normal(size=3) * 0.3), DRAW.normal(size=3) * 0.2


def rows(one: tuple[np.ndarray, np.ndarray]) -> list[list[float]]:
    return [[*row, t] for row, t in zip(one[0].tolist(), one[1].tolist(), strict=True)] + [[0.0, 0.0, 0.0, 1.0]]


def read(tmp_path: Path, content: dict[str, object], head: str = ""):
    return read_foreign_rig(put(tmp_path, camchain__yaml=head + yaml.safe_dump(content)) / "camchain.yaml")


def test_poses_are_a_chain(tmp_path: Path) -> None:
    first, second = pose(), pose()
    content = {"cam0": camera(), "cam1": camera(T_cn_cnm1=rows(first)), "cam2": camera(T_cn_cnm1=rows(second))}
    rig = read(tmp_path, content)
    assert (rig.format, rig.unit, rig.frame) == ("kalibr", "m", "camera cam0")
    expected = compose(second, first)
    assert np.allclose(rig.cameras[2].rotation, expected[0])
    assert np.allclose(rig.cameras[2].translation, expected[1])
    assert rig.cameras[1].lens.coefficients == (-0.1, 0.02, 0.001, -0.002)


def test_poses_that_contradict_each_other_are_noted(tmp_path: Path) -> None:
    between, of_imu = pose(), pose()
    for agrees in (True, False):
        imu = compose(between, of_imu) if agrees else compose(pose(), of_imu)
        content = {
            "cam0": camera(T_cam_imu=rows(of_imu)),
            "cam1": camera(T_cam_imu=rows(imu), T_cn_cnm1=rows(between)),
        }
        rig = read(tmp_path, content)
        assert np.allclose(rig.cameras[1].translation, between[1])
        found = [note for note in rig.notes if "contradict" in note]
        assert [note.startswith("cam1 from imu:") for note in found] == [True] * (not agrees)


def test_variants_of_extrinsics(tmp_path: Path) -> None:
    between, of_imu = pose(), pose()
    flat = np.array(rows(between)).ravel().tolist()
    variants = [
        {"cam0": camera(), "cam1": camera(), "T_cam1_cam0": rows(between)},
        {"cam0": camera(), "cam1": camera(), "T_cam1_cam0": {"rows": 4, "cols": 4, "data": flat}},
        {"cam0": camera(), "cam1": camera(), "T_cam0_cam1": rows(inverse(between))},
        {"cam0": camera(T_cam_imu=rows(of_imu)), "cam1": camera(T_cam_imu=rows(compose(between, of_imu)))},
        {
            "cam0": camera(T_imu_cam=rows(inverse(of_imu))),
            "cam1": camera(T_imu_cam=rows(inverse(compose(between, of_imu)))),
        },
        {"cam0": camera(T_cam_imu=rows(of_imu)), "cam1": camera(T_cam_imu=rows(pose()), T_cn_cnm1=rows(between))},
    ]
    for content in variants:
        rig = read(tmp_path, content, "%YAML:1.0\n---\n")
        assert np.allclose(rig.cameras[1].rotation, between[0], atol=1e-9)
        assert np.allclose(rig.cameras[1].translation, between[1], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera_model": "omni", "intrinsics": [1.0, 900, 901, 640, 400]}, "omnidirectional"),
        ({"camera_model": "ds", "intrinsics": [0.1, 0.5, 900, 901, 640, 400]}, "double sphere"),
        ({"camera_model": "eucm"}, "extended unified"),
        ({"distortion_model": "fov", "distortion_coeffs": [0.9]}, "FOV"),
        ({"intrinsics": None}, "intrinsics: found None"),
        ({"distortion_coeffs": [0.1, 0.2]}, "found 2 distortion coefficients"),
        ({"distortion_model": "spline"}, "pinhole-spline"),
        ({"T_cn_cnm1": [[1, 0, 0, 1]] * 4}, "T_cn_cnm1"),
    ],
)
def test_what_is_refused(tmp_path: Path, change: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=rf"this is a Kalibr camchain: cam1: .*{said}|{said}"):
        read(tmp_path, {"cam0": camera(), "cam1": {**camera(T_cn_cnm1=rows(pose())), **change}})


def test_a_camera_without_a_link_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="camera cam1: no pose relative to cam0"):
        read(tmp_path, {"cam0": camera(), "cam1": camera()})


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0.001, -0.0004), fisheye(0.01, -0.02, 0.003, -0.001), brown())
    made = convert_rig(rig, "kalibr", "x")
    path = put_files(tmp_path, made.files)
    content = yaml.safe_load(path.read_text())
    assert list(content) == ["cam0", "cam1", "cam2"]
    assert [content[name]["distortion_model"] for name in content] == ["radtan", "equidistant", "radtan"]
    assert np.shape(content["cam2"]["T_cn_cnm1"]) == (4, 4)
    assert "T_cn_cnm1" not in content["cam0"]
    assert apart(rig, read_in_mm(path)) < 1e-8
    assert any("have other names" in note for note in made.notes)


def test_a_fifth_coefficient_is_fitted_or_refused() -> None:
    slight, strong = brown(-0.1, 0.02, 0, 0, 0.0002), brown(-0.3, 0.1, 0, 0, -0.05)
    assert 0 < convert_rig(rig_of(slight, brown()), "kalibr", "x").between_models < 0.05
    with pytest.raises(RefusedError, match="Kalibr camchain cannot express its lens"):
        convert_rig(rig_of(strong, brown()), "kalibr", "x")
