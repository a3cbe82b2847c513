import numpy as np
import pytest

from imgcal.formats.chains import compose, inverse
from imgcal.formats.colmap_model import (
    COUNTS,
    ColmapCamera,
    ColmapImage,
    ColmapRig,
    model_from_rig,
    pose_numbers,
    rig_from_model,
)
from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import brown, rig_of

DRAW = np.random.default_rng(3)
CAMERAS = [ColmapCamera(n, "PINHOLE", (1280, 800), (900.0, 901.0, 640.0, 400.0)) for n in (1, 2)]


def pose() -> tuple[np.ndarray, np.ndarray]:
    return rotation_from_vector(DRAW.normal(size=3) * 0.3), DRAW.normal(size=3)


@pytest.mark.parametrize(
    ("model", "parameters", "focal", "centre", "coefficients"),
    [
        ("SIMPLE_PINHOLE", (900, 640, 400), (900, 900), (639.5, 399.5), ()),
        ("PINHOLE", (900, 901, 640, 400), (900, 901), (639.5, 399.5), ()),
        ("SIMPLE_RADIAL", (900, 640, 400, 0.1), (900, 900), (639.5, 399.5), (0.1,)),
        ("RADIAL", (900, 640, 400, 0.1, 0.2), (900, 900), (639.5, 399.5), (0.1, 0.2)),
        ("OPENCV", (900, 901, 640, 400, 1, 2, 3, 4), (900, 901), (639.5, 399.5), (1, 2, 3, 4)),
        ("FULL_OPENCV", (900, 901, 640, 400, *range(8)), (900, 901), (639.5, 399.5), tuple(range(8))),
        ("OPENCV_FISHEYE", (900, 901, 640, 400, 1, 2, 3, 4), (900, 901), (639.5, 399.5), (1, 2, 3, 4)),
        ("RADIAL_FISHEYE", (900, 640, 400, 0.1, 0.2), (900, 900), (639.5, 399.5), (0.1, 0.2)),
    ],
)
def test_lenses(model: str, parameters: tuple, focal: tuple, centre: tuple, coefficients: tuple) -> None:
    lens = ColmapCamera(1, model, (1280, 800), parameters).lens()
    assert (lens.focal_length, lens.principal_point, lens.coefficients) == (focal, centre, coefficients)
    assert lens.model == ("fisheye" if "FISHEYE" in model else "opencv")


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "NEW"])
def test_lenses_without_counterpart(model: str) -> None:
    with pytest.raises(FormatError, match=f"the model {model} has no counterpart"):
        ColmapCamera(1, model, (1280, 800), (900.0,) * COUNTS.get(model, 3)).lens()


