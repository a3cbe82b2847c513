import json
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from tests.imgcal.formats.rigs import apart, brown, fisheye, put, put_files, read_in_mm, rig_of

CAMERAS = "# x\n1 PINHOLE 1280 800 900 901 640 400\n2 SIMPLE_RADIAL 1280 800 900 640 400 0.01\n"
IMAGES = "# two rows each\n1 1 0 0 0 0 0 0 1 a/0.png\n\n2 1 0 0 0 -0.5 0 0 2 b/0.png\n1 2 3 4 5 6\n"


def test_rows_of_points_may_be_empty_and_commas_may_separate(tmp_path: Path) -> None:
    for images in (IMAGES, IMAGES.replace(" 0", ", 0")):
        rig = read_foreign_rig(put(tmp_path, cameras__txt=CAMERAS, images__txt=images))
        assert (rig.format, rig.names) == ("colmap", ["a", "b"])
        assert rig.cameras[1].lens.principal_point == (639.5, 399.5)


def test_a_rig_counts_before_images(tmp_path: Path) -> None:
    rigs = "1 3 CAMERA 1 CAMERA 2 1 1 0 0 0 -0.25 0 0 IMU 1 0\n"
    rig = read_foreign_rig(put(tmp_path, cameras__txt=CAMERAS, images__txt=IMAGES, rigs__txt=rigs) / "rigs.txt")
    assert rig.cameras[1].translation.tolist() == [-0.25, 0, 0]


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"cameras__txt": CAMERAS}, "found only intrinsics"),
        ({"cameras__txt": "1 PINHOLE 1280\n", "images__txt": IMAGES}, "line 1: found 3 values"),
        ({"cameras__txt": CAMERAS, "images__txt": "1 1 0 0\n"}, "images.txt: line 1: found 4"),
        ({"cameras__txt": CAMERAS, "rigs__txt": "1 2 CAMERA 1 CAMERA 2 1 1 0 0\n"}, "middle of a pose"),
        ({"cameras__txt": CAMERAS, "rigs__txt": "1 2 CAMERA 1 CAMERA 2 0\n"}, "without a pose"),
        ({"cameras__txt": CAMERAS.replace("PINHOLE", "FOV"), "images__txt": IMAGES}, "the model FOV"),
    ],
)
def test_what_is_no_rig_is_said(tmp_path: Path, files: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=f"this is a COLMAP model .text.: .*{said}"):
        read_foreign_rig(put(tmp_path, **files))


def test_a_rig_config_without_intrinsics_or_poses(tmp_path: Path) -> None:
    pose = {"cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [0.1, 0, 0]}
    lens = {"camera_model_name": "PINHOLE", "camera_params": [900, 901, 640, 400]}
    first = {"image_prefix": "rig1/left/", "ref_sensor": True, **lens}

    def read(*cameras: object):
        path = put(tmp_path, rig_config__json=json.dumps([{"cameras": cameras}])) / "rig_config.json"
        return read_foreign_rig(path)

    rig = read(first, {"image_prefix": "rig1/right/", **lens, **pose})
    assert (rig.format, rig.names, rig.cameras[0].image_size) == ("colmap-rig-config", ["left", "right"], None)
    with pytest.raises(InputError, match="camera right: no intrinsics"):
        read(first, {"image_prefix": "rig1/right/", **pose})
    with pytest.raises(InputError, match="fewer than two cameras"):
        read(first, {"image_prefix": "rig1/right/", **lens})


@pytest.mark.parametrize("name", ["colmap", "colmap-binary"])
def test_pycolmap_reads_what_is_written(tmp_path: Path, name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rig = rig_of(brown(-0.1, 0.02), fisheye(0.01, 0.02), brown(0, 0, 0, 0, 0.01), names=("left", "mid", "right"))
    made = convert_rig(rig, name, "x", unit="cm")
    folder = put_files(tmp_path / "model", made.files)
    model = pycolmap.Reconstruction(str(folder))
    points = np.array([[10.0, 20.0, 900.0], [-100.0, 100.0, 1500.0]])
    for image in model.images.values():
        camera = next(one for one in rig.cameras if image.name == f"{one.name}/0.png")
        in_camera = [image.cam_from_world() * (point / 10) for point in points]
        uv = np.array([image.camera.img_from_cam(point) for point in in_camera]) - 0.5
        assert np.abs(uv - camera.project(points)).max() < 1e-6
    (one,) = model.rigs.values()
    assert one.num_sensors() == 3
    back = read_in_mm(folder, "cm")
    assert back.names == rig.names
    assert apart(rig, back) < 1e-8
