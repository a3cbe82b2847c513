"""Which format a file is; and the gate: real files of every tool, against pixels that other programs have computed."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import FORMATS, Files, ForeignRig, find_format, is_foreign, read_foreign_rig
from imgcal.formats.file_storage import storage_text
from imgcal.formats.registry import read_foreign_lenses
from imgcal.io import data_path
from imgcal.types import limits
from tests.imgcal.formats.rigs import brown, put, put_files, read_in_mm, rig_of

SAMPLES = {
    "anipose/melokeo_4cam.toml": "anipose",
    "caliscope/post_optimization/camera_array.toml": "caliscope",
    "caliscope/post_optimization/config.toml": "caliscope",
    "caliscope/quality_control/camera_array.toml": "caliscope",
    "colmap/rig4_bin": "colmap-binary",
    "colmap/rig4_rig_config.json": "colmap-rig-config",
    "colmap/rig4_txt": "colmap",
    "easymocap/anerf_6cam": "easymocap",
    "freemocap/session_camera_calibration.toml": "freemocap",
    "kalibr/hdpr_7cam.yaml": "kalibr",
    "kalibr/kumar_mixed.yaml": "kalibr",
    "mrcal/opencv8_pair": "mrcal",
    "multical/rig_4cam_master.json": "multical",
    "opencv/multiview_cv5_4cam.yaml": "opencv-multiview",
    "opencv/stereo_unlook": "opencv-stereo",
    "optitrack_mcal/cork_260414_1415.mcal": "motive",
    "pose2sim/Calib_qualisys.toml": "pose2sim",
    "pymvg/example_3cam.json": "pymvg",
    "qualisys/pose2sim_demo.qca.txt": "qualisys",
    "ros_camera_info/mono_test_calibration.yaml": "ros",
    "ros_camera_info/zed": "ros",
}
WORST = 1e-6  # px


@pytest.mark.parametrize("name", SAMPLES)
def test_real_files_are_where_other_programs_put_them(formats: Path, name: str) -> None:
    expected = json.loads((formats / f"{name}.expected.json").read_text())
    unit = "mm" if "mm" in expected["unit_note"].split(";")[0] else "m"
    rig = read_in_mm(formats / name, unit)
    assert rig.format == SAMPLES[name]
    for camera, row in zip(rig.cameras, expected["cameras"], strict=True):
        uv = camera.project(np.array(row["points_rig_mm"]))
        assert np.abs(uv - np.array(row["uv"])).max() < WORST
        assert camera.image_size in (None, tuple(row["image_size"]))


def test_cameras_of_images_alone(formats: Path) -> None:
    """Images of two cameras in three moments, without a rig: the rig's frame is COLMAP's world in the first of them."""
    expected = json.loads((formats / "colmap/kapture_t265.expected.json").read_text())
    rig = read_in_mm(formats / "colmap/kapture_t265", "m")
    assert rig.names == ["rightraw", "leftraw"]
    for camera, row in zip(rig.cameras, expected["cameras"], strict=False):
        assert row["name"] == f"{camera.name}/frame_000000001.jpg"
        assert np.abs(camera.project(np.array(row["points_rig_mm"])) - np.array(row["uv"])).max() < WORST


@pytest.mark.parametrize("name", [one.name for one in FORMATS])
def test_a_format_that_the_user_names_must_be_possible(tmp_path: Path, name: str) -> None:
    for content in ("a: 1\n", "cam0: {camera_model: pinhole}\n"):
        with pytest.raises(InputError, match=r"this is no|this is a"):
            read_foreign_rig(put(tmp_path, a__yaml=content) / "a.yaml", name)


def test_formats_by_name() -> None:
    assert find_format("kalibr").title == "Kalibr camchain"
    assert len({one.name for one in FORMATS}) == len(FORMATS)
    with pytest.raises(InputError, match=r"found the format 'calibr', expected one of imgcal, anipose"):
        find_format("calibr")


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (
            {"a__yaml": "a: 1\n"},
            r"found none of the keys of a calibration \(its keys: a\), expected a rig file",
        ),
        ({"a__yaml": ""}, "found none of the keys"),
        ({"a__yaml": "a: [\n"}, "not valid YAML"),
        ({"README__md": "# Rig\nThe cameras: these are where\n they have always been: there.\n"}, "begins `# Rig`"),
        ({"README": "<p align=center>\nThis is the rig of the hall.\n"}, "people .it begins `<p align=center>`., exp"),
        (
            {"a__md": "[![x](y)]\nThis is the rig of the hall.\n"},
            "begins .*expected `format: imgcal-rig/1`, or the cal",
        ),
        (
            {"a__yml": storage_text({"camera_matrix": np.eye(3), "distortion_coefficients": np.zeros((1, 5))})},
            "one camera",
        ),
        ({"a__json": '{"frames": [{"transform_matrix": []}]}'}, "nerfstudio"),
        ({"a__yml": storage_text({"R": np.eye(3), "T": np.zeros((3, 1))})}, "with only extrinsics"),
        ({"a__cal": b"\0" * 50}, "binary"),
    ],
)
def test_what_is_no_rig_is_named(tmp_path: Path, files: dict[str, str | bytes], said: str) -> None:
    folder = put(tmp_path, **files)
    with pytest.raises(InputError, match=said):
        read_foreign_rig(folder / next(iter(files)).replace("__", "."))


def test_a_folder_without_a_calibration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"found b.yaml, notes.md, expected"):
        read_foreign_rig(put(tmp_path, notes__md="x", b__yaml="a: ["))


def put_calibrations(folder: Path, **names: str) -> Path:
    """Write a rig in formats, a file each; "imgcal" is one of our own."""
    rig = rig_of(brown(), brown())
    folder.mkdir(exist_ok=True)
    for file, name in names.items():
        content = data_path("rigs", "T4.yaml").read_bytes() if name == "imgcal" else write(rig, name)[""]
        put(folder, **{file: content})
    return folder


PAIRS = [
    {"camchain__yaml": "kalibr", "c__toml": "anipose"},
    {"camchain__yaml": "kalibr", "rig__yaml": "imgcal"},
    {"a__json": "multical", "b__toml": "anipose"},
    {"a__json": "pymvg", "b__json": "pymvg"},
    {"a__json": "multical", "b__json": "multical"},
]


@pytest.mark.parametrize("names", PAIRS)
def test_of_two_calibrations_none_is_taken(tmp_path: Path, names: dict[str, str]) -> None:
    folder = put_calibrations(tmp_path / "in", **names)
    one, other = (f"{file.replace('__', '.')} ({name})" for file, name in names.items())
    said = f"found ({re.escape(one)}, {re.escape(other)}|{re.escape(other)}, {re.escape(one)}): give the files of one"
    with pytest.raises(InputError, match=said):
        read_foreign_rig(folder)
    with pytest.raises(InputError, match=said):
        read_foreign_lenses(folder)
    with pytest.raises(InputError, match=said):
        read_foreign_rig([folder / file.replace("__", ".") for file in names])


def test_in_a_folder_the_user_may_name_the_format(tmp_path: Path) -> None:
    folder = put_calibrations(tmp_path / "in", a__yaml="kalibr", b__toml="anipose", rig__yaml="imgcal")
    assert read_foreign_rig(folder, "kalibr").format == "kalibr"
    assert read_foreign_rig(folder, "anipose").format == "anipose"
    with pytest.raises(InputError, match=r"found a.yaml \(kalibr\), b.toml \(anipose\): give"):
        read_foreign_rig([folder / "a.yaml", folder / "b.toml"], "kalibr")


def test_a_file_that_the_user_names_must_be_of_use(tmp_path: Path) -> None:
    folder = put_calibrations(tmp_path / "in", a__yaml="kalibr")
    put(folder, imu__yaml="imu0: {update_rate: 200}\n", notes__txt="x")
    assert read_foreign_rig(folder).format == "kalibr"
    for name in ("imu.yaml", "notes.txt"):
        with pytest.raises(InputError, match=f"{name}: found no part of a Kalibr camchain in it"):
            read_foreign_rig([folder / "a.yaml", folder / name])


def test_files_that_say_the_size_of_images_are_of_use(tmp_path: Path) -> None:
    files = write(rig_of(brown(), brown()), "opencv-stereo")
    size = storage_text({"imageSize": np.array([[1280, 960]])})
    lens = files["intrinsics.yml"].replace(b"image_width", b"a").replace(b"image_height", b"b")
    put(tmp_path, m__yml=lens, r__yml=files["extrinsics.yml"], size__yml=size)
    rig = read_foreign_rig([tmp_path / name for name in ("m.yml", "r.yml", "size.yml")])
    assert {camera.image_size for camera in rig.cameras} == {(1280, 960)}


def test_what_a_tool_made_its_file_from_may_lie_beside_it(tmp_path: Path, formats: Path) -> None:
    folder = put(tmp_path / "pose2sim", **{
        path.name.replace(".", "__"): path.read_bytes()
        for path in (formats / "pose2sim/Calib_qualisys.toml", formats / "qualisys/pose2sim_demo.qca.txt")
    })  # fmt: skip
    assert read_foreign_rig(folder).format == "pose2sim"
    model = tmp_path / "model"
    shutil.copytree(formats / "colmap/rig4_txt", model)
    shutil.copy(formats / "colmap/rig4_rig_config.json", model / "rig_config.json")
    assert read_foreign_rig(model).format == "colmap"
    assert read_foreign_rig(sorted((formats / "colmap/rig4_txt").iterdir())).format == "colmap"


def write(rig: ForeignRig, name: str) -> Files:
    one = find_format(name)
    assert one.write is not None
    return one.write(rig.in_camera_frame() if one.from_first else rig)


@pytest.mark.parametrize("name", ["colmap", "easymocap", "pymvg", "multical", "kalibr", "opencv-stereo",
                                  "opencv-multiview", "anipose", "caliscope", "freemocap", "mrcal"])  # fmt: skip
def test_cameras_that_were_never_placed_are_refused(tmp_path: Path, name: str) -> None:
    """Whether they are all at the origin or elsewhere; for lenses alone their places do not matter."""
    apart = rig_of(brown(), brown())
    for first in (apart.cameras[0], replace(apart.cameras[0], rotation=np.eye(3), translation=np.zeros(3))):
        second = replace(apart.cameras[1], rotation=first.rotation, translation=first.translation)
        path = put_files(tmp_path / "out", write(replace(apart, cameras=(first, second)), name))
        with pytest.raises(InputError, match="at one place and look the same way: extrinsics were never calibrated"):
            read_foreign_rig(path, name)
        assert len(read_foreign_lenses(path, name).cameras) == 2


def test_two_streams_of_one_device_are_noted(tmp_path: Path) -> None:
    rig = rig_of(brown(), brown(), brown(), names=("a", "ir", "colour"))
    _, ir, colour = rig.cameras
    same = replace(colour, rotation=ir.rotation, translation=ir.translation)
    for name in ("anipose", "kalibr", "multical"):
        files = write(replace(rig, cameras=(rig.cameras[0], ir, same)), name)
        found = read_foreign_rig(put_files(tmp_path / "out", files), name)
        assert len(found.cameras) == 3
        (note,) = [note for note in found.notes if "streams of one device" in note]
        assert note.startswith("cameras cam1, cam2:" if name == "kalibr" else "cameras ir, colour:")
    path = put_files(tmp_path / "apart", write(rig, "anipose"))
    assert not any("streams" in note for note in read_foreign_rig(path).notes)


def test_names_are_those_of_files(tmp_path: Path) -> None:
    table = """[{key}]
