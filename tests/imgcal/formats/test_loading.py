from pathlib import Path

import pytest
import torch
import yaml

import imgcal
from imgcal.errors import InputError, RefusedError
from imgcal.formats import convert_rig, load_cameras, load_rig
from imgcal.io import save_cameras, save_rig
from imgcal.types import CameraRig
from tests.imgcal.formats.rigs import brown, put, put_files, rig_of


def test_ours_as_ever(tmp_path: Path, o10: CameraRig) -> None:
    assert imgcal.load_rig is load_rig
    assert torch.equal(load_rig("O10").focal_length, o10.focal_length)
    save_rig(o10, tmp_path / "rig.yaml")
    assert torch.equal(load_rig(tmp_path / "rig.yaml").distortion, o10.distortion)
    with pytest.raises(InputError, match="O11: no such file, nor one of the shipped rigs"):
        load_rig("O11")
    with pytest.raises(InputError, match="states its own unit"):
        load_rig(tmp_path / "rig.yaml", unit="m")
    with pytest.raises(InputError, match="format"):
        load_rig(put(tmp_path, a__yaml="format: imgcal-rig/9\n") / "a.yaml")


def test_another_tool_s_is_simply_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02), brown(0.05), names=("cam0", "cam1"))
    path = put_files(tmp_path, convert_rig(rig, "kalibr", "x").files)
    ours = load_rig(path)
    assert (ours.name, ours.camera_names) == ("calibration", ("cam0", "cam1"))
    apart = torch.linalg.vector_norm(ours.positions[1] - ours.positions[0])
    assert float(apart) == pytest.approx(float(((rig.cameras[1].centre - rig.cameras[0].centre) ** 2).sum() ** 0.5))


def test_what_it_does_not_say_is_asked_for(tmp_path: Path) -> None:
    folder = put_files(tmp_path / "pair", convert_rig(rig_of(brown(-0.1), brown()), "opencv-stereo", "x").files)
    with pytest.raises(InputError, match=r'in Python load_rig.*unit="mm"'):
        load_rig(folder)
    assert load_rig(folder, unit="mm").name == "pair"
    text = (folder / "intrinsics.yml").read_text().replace("image_width", "x").replace("image_height", "y")
    (folder / "intrinsics.yml").write_text(text)
    with pytest.raises(InputError, match=r"image_size=\(1280, 720\)"):
        load_rig(folder, unit="mm")
    sizes = load_rig(folder, unit="mm", image_size={"1": (1280, 960), "2": (640, 480)}).image_size
    assert sizes.tolist() == [[1280, 960], [640, 480]]
    assert load_rig(folder, unit="mm", image_size=(1280, 960)).image_size.tolist() == [[1280, 960]] * 2


def test_cameras_need_neither_places_nor_a_unit(tmp_path: Path) -> None:
    lens = "size = [1280, 960]\nmatrix = [[900.0, 0, 640], [0, 901, 480], [0, 0, 1]]\ndistortions = [0.1, 0, 0, 0, 0]\n"
    array = "".join(f"[cameras.{n}]\ncam_id = {n}\nrotation_count = 0\n{lens}" for n in range(3))
    placed = "rotation = [0.1, 0, 0]\ntranslation = [1.0, 0, 2]\n"
    file = put(tmp_path, array__toml=array + placed) / "array.toml"
    assert load_rig(file).camera_names == ("2",)  # the only one that has a place
    cameras = load_cameras(file)
    assert cameras.camera_names == ("0", "1", "2") and not cameras.positions.any()
    assert cameras.focal_length.tolist() == [[900.0, 901.0]] * 3 and cameras.prior is not None
    anipose = put_files(tmp_path / "a", convert_rig(rig_of(brown(-0.1), brown()), "anipose", "x").files)
    with pytest.raises(InputError, match="unit"):
        load_rig(anipose)
    assert load_cameras(anipose).num_cameras == 2
    text = array.replace("matrix = ", "matrices = ", 1)
    with pytest.raises(InputError, match="camera 0: intrinsics are not calibrated"):
        load_cameras(put(tmp_path / "b", array__toml=text) / "array.toml")


def test_cameras_of_ros_are_files_of_one_camera_each(tmp_path: Path) -> None:
    for number in range(3):
        files = convert_rig(rig_of(brown(0.1 * number), names=(f"cam{number}",)), "ros", "x").files
        put_files(tmp_path / "ros", files)
    with pytest.raises(InputError, match="3 files: ROS camera_info files hold the poses of two cameras"):
        load_rig(tmp_path / "ros")
    cameras = load_cameras(tmp_path / "ros")
    assert cameras.camera_names == ("cam0", "cam1", "cam2")
    assert cameras.distortion[:, 0].tolist() == [0.0, 0.1, 0.2]


def test_cameras_of_our_own_as_ever(tmp_path: Path) -> None:
    save_cameras({"left": (640, 480)}, 60, tmp_path / "cameras.yaml")
    assert load_cameras(tmp_path / "cameras.yaml").camera_names == ("left",)
    with pytest.raises(InputError, match="absent"):
        load_cameras(tmp_path / "absent.yaml")
    pair = put_files(tmp_path / "pair", convert_rig(rig_of(brown(), brown()), "opencv-stereo", "x").files)
    text = (pair / "intrinsics.yml").read_text().replace("image_width", "x").replace("image_height", "y")
    (pair / "intrinsics.yml").write_text(text)
    with pytest.raises(InputError, match=r"image_size=\(1280, 720\)"):
        load_cameras(pair)
    assert load_cameras(pair, image_size=(1280, 960)).num_cameras == 2


def test_two_calibrations_in_one_folder_are_not_mixed(tmp_path: Path) -> None:
    for to, name in (("kalibr", "yaml"), ("pose2sim", "toml")):
        for number in (1, 2):
            files = convert_rig(rig_of(brown(-0.1 * number), brown(), names=("cam0", "cam1")), to, "x").files
            put(tmp_path / to, **{f"calibration{number}__{name}": files[""]})
        with pytest.raises(InputError, match=rf"calibration1.{name}, calibration2.{name}.*give one of these files"):
            load_rig(tmp_path / to)
        assert load_rig(tmp_path / to / f"calibration2.{name}").distortion[0, 0] == -0.2
    with pytest.raises(InputError, match=r"this is not an anipose calibration[.]toml: it is a Kalibr camchain"):
        load_rig(tmp_path / "kalibr" / "calibration1.yaml", format="anipose")


def test_a_lens_that_is_not_ours(tmp_path: Path) -> None:
    cameras = {f"cam{n}": {"camera_model": "omni", "intrinsics": [1, 2, 3, 4, 5]} for n in range(2)}
    with pytest.raises(InputError, match="this is a Kalibr camchain: cam0: an omnidirectional"):
        load_rig(put(tmp_path, a__yaml=yaml.safe_dump(cameras)) / "a.yaml")
    odd = brown(*([0.01] * 12))
    path = put_files(tmp_path / "b", convert_rig(rig_of(odd, brown()), "multical", "x").files)
    with pytest.raises(RefusedError, match="`fit_limit` allows more"):
        load_rig(path)
    assert load_rig(path, fit_limit=50.0).num_cameras == 2
    with pytest.raises(InputError, match="found the format 'x'"):
        load_rig(path, format="x")
