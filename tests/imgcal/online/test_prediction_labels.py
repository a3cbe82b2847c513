"""Labels predicted from the previous snapshot agree with brute force and with known motions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import PipelineOptions
from imgcal.geometry import RigidTransform
from imgcal.online.prediction_labels import (
    TOO_NEAR,
    find_displaced_cameras,
    may_stand,
    near_prediction,
    relabel_moved_camera,
    spare_blobs,
    widen_poses,
)
from imgcal.synthesis import arrange_rig
from imgcal.types import Detections
from tests.imgcal.streams import Stream

CAMERA = 3


@pytest.fixture(scope="module")
def stream() -> Stream:
    return Stream("O10", "asymmetric8", 4)


def predicted(stream, s, rig=None):
    return (rig or stream.true).project(stream.poses[s].apply(stream.obj.points), stream.obj.radius).uv.numpy()


def labelled(stream, s, rig=None, **known):
    blobs, truth = stream.blobs(s, rig, **known)
    return replace(blobs, fiducial=truth)


def test_labels_are_the_mutually_nearest_within_a_quarter_of_the_gaps(stream) -> None:
    blobs, _ = stream.blobs(0, noise=6.0, false=3.0)
    uv = predicted(stream, 0)
    apart = np.linalg.norm(uv[:, :, None] - uv[:, None], axis=-1) + 1e9 * np.eye(uv.shape[1])
    reach = 0.25 * np.median(apart.min(-1))
    expected = np.full(len(blobs), -1)
    for row in range(len(blobs)):
        distance = np.linalg.norm(uv[blobs.camera[row]] - blobs.uv[row], axis=-1)
        n = int(distance.argmin())
        others = np.flatnonzero(blobs.camera == blobs.camera[row])
        back = others[np.linalg.norm(blobs.uv[others] - uv[blobs.camera[row], n], axis=-1).argmin()]
        if back == row and distance[n] < reach:
            expected[row] = n
    found = near_prediction(blobs, uv)
    np.testing.assert_array_equal(found, expected)
    assert (found >= 0).any() and (found < 0).any()


def test_fiducials_that_all_but_coincide_get_no_label(stream) -> None:
    blobs, truth = stream.blobs(0, noise=0.0)
    uv = predicted(stream, 0).copy()
    uv[2, 5] = uv[2, 4] + 0.9 * TOO_NEAR / np.sqrt(2)
    found = near_prediction(blobs, uv)
    doubtful = (blobs.camera == 2) & np.isin(truth, (4, 5))
    assert (found[doubtful] == -1).all()
    np.testing.assert_array_equal(found[~doubtful], truth[~doubtful])


def test_blobs_without_a_label_are_counted_by_camera(stream) -> None:
    blobs = labelled(stream, 0, false=2.0)
    expected = [int(((blobs.camera == c) & (blobs.fiducial < 0)).sum()) for c in range(10)]
    np.testing.assert_array_equal(spare_blobs(blobs, 10), expected)


def test_a_camera_that_moved_is_astray_and_found_again(stream) -> None:
    bumped = stream.bumped([CAMERA], turn_deg=2.0)
    blobs = labelled(stream, 2, bumped)
    truth = blobs.fiducial.copy()
    lost = replace(blobs, fiducial=np.where(blobs.camera == CAMERA, -1, truth))
    usual = np.zeros(10)
    found = find_displaced_cameras(lost, usual, stream.true, stream.obj, stream.poses[2])
    np.testing.assert_array_equal(np.flatnonzero(found), [CAMERA])
    assert not find_displaced_cameras(blobs, usual, stream.true, stream.obj, stream.poses[2]).any()
    assert not find_displaced_cameras(
        lost, usual + 8.0, stream.true, stream.obj, stream.poses[2]
    ).any()  # as many as always
    std = 0.1 * stream.rig.prior.std(stream.rig)
    again = relabel_moved_camera(lost, CAMERA, stream.true, stream.obj, stream.poses[2], std, PipelineOptions())
    assert again is not None
    named = again.fiducial[again.camera == CAMERA]
    assert (named >= 0).sum() >= 6 and (named[named >= 0] == truth[again.camera == CAMERA][named >= 0]).all()
    np.testing.assert_array_equal(again.fiducial[again.camera != CAMERA], truth[again.camera != CAMERA])


def test_a_camera_that_sees_something_else_is_not_found_again(stream) -> None:
    blobs = labelled(stream, 2)
    own = np.flatnonzero(blobs.camera == CAMERA)
    blobs.uv[own] = np.random.default_rng(0).uniform((100, 100), (1900, 1000), (len(own), 2))
    blobs.fiducial[own] = -1
    std = 0.1 * stream.rig.prior.std(stream.rig)
    assert relabel_moved_camera(blobs, CAMERA, stream.true, stream.obj, stream.poses[2], std, PipelineOptions()) is None


def test_widened_lets_a_camera_be_within_a_turn_and_as_far_off(stream) -> None:
    std = stream.rig.prior.std(stream.rig)
    wide = widen_poses(std, stream.rig, [CAMERA], stream.poses[0], stream.obj, 0.1)
    others = [c for c in range(10) if c != CAMERA]
    assert torch.equal(wide[others], std[others]) and torch.equal(wide[CAMERA, 6:], std[CAMERA, 6:])
    centre = stream.poses[0].apply(stream.obj.points).mean(0)
    distance = float((stream.rig.positions[CAMERA] - centre).norm())
    assert wide[CAMERA, :3].tolist() == pytest.approx([0.1] * 3)
    assert wide[CAMERA, 3:6].tolist() == pytest.approx([0.1 * distance] * 3)
    assert torch.equal(
        widen_poses(wide, stream.rig, [CAMERA], stream.poses[0], stream.obj, 0.01), wide
    )  # never narrower


@pytest.mark.parametrize(("camera", "stands"), [(0, True), (1, False)])
def test_a_wand_seen_end_on_says_nothing_about_its_camera(camera: int, stands: bool) -> None:
    """Three of its four markers merge; the blobs are false ones."""
    rig, wand = arrange_rig("ring", 3, 3000.0, height=0.0), imgcal.load_object("wand4")
    pose = RigidTransform(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    count, places = 5, np.random.default_rng(0).uniform(0, 200, (5, 2))  # in a corner
    zeros = np.zeros(count, dtype=np.int64)
    blobs = Detections(
        places, np.full(count, 0.1), zeros + camera, zeros, zeros - 1, np.full(count, 5.0), zeros.astype(np.uint8),
        rig.camera_names, ("0",),
    )  # fmt: skip
    assert may_stand(blobs, camera, rig, wand, pose) == stands
