from dataclasses import replace

import pytest
import torch

from imgcal.evaluation import Protocol, cramer_rao, errors, evaluate, held_out_points, reprojection_error
from imgcal.evaluation.metrics import KINDS
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.types import Prediction


def test_a_prediction_that_is_the_truth_has_no_error(sample):
    some = sample(3)
    found = errors(some.truth, some.truth, some.conditions.obj)
    for kind in KINDS:
        assert (getattr(found, kind) < 1e-5).all(), kind


def test_re_of_a_shifted_principal_point_is_the_shift_over_both_axes(sample):
    some = sample(3)
    rig = replace(some.truth.rig, principal_point=some.truth.rig.principal_point + torch.tensor([3.0, 4.0]))
    found = errors(Prediction(rig, some.truth.rig_from_object), some.truth, some.conditions.obj)
    expected = torch.full((3,), (25 / 2) ** 0.5, dtype=torch.float64)
    assert torch.allclose(found.re, expected)
    assert torch.allclose(found.principal_point, expected)


def test_re_is_the_root_of_the_mean_over_cameras_fiducials_and_axes(sample):
    some = sample(2)
    obj, truth = some.conditions.obj, some.truth.cameras_from_object
    principal = truth.principal_point.clone()
    principal[:, 1, 0] += 8.0  # one of four cameras, one of two axes
    found = reprojection_error(replace(truth, principal_point=principal), truth, obj)
    assert torch.allclose(found, torch.full((2,), (64 / 8) ** 0.5, dtype=torch.float64))


def test_errors_of_parameters_are_in_their_units(sample):
    some = sample(2)
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1:, 2], step[1:, 3], step[:, 6:8] = 0.01, 2.0, 5.0
    found = errors(
        Prediction(some.truth.rig.retract(step), some.truth.rig_from_object), some.truth, some.conditions.obj
    )
    assert torch.allclose(found.rotation_deg, torch.full((2,), 0.572957795, dtype=torch.float64))
    assert torch.allclose(found.position, torch.full((2,), 2.0, dtype=torch.float64))
    assert torch.allclose(found.focal_length, torch.full((2,), 5.0, dtype=torch.float64))
    expected = 100 * (5.0 / some.truth.rig.focal_length).square().mean((-1, -2)).sqrt()
    assert torch.allclose(found.focal_length_percent, expected, rtol=1e-2)


def test_a_motion_of_the_rig_with_the_object_is_no_error(sample):
    some = sample(3)
    turn = RigidTransform(
        rotation_from_vector(torch.tensor([0.1, -0.3, 0.2], dtype=torch.float64)),
        torch.tensor([30.0, -5.0, 12.0], dtype=torch.float64),
    )
    rig = some.truth.rig
    moved = Prediction(replace(rig, cam_from_rig=rig.cam_from_rig @ turn.inverse()), turn @ some.truth.rig_from_object)
    found = errors(moved, some.truth, some.conditions.obj)
    for kind in KINDS:
        assert (getattr(found, kind) < 1e-5).all(), kind


def test_held_out_points_fill_the_ball_that_the_object_sweeps_over(sample):
    obj = sample(1).conditions.obj
    found, centre = held_out_points(obj, 4000), obj.points.mean(0)
    radius = (obj.points - centre).norm(dim=-1).max()
    distance = (found - centre).norm(dim=-1) / radius
    assert float(distance.max()) <= 1
    assert float((distance**3).mean()) == pytest.approx(0.5, abs=0.02)  # even over the volume
    assert torch.allclose(found.mean(0), centre, atol=0.05 * float(radius))
    assert torch.equal(held_out_points(obj), held_out_points(obj))


def test_held_out_error_tells_a_rig_that_fits_its_own_points_alone(sample):
    some = sample(1, kappa=0.0)
    rig, pose = some.truth.rig, some.truth.rig_from_object
    shifted = replace(rig, principal_point=rig.principal_point + torch.tensor([3.0, 4.0]))
    found = errors(Prediction(shifted, pose), some.truth, some.conditions.obj)
    assert torch.allclose(found.held_out, found.re)  # a shift is the same everywhere
    bent = replace(rig, distortion=rig.distortion + torch.tensor([0.05, 0, 0, 0, 0]))
    found = errors(Prediction(bent, pose), some.truth, some.conditions.obj)
    assert (found.held_out - found.re).abs() > 0.01 * found.re  # a lens is not


@pytest.mark.parametrize("missing", [0.0, 0.25])
def test_map_of_the_true_inliers_reaches_the_bound(conditions, missing):
    known = conditions(noise=0.1, missing=missing)
    ratios = evaluate({}, known, Protocol(count=500, trials=1)).reference.cramer_rao_ratios()
    for kind, ratio in ratios.items():
        assert ratio == pytest.approx(1, abs=0.12), kind


def test_the_bound_grows_with_the_noise_and_shrinks_without_drift(sample):
    some = [sample(4, noise=noise) for noise in (0.05, 0.2)]
    quiet, loud = (cramer_rao(each.reference(), each.conditions.obj) for each in some)
    for kind in KINDS:
        assert (getattr(quiet, kind) <= getattr(loud, kind) + 1e-12).all(), kind
    fixed = cramer_rao((still := sample(4, noise=0.1, kappa=0.0)).reference(), still.conditions.obj)
    assert (fixed.focal_length == 0).all()
    # Six unknowns of the pose are left, of 64 equations.
    assert torch.allclose(fixed.re, torch.full((4,), 0.1 * (6 / 64) ** 0.5, dtype=torch.float64), rtol=1e-6)