def images(poses: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[ColmapImage]:
    return [ColmapImage(n, one, 1 if name.startswith("a") else 2, name) for n, (name, one) in enumerate(poses.items())]


def test_images_of_fixed_cameras_are_a_rig() -> None:
    first, later, b_from_a = pose(), pose(), pose()
    taken = {
        "a/0.png": first,
        "b/0.png": compose(b_from_a, first),
        "b/1.png": compose(b_from_a, later),
        "a/1.png": later,
    }
    rig = rig_from_model("colmap", CAMERAS, images(taken), [])
    assert (rig.names, rig.unit) == (["a", "b"], None)
    assert np.allclose(rig.cameras[1].translation, compose(b_from_a, first)[1])  # the world, at the first frame
    taken["b/1.png"] = pose()
    with pytest.raises(FormatError, match="camera b has another pose relative to a in '1'"):
        rig_from_model("colmap", CAMERAS, images(taken), [])


def test_cameras_of_other_moments_are_linked_through_those_that_they_share() -> None:
    from_rig = {name: pose() for name in "abcdef"}
    moments = {"0": "abc", "1": "db", "2": "ed", "3": "f"}
    taken = {}
    for frame, cameras in moments.items():
        rig_from_world = pose()
        taken |= {f"{camera}/{frame}.png": compose(from_rig[camera], rig_from_world) for camera in cameras}
    rig = rig_from_model("colmap", CAMERAS, images(taken), [])
    assert rig.names == ["a", "b", "c", "d", "e"]
    for camera in rig.cameras:
        linked = camera.in_frame_of(rig.cameras[0])
        expected = compose(from_rig[camera.name], inverse(from_rig["a"]))
        assert np.allclose(linked.rotation, expected[0]) and np.allclose(linked.translation, expected[1])
    assert "camera f: left out, no image that links it to a" in rig.notes
    assert any("; cameras d, e: linked through other images" in note for note in rig.notes)
    taken |= {"d/4.png": pose(), "b/4.png": pose()}
    with pytest.raises(FormatError, match="camera d has another pose relative to b in '4'"):
        rig_from_model("colmap", CAMERAS, images(taken), [])


def test_images_of_no_common_moment_are_no_rig() -> None:
    with pytest.raises(FormatError, match="found no rig, and no two cameras with images of one moment"):
        rig_from_model("colmap", CAMERAS, images({"a/0.png": pose(), "b/1.png": pose()}), [])


def test_images_of_one_moment_are_a_rig() -> None:
    taken = {"a_left.png": pose(), "b_right.png": pose()}
    rig = rig_from_model("colmap", CAMERAS, images(taken), [ColmapRig(1, {1: None}), ColmapRig(2, {2: None})])
    assert rig.names == ["a_left", "b_right"]
    with pytest.raises(FormatError, match="found no rig and 1 images"):
        rig_from_model("colmap", CAMERAS, images(taken)[:1], [])


def test_several_images_of_a_camera_in_one_folder_are_noted() -> None:
    taken = {f"{camera}_{moment}.png": pose() for moment in range(3) for camera in "ab"}
    (note,) = [note for note in rig_from_model("colmap", CAMERAS, images(taken), []).notes if "rigs.txt" in note]
    assert note.startswith("found no rigs.txt, and 6 images in one folder with 2 sets of intrinsics: treated as")
    taken = {"a_0.png": pose(), "b_0.png": pose()}
    assert not any("rigs.txt" in note for note in rig_from_model("colmap", CAMERAS, images(taken), []).notes)


def test_a_rig_names_cameras_by_the_folders_of_their_images() -> None:
    rigs = [ColmapRig(1, {1: (np.eye(3), np.zeros(3)), 2: pose()})]
    taken = {"a/left/0.png": pose(), "b/right/0.png": pose()}
    assert rig_from_model("colmap", CAMERAS, images(taken), rigs).names == ["left", "right"]
    assert rig_from_model("colmap", CAMERAS, [], rigs).names == ["1", "2"]
    with pytest.raises(FormatError, match="camera 2 without a pose"):
        rig_from_model("colmap", CAMERAS, [], [ColmapRig(1, {1: (np.eye(3), np.zeros(3)), 2: None})])


def test_one_of_several_rigs_is_chosen_by_name() -> None:
    eye = (np.eye(3), np.zeros(3))
    rigs = [ColmapRig(1, {1: eye, 2: pose()}), ColmapRig(5, {2: eye, 1: pose()})]
    with pytest.raises(FormatError, match=r"found 2 rigs \(1, 5\): choose one with imgcal convert --source-rig 1"):
        rig_from_model("colmap", CAMERAS, [], rigs)
    assert rig_from_model("colmap", CAMERAS, [], rigs, "5").frame == "rig 5 (its reference camera)"
    with pytest.raises(FormatError, match="--source-rig: found 7, expected one of 1, 5"):
        rig_from_model("colmap", CAMERAS, [], rigs, "7")


def test_a_rig_taken_apart() -> None:
    rig = rig_of(brown(-0.1), brown(0, 0, 0, 0, 0, 0.1), brown())
    cameras, images_, colmap_rig, rig_from_world = model_from_rig(rig)
    assert [camera.model for camera in cameras] == ["OPENCV", "FULL_OPENCV", "PINHOLE"]
    assert cameras[0].parameters[2] == rig.cameras[0].lens.principal_point[0] + 0.5
    sensor = colmap_rig.sensors[3]
    assert sensor is not None
    together = compose(sensor, rig_from_world)
    assert np.allclose(together[1], images_[2].pose[1])
    assert np.allclose(compose(together, inverse(images_[2].pose))[0], np.eye(3))
    assert np.allclose(pose_numbers((np.eye(3), np.ones(3))), [1, 0, 0, 0, 1, 1, 1])
