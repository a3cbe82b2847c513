"""Classical methods reach the truth in easy cases, and decline where they cannot."""

import math

import cv2
import numpy as np
import pytest
import torch

from imgcal.evaluation import classical
from imgcal.evaluation.classical import calibrate_cameras, pnp
from imgcal.types import Prediction


def elsewhere(truth):
    """A prediction that nothing should be taken from."""
    pose = truth.rig_from_object
    return Prediction(truth.rig, type(pose)(pose.rotation, pose.translation + 500.0))


@pytest.mark.parametrize("value", [math.nan, 1e9])
def test_a_refinement_of_pnp_that_diverges_is_not_taken(sample, monkeypatch, value):
    some = sample(1, kappa=0.0)
    points, uv = some.conditions.obj.points.numpy(), some.given().uv[0, 0].numpy()
    matrix, distortion = classical._intrinsics(some.conditions.rig, 0)
    rotation, translation = classical._solve_pnp(points, uv, matrix, distortion)
    diverged = np.zeros((3, 1)), np.full((3, 1), value)
    monkeypatch.setattr(classical.cv2, "solvePnPRefineLM", lambda *_: diverged)
    kept = classical._solve_pnp(points, uv, matrix, distortion)
    np.testing.assert_allclose(kept[0], rotation, atol=1e-4)
    np.testing.assert_allclose(kept[1], translation, atol=0.1)


def test_pnp_with_the_true_lenses_finds_every_camera(sample):
    some = sample(3, kappa=0.0)
    given, truth = some.given(), some.truth
    found = pnp(given.uv, given.seen, some.conditions.rig, some.conditions.obj, elsewhere(truth)).cameras_from_object
    expected = truth.cameras_from_object
    torch.testing.assert_close(found.cam_from_rig.rotation, expected.cam_from_rig.rotation, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.cam_from_rig.translation, expected.cam_from_rig.translation, atol=0.02, rtol=0)
    assert torch.equal(found.focal_length, expected.focal_length)


def test_a_camera_with_three_points_keeps_what_is_given_otherwise(sample):
    some = sample(2, kappa=0.0)
    given, other = some.given(), elsewhere(some.truth)
    seen = given.seen.clone()
    seen[1, 2, 3:] = False
    for method in (pnp, calibrate_cameras):
        found = method(given.uv, seen, some.conditions.rig, some.conditions.obj, other).cameras_from_object
        kept = other.cameras_from_object.cam_from_rig.translation
        torch.testing.assert_close(found.cam_from_rig.translation[1, 2], kept[1, 2])
        assert (found.cam_from_rig.translation[0] - kept[0]).norm(dim=-1).min() > 100


@pytest.mark.parametrize("points", range(10))
def test_opencv_is_never_asked_for_more_unknowns_than_there_are_equations(points):
    flags = classical._flags(points)
    if flags is None:
        assert points < 4
        return
    free = 15  # six of the pose, fx, fy, cx, cy, five of the distortion
    free -= 2 * bool(flags & cv2.CALIB_FIX_PRINCIPAL_POINT)
    free -= 2 * bool(flags & cv2.CALIB_FIX_TANGENT_DIST)
    free -= sum(bool(flags & flag) for flag in (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3))
    assert free <= 2 * points and flags & cv2.CALIB_USE_INTRINSIC_GUESS
