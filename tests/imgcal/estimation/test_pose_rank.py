"""Rigs from one light and from sticks, labels given: as well as the estimate says, and the same from both solvers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import to_observations
from imgcal.estimation import (
    EstimationOptions,
    UndeterminedPosesError,
    camera_covariance,
    estimate,
    initial_state,
    linearize,
    make_loss,
    make_problem,
    require_poses,
)
from imgcal.estimation.levenberg_marquardt import minimize
from imgcal.io import read_rig
from imgcal.pipeline import calibrate
from imgcal.synthesis import PhysicalDrift, simulate_volume, true_detections
from imgcal.types import CalibrationObject

LIGHT = ((0.0, 0.0, 0.0),)
PAIR = ((-150.0, 100.0, 50.0), (250.0, -100.0, 150.0))
TRIPLE = ((-250.0, 0.0, 0.0), (-80.0, 0.0, 0.0), (250.0, 0.0, 0.0))


def capture(points, snapshots, noise=0.1, seed=1):
    """Labelled blobs of an object in room10, of a rig that has drifted as its prior says."""
    rig = read_rig("room10")
    obj = CalibrationObject(torch.tensor(points, dtype=torch.float64), torch.ones(len(points), 3))
    truth = simulate_volume(rig, obj, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += noise * np.random.default_rng(seed).standard_normal(table.uv.shape)
    return rig, obj, truth, replace(table, sigma=np.full(len(table), noise))


@pytest.mark.parametrize(("points", "snapshots", "rank"), [(LIGHT, 120, 3), (PAIR, 60, 5), (TRIPLE, 60, 5)])
def test_errors_are_as_large_as_the_estimate_says(points, snapshots, rank):
    prior = PhysicalDrift()
    squares, chi2 = [], []
    for seed in range(3):
        rig, obj, truth, table = capture(points, snapshots, seed=seed)
        observations = to_observations(table, rig, obj)
        found = estimate(observations, rig, obj, prior_std=prior.std(rig))
        assert bool(found.converged)
        assert int(found.dof) == 2 * int(observations.seen.sum()) - rank * snapshots
        error = found.rig.local(truth.rig).flatten()
        known = prior.std(rig).flatten() > 0
        covariance = camera_covariance(found)[known][:, known]
        squares.append(float(error[known] @ torch.linalg.solve(covariance, error[known])) / int(known.sum()))
        chi2.append(float(found.chi2_per_dof))
    assert 0.8 < np.mean(squares) ** 0.5 < 1.2
    assert 0.93 < np.mean(chi2) < 1.07


@pytest.mark.parametrize("points", [LIGHT, PAIR])
def test_both_solvers_fix_turns_that_nothing_shows_and_add_nothing_else(points):
    rig, obj, _, table = capture(points, 6)
    observations = to_observations(table, rig, obj)
    problem = make_problem(observations, rig, obj, None)
    loss = make_loss(EstimationOptions())
    found = estimate(observations, rig, obj)
    there = linearize(problem, found.solution.state, loss)
    torch.testing.assert_close(there.pose, found.solution.equations.pose, rtol=1e-9, atol=1e-3)
    values = torch.linalg.eigvalsh(there.pose[0])
    free = 6 - obj.pose_rank
    torch.testing.assert_close(values[:, :free], torch.ones_like(values[:, :free]), rtol=0, atol=1e-3)
    assert bool((values[:, free:] > 1e3).all())
    start = initial_state(problem, found.rig_from_object, None)
    slow = minimize(problem, start, loss, 50, 1e-6)
    torch.testing.assert_close(slow.state.offset, found.solution.state.offset, rtol=0, atol=1e-3)


def test_of_a_stick_only_the_scale_is_estimated():
    rig, obj, _, table = capture(TRIPLE, 6)
    observations = to_observations(table, rig, obj)
    soft = replace(obj, tolerance=torch.ones(3).double())
    assert make_problem(observations, rig, soft, None).object_prior_std is None
    problem = make_problem(observations, rig, replace(soft, scale_tolerance=0.02), None)
    assert problem.object_prior_std.tolist() == [[*[0.0] * 9, 0.02]]
    light = replace(obj, points=obj.points[:1], colours=obj.colours[:1])
    one = to_observations(table.select(table.fiducial == 0), rig, light)
    assert make_problem(one, rig, replace(light, scale_tolerance=0.02), None).object_prior_std is None


def test_a_stick_of_equal_halves_may_have_tolerances():
    rig, obj, _, table = capture(PAIR, 20)
    soft = replace(obj, tolerance=torch.full((2,), 0.3).double())
    result = calibrate(replace(table, fiducial=np.full(len(table), -1)), rig, soft)
    assert result.identity == "ambiguous" and result.estimate.problem.object_prior_std is None


def test_a_light_needs_two_cameras_and_a_stick_two_of_its_markers():
    seen = np.zeros((3, 4, 2), dtype=bool)
    seen[:, :2] = True
    seen[1, 1, 1] = False
    pair = torch.tensor(PAIR)
    with pytest.raises(UndeterminedPosesError, match="2 fiducials") as found:
        require_poses(seen, pair)
    assert found.value.rows == (1,)
    require_poses(seen[:, :, :1], pair[:1])
    with pytest.raises(UndeterminedPosesError, match="1 fiducial"):
        require_poses(seen[:, :1, :1], pair[:1])


def test_a_snapshot_without_a_pose_is_refused_for_the_reason_of_its_object():
    rig, obj, _, table = capture(PAIR, 40)
    alone = (table.snapshot != 3) | (table.camera == 0)
    result = calibrate(table.select(alone), rig, obj)
    assert "two cameras share labels of fewer than 2 fiducials" in result.labelled.snapshots[3].reason


def test_a_light_calibrates_and_says_that_its_scale_is_that_of_the_cameras():
    rig, obj, _, table = capture(LIGHT, 80)
    result = calibrate(table, rig, obj)
    assert result.identity == "coded" and result.scale.source == "cameras"
    assert 0.0003 < result.scale.sigma < 0.01
    assert "cameras" in str(result.scale)
