"""Images or rigs in other conventions are refused by name; a capture that fails for another reason is not."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.pipeline.conventions import lines_of_sight_miss, other_readings, require_meeting_rays
from imgcal.pipeline.lines_of_sight import choose_telling_snapshots, mean_miss, sight_angles
from imgcal.pipeline.turned_images import WAYS, turn, undo
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import CameraRig, Detections
from tests.imgcal.association.stick_scenes import TRIPLE, capture
from tests.imgcal.pipeline.short_search import SHORT


@cache
def seen(name: str) -> tuple[CameraRig, Detections]:
    rig = imgcal.load_rig(name).to(torch.float64)
    truth = simulate_truth(rig, imgcal.load_object("asymmetric8"), 6, torch.Generator().manual_seed(0), PhysicalDrift())
    blobs = true_detections(truth)
    return rig, replace(blobs, uv=blobs.uv + 0.05 * np.random.default_rng(0).standard_normal(blobs.uv.shape))


Change = Callable[[CameraRig, Detections], tuple[CameraRig, Detections]]


def with_images(function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Change:
    def change(rig: CameraRig, blobs: Detections) -> tuple[CameraRig, Detections]:
        return rig, replace(blobs, uv=function(blobs.uv, rig.image_size.double().numpy()[blobs.camera]))

    return change


def with_poses(function: Callable[[RigidTransform], RigidTransform]) -> Change:
    return lambda rig, blobs: (replace(rig, cam_from_rig=function(rig.cam_from_rig)), blobs)


def flipped(pose: RigidTransform) -> RigidTransform:
    flip = pose.rotation.new_tensor([1.0, -1.0, -1.0])
    return RigidTransform(flip[:, None] * pose.rotation, flip * pose.translation)


def at_positions(pose: RigidTransform) -> RigidTransform:
    return RigidTransform(pose.rotation, pose.inverse().translation)


MISTAKES = {
    "v from the bottom": (
        with_images(lambda uv, size: np.stack((uv[:, 0], size[:, 1] - 1 - uv[:, 1]), 1)),
        "all images seem to be mirrored top to bottom .as if v were counted from the bottom.; read like that",
    ),
    "u from the right": (
        with_images(lambda uv, size: np.stack((size[:, 0] - 1 - uv[:, 0], uv[:, 1]), 1)),
        "all images seem to be mirrored left to right .as if u were counted from the right.; read like that",
    ),
    "upside down": (with_images(lambda uv, size: size - 1 - uv), "all images seem to be turned by 180 degrees"),
    "inverse poses": (
        with_poses(RigidTransform.inverse),
        ".*the rig's poses seem to take a camera to the rig, expected",
    ),
    "OpenGL": (with_poses(flipped), "the rig's cameras seem to look along -z with y up"),
    "positions": (with_poses(at_positions), "the rig's translations seem to be positions of the cameras"),
}


# Every mistake with and without labels, and with both rigs.
@pytest.mark.parametrize(("mistake", "name", "labelled"), [
    (mistake, name, (number + (name == "T4")) % 2 == 0)
    for number, mistake in enumerate(MISTAKES)
    for name in ("O10", "T4")
])  # fmt: skip
def test_another_convention_is_refused_and_named(name: str, mistake: str, labelled: bool) -> None:
    change, expected = MISTAKES[mistake]
    rig, blobs = seen(name)
    if not labelled:
        blobs = replace(blobs, fiducial=np.full_like(blobs.fiducial, -1))
    rig, blobs = change(rig, blobs)
    with pytest.raises(RefusedError, match=rf"^{expected}.*; so "):
        imgcal.calibrate(blobs, rig, imgcal.load_object("asymmetric8"), SHORT)


def keep_little(blobs: Detections, snapshots: int) -> Detections:
    """Keep three blobs in each of two cameras of the first snapshots."""
    rank = np.zeros(len(blobs.uv), dtype=int)
    for snapshot in range(snapshots):
        for camera in range(2):
            rows = np.flatnonzero((blobs.snapshot == snapshot) & (blobs.camera == camera))
            rank[rows[3:]] = 1
    return blobs.select((blobs.snapshot >= snapshots) | ((blobs.camera < 2) & (rank == 0)))


def test_a_snapshot_that_few_cameras_see_hides_no_convention() -> None:
    rig, blobs = MISTAKES["v from the bottom"][0](*seen("O10"))
    blobs = keep_little(replace(blobs, fiducial=np.full_like(blobs.fiducial, -1)), 1)
    with pytest.raises(RefusedError, match=r"^all images seem to be mirrored top to bottom"):
        imgcal.calibrate(blobs, rig, imgcal.load_object("asymmetric8"), SHORT)


def test_snapshots_that_many_cameras_see_are_asked() -> None:
    rig, blobs = seen("O10")
    assert choose_telling_snapshots(keep_little(blobs, 4), rig.num_cameras, 2).tolist() == [4, 5]
    assert choose_telling_snapshots(blobs.select(blobs.camera == 0), rig.num_cameras).size == 0
    assert choose_telling_snapshots(blobs.select(np.zeros(0, dtype=int)), rig.num_cameras).size == 0


def test_nothing_to_compare_is_no_miss() -> None:
    rig, blobs = seen("O10")
    alone = blobs.select(blobs.camera == 0)
    assert mean_miss(alone, rig) is None and not lines_of_sight_miss(alone, rig)


@pytest.mark.parametrize("labelled", [True, False])
def test_two_exchanged_cameras_are_named(labelled: bool) -> None:
    rig = imgcal.load_rig("O10").to(torch.float64)
    obj = imgcal.load_object("cube8")
    truth = simulate_truth(rig, obj, 8, torch.Generator().manual_seed(0), PhysicalDrift())
    blobs = true_detections(truth)
    exchanged = np.where(blobs.camera == 1, 2, np.where(blobs.camera == 2, 1, blobs.camera))
    blobs = replace(blobs, camera=exchanged, fiducial=blobs.fiducial if labelled else np.full_like(blobs.fiducial, -1))
    with pytest.raises(RefusedError, match=r"^cameras cam02 and cam03 seem to be exchanged"):
        imgcal.calibrate(blobs, rig, obj)


def test_another_object_is_no_other_convention() -> None:
    rig, blobs = seen("T4")
    unlabelled = replace(blobs, fiducial=np.full_like(blobs.fiducial, -1))
    with pytest.raises(RefusedError, match=r"^(identity|camera|estimation)") as caught:
        imgcal.calibrate(unlabelled, rig, imgcal.load_object("wand4"))
    assert "seem" not in caught.value.reason


def test_lines_of_sight_meet_in_our_convention_only() -> None:
    """Around a room, the directions alone tell the readings apart."""
    rig = imgcal.load_rig("room10").to(torch.float64)
    generator = torch.Generator().manual_seed(1)
    points = 2000 * torch.rand(6, 3, generator=generator, dtype=torch.float64) + torch.tensor([-1000.0, -1000.0, 0.0])
    offsets = 60 * torch.randn(5, 3, generator=generator, dtype=torch.float64)
    image = rig.expand(6).project(points[:, None] + offsets)
    snapshot, camera, fiducial = np.nonzero(image.visible.numpy())
    blobs = Detections(
        uv=image.uv.numpy()[snapshot, camera, fiducial], sigma=np.full(len(snapshot), 0.05), camera=camera,
        snapshot=snapshot, fiducial=np.full_like(fiducial, -1), radius=np.full(len(snapshot), np.nan),
        flags=np.zeros(len(snapshot), dtype=np.uint8), camera_names=rig.camera_names,
        snapshot_names=tuple("012345"),
    )  # fmt: skip
    own = float(np.nanmean(sight_angles(blobs, rig)))
    assert own < np.radians(0.5)
    for reading in other_readings(blobs, rig):
        miss = mean_miss(reading.detections, reading.rig)
        assert miss is not None and miss > 3 * own + np.radians(0.5), reading.words


def test_each_way_to_turn_an_image_has_its_name_and_is_undone() -> None:
    assert len(set(WAYS.values())) == len(WAYS)
    uv, last = np.array([[3.0, 1.0], [0.0, 5.0]]), np.array([9.0, 9.0])
    for way in WAYS:
        np.testing.assert_array_equal(turn(turn(uv, last, way), last, undo(way)), uv)
    (clockwise,) = (way for way, name in WAYS.items() if name == "turned clockwise by 90 degrees")
    np.testing.assert_array_equal(turn(np.zeros((1, 2)), last, clockwise), [[9.0, 0.0]])  # top left to top right


SPOT = ((0.0, 0.0, 0.0),)


@pytest.mark.parametrize("points", [TRIPLE, SPOT])
@pytest.mark.parametrize(("mistake", "expected"), [
    ("v from the bottom", "all images seem to be mirrored top to bottom"),
    ("OpenGL", "the rig's cameras seem to look along -z"),
    ("exchanged", "cameras cam02 and cam05 seem to be exchanged"),
    ("shifted", "the names of all cameras seem to be shifted against those of the rig"),
])  # fmt: skip
def test_rays_that_meet_show_conventions_and_names_without_a_pattern(points, mistake: str, expected: str) -> None:
    rig, obj, blobs, _ = capture(points, 24, false=1)
    rig = rig.to(torch.float64)
    if mistake == "exchanged":
        blobs = replace(blobs, camera=np.array([0, 4, 2, 3, 1, 5, 6, 7, 8, 9])[blobs.camera])
    elif mistake == "shifted":
        blobs = replace(blobs, camera=(blobs.camera - 1) % rig.num_cameras)
    else:
        rig, blobs = MISTAKES[mistake][0](rig, blobs)
    with pytest.raises(RefusedError, match=rf"^{expected}.*; read like that, blobs of three .*; so "):
        imgcal.calibrate(blobs, rig, obj)


def test_rays_that_meet_as_they_are_hide_no_refusal() -> None:
    rig, _, blobs, _ = capture(TRIPLE, 12, false=1)
    require_meeting_rays(RefusedError("of another kind"), blobs, rig.to(torch.float64))
    require_meeting_rays(RefusedError("nothing"), blobs.select(np.zeros(0, dtype=int)), rig.to(torch.float64))
