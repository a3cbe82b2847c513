"""Frames of an object at rest count as one, with only what differs between them averaged away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import camera_covariance
from imgcal.pipeline.rests import Rests, find_rests
from imgcal.synthesis import PhysicalDrift, Truth, simulate_truth, true_detections
from imgcal.types import Detections, MovedError

SIGMA = 0.1
FRAMES = 12
RIG = imgcal.load_rig("T4")
OBJECT = imgcal.load_object("asymmetric8")


def capture(poses: int, fixed: float, flicker: float, seed: int = 1) -> tuple[Truth, Detections]:
    """Twelve frames of each pose; errors (px) that stay as they are within a pose, and others from frame to frame."""
    truth = simulate_truth(RIG, OBJECT, poses, torch.Generator().manual_seed(seed), PhysicalDrift())
    exact, noise = true_detections(truth), np.random.default_rng(seed)
    blobs = replace(
        exact, uv=exact.uv + noise.normal(scale=max(fixed, 1e-9), size=exact.uv.shape), sigma=np.full(len(exact), SIGMA)
    )
    frames = [blobs.of_snapshots(pose, pose + 1) for pose in range(poses) for _ in range(FRAMES)]
    shaken = [replace(one, uv=one.uv + noise.normal(scale=flicker, size=one.uv.shape)) for one in frames]
    joined = Detections.join(shaken)
    return truth, replace(joined, snapshot_names=tuple(f"{number:05d}" for number in range(len(frames))))


def squared_error(truth: Truth, result: imgcal.Calibration) -> float:
    """Squared error of focal lengths and principal points over their covariance, per degree of freedom."""
    cameras, kept = RIG.num_cameras, slice(6, 10)
    covariance = camera_covariance(result.estimate).reshape(cameras, 15, cameras, 15)[:, kept, :, kept]
    found, true = (torch.cat((rig.focal_length, rig.principal_point), -1) for rig in (result.rig, truth.rig))
    error = (found - true).double().reshape(-1)
    return float(error @ torch.linalg.solve(covariance.reshape(4 * cameras, -1), error) / len(error))


@pytest.mark.parametrize(("fixed", "flicker"), [(0.1, 0.03), (0.07, 0.07), (0.0, 0.1)])
def test_uncertainty_is_that_of_errors_that_stay_within_a_rest(fixed, flicker) -> None:
    errors = []
    for seed in range(6):
        truth, blobs = capture(2, fixed, flicker, seed)
        errors.append(squared_error(truth, imgcal.calibrate(blobs, RIG, OBJECT)))
    assert 0.6 < np.mean(errors) < 1.5  # 2.5 to 5 before


def test_independent_errors_are_averaged() -> None:
    one = imgcal.calibrate(capture(3, 0.0, 0.1)[1].of_snapshots(0, 1), RIG, OBJECT)
    many = imgcal.calibrate(capture(3, 0.0, 0.1)[1].of_snapshots(0, FRAMES), RIG, OBJECT)
    sigma = float(many.observations.sigma[many.observations.seen].mean())
    assert float(one.observations.sigma[one.observations.seen].mean()) == pytest.approx(SIGMA)
    assert SIGMA / FRAMES**0.5 <= sigma < 1.5 * SIGMA / FRAMES**0.5


def test_a_rest_is_one_snapshot_and_says_so() -> None:
    _, blobs = capture(3, 0.1, 0.01)
    result = imgcal.calibrate(blobs, RIG, OBJECT)
    assert len(result.labelled.used) == 3
    assert result.labelled.moment_counts == (3 * FRAMES, 3 * FRAMES)
    assert len(result.rests.snapshots) == 3 * (FRAMES - 1)
    assert str(result.rests) == (
        "33 snapshots show the object where 3 others do, at rest or back at that place: they are averaged, "
        "and each place counts as one snapshot"
    )
    assert result.outliers == 0 and not result.tally.outliers.any() and not result.tally.unexplained.any()
    poses = result.poses_by_object[OBJECT.name]
    assert list(poses) == list(blobs.snapshot_names)
    assert torch.equal(poses["00000"].translation, poses["00011"].translation)
    assert not torch.equal(poses["00000"].translation, poses["00012"].translation)


@pytest.mark.parametrize("frame", [FRAMES + FRAMES // 2, 2 * FRAMES])
def test_a_camera_that_moves_between_or_within_rests_is_named(frame) -> None:
    """Three rests are too few snapshots for a test of their averages; their frames are not."""
    truth, blobs = capture(3, 0.0, 0.1)
    turn = torch.zeros(RIG.num_cameras, 15, dtype=torch.float64)
    turn[2, 1] = 0.003
    points = truth.rig_from_object.apply(OBJECT.points.to(torch.float64))
    before, after = (rig.expand(3).project(points).uv.numpy() for rig in (truth.rig, truth.rig.retract(turn)))
    late = blobs.snapshot >= frame
    where = blobs.snapshot[late] // FRAMES, blobs.camera[late], blobs.fiducial[late]
    uv = blobs.uv.copy()
    uv[late] += (after - before)[where]
    with pytest.raises(MovedError, match=f"camera cam03 moved before snapshot {frame:05d}"):
        imgcal.calibrate(replace(blobs, uv=uv), RIG, OBJECT)


def test_all_frames_of_a_rest_are_counted() -> None:
    _, blobs = capture(3, 0.1, 0.01)
    result = imgcal.calibrate(blobs, RIG, OBJECT)
    assert np.array_equal(result.tally.kept, result.tally.labelled)
    assert int(result.tally.kept.sum()) == int((blobs.fiducial >= 0).sum())


def test_blobs_without_labels_rest_as_well() -> None:
    _, blobs = capture(3, 0.1, 0.01)
    result = imgcal.calibrate(replace(blobs, fiducial=np.full(len(blobs), -1)), RIG, OBJECT)
    assert len(result.labelled.used) == 3


def test_a_blob_that_jumps_in_one_frame_does_not_spoil_the_average() -> None:
    _, blobs = capture(3, 0.1, 0.01)
    row = int(np.flatnonzero((blobs.snapshot == 5) & (blobs.camera == 1))[0])
    uv = blobs.uv.copy()
    uv[row] += 20.0
    result = imgcal.calibrate(replace(blobs, uv=uv), RIG, OBJECT)
    assert len(result.labelled.used) == 3
    assert result.outliers == 0
    usual = imgcal.calibrate(blobs, RIG, OBJECT)
    assert (result.observations.uv - usual.observations.uv).abs().max() < 0.01


def test_a_moving_object_never_rests() -> None:
    truth = simulate_truth(RIG, OBJECT, 6, torch.Generator().manual_seed(1), PhysicalDrift())
    blobs = true_detections(truth)
    result = imgcal.calibrate(replace(blobs, sigma=np.full(len(blobs), 0.05)), RIG, OBJECT)
    assert result.rests == Rests() and not str(result.rests)
    assert len(result.labelled.used) == 6


def test_a_camera_that_is_knocked_ends_the_rest() -> None:
    seen, part = np.ones((6, 2, 4), dtype=np.bool_), np.zeros(6, dtype=np.int64)
    uv, sigma = np.zeros((6, 2, 4, 2)), np.full((6, 2, 4), 0.1)
    uv += np.random.default_rng(1).normal(scale=0.05, size=uv.shape)
    assert find_rests(uv, sigma, seen, part).tolist() == [0, 0, 0, 0, 0, 0]
    uv[3:, 1] += 1.0
    assert find_rests(uv, sigma, seen, part).tolist() == [0, 0, 0, 3, 3, 3]


def test_frames_of_one_rest_need_not_follow_one_another() -> None:
    seen, part = np.ones((5, 2, 4), dtype=np.bool_), np.zeros(5, dtype=np.int64)
    uv, sigma = np.zeros((5, 2, 4, 2)), np.full((5, 2, 4), 0.1)
    uv[2] += 5.0
    assert find_rests(uv, sigma, seen, part).tolist() == [0, 0, 2, 0, 0]


@pytest.mark.parametrize("parts", [1, 3])
def test_several_objects_rest_each_for_itself(parts) -> None:
    moments, fiducials = 4, 2 * parts
    part = np.tile(np.arange(parts), moments)
    own = np.arange(fiducials) // 2 == part[:, None]
    seen = np.broadcast_to(own[:, None], (len(part), 2, fiducials)).copy()
    uv, sigma = np.zeros((*seen.shape, 2)), np.full(seen.shape, 0.1)
    uv[part == 0] += 5.0 * np.arange(moments)[:, None, None, None]  # the first one moves
    first = find_rests(uv, sigma, seen, part, parts)
    assert first[part == 0].tolist() == np.flatnonzero(part == 0).tolist()
    for other in range(1, parts):
        assert set(first[part == other].tolist()) == {other}


@pytest.mark.parametrize(("fixed", "flicker"), [(0.1, 0.03), (0.07, 0.07)])
def test_a_robot_that_comes_back_knows_no_more(fixed, flicker) -> None:
    """Twelve rounds through the same ten poses, one frame of each."""
    errors = []
    for seed in range(3):
        truth, blobs = capture(10, fixed, flicker, seed)
        rounds = [blobs.of_snapshots(s, s + 1) for turn in range(FRAMES) for s in range(turn, 10 * FRAMES, FRAMES)]
        found = imgcal.calibrate(Detections.join(rounds), RIG, OBJECT)
        assert len(found.labelled.used) == 10 and len(found.rests.snapshots) == 10 * (FRAMES - 1)
        errors.append(squared_error(truth, found))
    assert 0.5 < np.mean(errors) < 1.6  # 4 to 7 before