name = "{name}"
size = [640, 480]
matrix = [[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]
distortions = [0.0, 0, 0, 0, 0]
rotation = [0, {turn}, 0]
translation = [0, 0, {turn}]
"""
    names = ["cam/left", "cam_left", "..", "right"]
    text = "\n".join(table.format(key=f"cam_{n}", name=name, turn=0.1 * n) for n, name in enumerate(names))
    rig = read_foreign_rig(put(tmp_path, a__toml=text) / "a.toml")
    assert rig.names == ["cam_left", "cam_left_2", "camera3", "right"]
    assert any("cam/left -> cam_left" in note for note in rig.notes)


def test_there_are_only_so_many_cameras(tmp_path: Path) -> None:
    row = '{"name": "a", "K": [[9, 0, 3], [0, 9, 2], [0, 0, 1]], "Q": [0.1, 0, 0], "translation": [0, 0, 1]}'
    text = f'{{"camera_system": [{",".join([row] * (limits.MOST_CAMERAS + 1))}]}}'
    with pytest.raises(InputError, match="found 257 cameras"):
        read_foreign_rig(put(tmp_path, a__json=text) / "a.json")


def test_our_own_files_are_told_from_others(tmp_path: Path) -> None:
    assert not is_foreign(data_path("rigs", "O10.yaml"))
    assert is_foreign(put(tmp_path, a__yaml="cam0: {}"))
    assert is_foreign(tmp_path / "a.yaml")
    assert not is_foreign(tmp_path / "nothing")
