"""The score test of a step against the definition, and its behaviour where nothing steps."""

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from imgcal.association import accepted_observations, associate
from imgcal.estimation import LEAST_SNAPSHOTS, estimate
from imgcal.estimation.change_points import (
    STEP,
    dispersion,
    is_significant,
    least_significant,
    likeliest_step,
    linearize_snapshots,
)
from imgcal.estimation.linearization import jacobian_at
from imgcal.types import PARAMETERS
from scripts.benchmarks import camera_faults as damage


def fitted(make, snapshots, seed=0, change=None, first=0, camera=3):
    rig, obj, truth = make(snapshots, seed)
    if change is not None:
        truth = damage.changed_from(truth, obj, camera, first, change)
    table = damage.blobs(truth, seed, labelled=True)
    observations, _ = accepted_observations(associate(table, rig, obj), rig, obj)
    return estimate(observations, rig, obj), observations.seen.any(-1).numpy()


def dense_statistic(fit, camera, row):
    """The same from one dense system of all unknowns and the step."""
    problem, state = fit.problem, fit.solution.state
    rows = jacobian_at(problem, state).by_rig * problem.root_weight[..., None, None, :]  # (1, S, C, 22, 2, N)
    snapshots, cameras = rows.shape[1:3]
    size = PARAMETERS * cameras + 6 * snapshots
    columns, residuals = [], []
    for s in range(snapshots):
        for c in range(cameras):
            block = rows[0, s, c].flatten(1).double().numpy()  # (22, 2 N)
            own = np.zeros((block.shape[1], size + STEP))
            own[:, PARAMETERS * c : PARAMETERS * (c + 1)] = block[:PARAMETERS].T
            own[:, PARAMETERS * cameras + 6 * s :][:, :6] = block[PARAMETERS:-1].T
            if c == camera and s >= row:
                own[:, size:] = block[:STEP].T
            columns.append(own)
            residuals.append(block[-1])
    jacobian, residual = np.concatenate(columns), np.concatenate(residuals)
    information, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    prior = np.r_[np.ones(PARAMETERS * cameras), np.zeros(6 * snapshots), np.full(STEP, 1e-2)]
    information += np.diag(prior)
    gradient[: PARAMETERS * cameras] += state.offset[0].flatten().numpy()
    without = np.linalg.solve(information[:size, :size], gradient[:size]) @ gradient[:size]
    return np.linalg.solve(information, gradient) @ gradient - without


def test_statistics_are_those_of_the_dense_system():
    fit, _ = fitted(damage.wand_in_a_room, 6, change=lambda r: damage.turned(r, 3, 0.01), first=3)
    blocks = linearize_snapshots(fit.problem, fit.solution.state)
    rows = np.array([2, 3, 4])
    for camera in (0, 3):
        expected = [dense_statistic(fit, camera, row) for row in rows]
        assert blocks.statistics([camera], rows)[:, 0] == pytest.approx(expected, rel=1e-6)


def test_a_step_is_found_in_its_camera_at_its_time():
    fit, seen = fitted(damage.wand_in_a_room, 24, change=lambda r: damage.turned(r, 3, 0.02), first=15)
    step = likeliest_step(linearize_snapshots(fit.problem, fit.solution.state), seen)
    assert (step.camera, step.row) == (3, 15)
    assert is_significant(step.statistic, 240, 1e-5)
    assert np.delete(step.rivals, 3).max() < 0.5 * step.statistic


@pytest.mark.parametrize(("first", "size"), [(2, 0.3), (9, 0.03), (30, 0.02), (57, 0.3)])
def test_a_step_that_matters_is_found_among_few_places(first, size):
    fit, seen = fitted(damage.wand_in_a_room, 60, first, lambda r: damage.turned(r, 3, size), first)
    blocks = linearize_snapshots(fit.problem, fit.solution.state)
    whole = likeliest_step(blocks, seen)
    assert whole.statistic > 60
    least = least_significant(600, 1e-5)
    assert is_significant(least + 1e-6, 600, 1e-5) and not is_significant(least - 1e-6, 600, 1e-5)
    found = likeliest_step(blocks, seen, least)
    assert (found.camera, found.row) == (whole.camera, whole.row)
    np.testing.assert_allclose(found.rivals, whole.rivals)
    assert likeliest_step(blocks, seen, 1.01 * whole.statistic) is None


def test_long_captures_are_searched_in_two_passes(monkeypatch):
    fit, seen = fitted(damage.wand_in_a_room, 40, change=lambda r: damage.turned(r, 3, 0.05), first=29)
    blocks = linearize_snapshots(fit.problem, fit.solution.state)
    whole = likeliest_step(blocks, seen)
    monkeypatch.setattr("imgcal.estimation.change_points.MOST_TIMES", 5)
    coarse = likeliest_step(blocks, seen)
    assert (coarse.camera, coarse.row) == (whole.camera, whole.row) == (3, 29)


def test_statistics_where_nothing_steps_are_chi_squared():
    found = []
    for seed in range(12):
        fit, seen = fitted(damage.wand_in_a_room, 10, seed)
        blocks = linearize_snapshots(fit.problem, fit.solution.state)
        found += blocks.statistics(range(10), np.array([5])).ravel().tolist()
        assert dispersion(blocks, seen) < 2
    assert np.mean(found) == pytest.approx(STEP, rel=0.15)
    assert np.mean(np.array(found) > chi2.isf(0.05, STEP)) < 0.12


def test_too_few_snapshots_have_no_step():
    fit, seen = fitted(damage.wand_in_a_room, 2 * LEAST_SNAPSHOTS - 1)
    assert likeliest_step(linearize_snapshots(fit.problem, fit.solution.state), seen) is None


def test_errors_that_go_with_time_disperse_the_statistics():
    fit, seen = fitted(damage.wand_in_a_room, 30)
    blocks = linearize_snapshots(fit.problem, fit.solution.state)
    wave = torch.sin(torch.linspace(0, 9, 30, dtype=torch.float64))[None, :, None, None, None]
    problem = fit.problem
    wavy = type(problem)(**{**vars(problem), "uv": problem.uv + 0.3 * wave * torch.ones_like(problem.uv)})
    assert dispersion(linearize_snapshots(wavy, fit.solution.state), seen) > 2 * dispersion(blocks, seen)
