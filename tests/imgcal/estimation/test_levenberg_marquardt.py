"""The tensor solver: reaches the minimum, and never takes a failed factorization for a step."""

from dataclasses import replace

import pytest
import torch

from imgcal.estimation import linearize, squared
from imgcal.estimation.levenberg_marquardt import damped_step, minimize
from imgcal.estimation.robust_losses import LOSSES


@pytest.mark.parametrize("snapshots", [1, 2, 10])  # ten snapshots of three cameras: snapshots are eliminated
def test_damped_step_equals_the_dense_solution(simulate, snapshots: int) -> None:
    case = simulate(2, snapshots=snapshots, cameras=3, fiducials=6)
    problem = case.problem()
    equations = linearize(problem, case.start(problem), squared)
    damping = torch.tensor([0.0, 0.1], dtype=torch.float64)
    (camera, pose, _), gain, failed = damped_step(equations, damping)
    size = 45 + 6 * snapshots
    for b in range(2):
        dense = torch.zeros(size, size, dtype=torch.float64)
        for c in range(3):
            rows = slice(15 * c, 15 * c + 15)
            dense[rows, rows] = equations.camera[b, c]
            for s in range(snapshots):
                columns = slice(45 + 6 * s, 51 + 6 * s)
                dense[columns, columns] = equations.pose[b, s]
                dense[rows, columns] = equations.coupling[b, s, c]
                dense[columns, rows] = equations.coupling[b, s, c].mT
        dense.diagonal().mul_(1 + damping[b])
        gradient = torch.cat((equations.camera_gradient[b].flatten(), equations.pose_gradient[b].flatten()))
        expected = torch.linalg.solve(dense, -gradient)
        torch.testing.assert_close(torch.cat((camera[b].flatten(), pose[b].flatten())), expected, rtol=1e-6, atol=1e-8)
        assert float(gain[b]) == pytest.approx(float(-0.5 * gradient @ expected), rel=1e-6)
    assert not failed.any()


@pytest.mark.parametrize("name", list(LOSSES))
def test_gradient_vanishes_at_the_minimum(simulate, name: str) -> None:
    case = simulate(3, snapshots=3, cameras=4, fiducials=7, missing=0.1)
    problem = case.problem()
    first = case.start(problem, 0.1, case.truth)  # near: a bounded loss has no pull on what is far away
    found = minimize(problem, first, LOSSES[name], 100, 1e-11)
    assert found.converged.all()
    start = linearize(problem, first, LOSSES[name])
    assert found.equations.camera_gradient.abs().max() < 1e-5 * start.camera_gradient.abs().max()
    assert found.equations.pose_gradient.abs().max() < 1e-5 * start.pose_gradient.abs().max()
    again = linearize(problem, found.state, LOSSES[name])
    torch.testing.assert_close(again.cost, found.equations.cost)


def test_cost_never_rises_with_more_iterations(simulate) -> None:
    case = simulate(4, snapshots=1, cameras=5, fiducials=6)
    problem = case.problem()
    costs = [minimize(problem, case.start(problem, 60.0), squared, n, 1e-9).equations.cost for n in range(6)]
    assert (torch.stack(costs).diff(dim=0) <= 0).all()


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
def test_broken_input_never_converges(simulate, poison: float) -> None:
    case = simulate(3, cameras=3, fiducials=5)
    problem = case.problem()
    uv = problem.uv.clone()
    uv[1, 0, 2, 0, 3] = poison
    found = minimize(replace(problem, uv=uv), case.start(problem), squared, 20, 1e-4)
    assert found.converged.tolist() == [True, False, True]
