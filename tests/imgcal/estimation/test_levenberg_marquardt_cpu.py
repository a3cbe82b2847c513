"""The compiled solver against the tensor solver."""

from dataclasses import fields, replace
from functools import partial

import numba
import numpy as np
import pytest
import torch

from imgcal.estimation import (
    NormalEquations,
    Problem,
    Solution,
    State,
    levenberg_marquardt,
    levenberg_marquardt_cpu,
    linearize,
)
from imgcal.estimation.remaining_variance import _diagonal, _diagonal_without_poses, remaining_variance
from imgcal.estimation.robust_losses import LOSSES
from imgcal.geometry import project_arrays

CASES = [
    ((), 1, 10, 8, None),
    ((1,), 3, 2, 6, None),  # snapshots * 6 > cameras * 15 is false, just so
    ((2, 3), 2, 3, 5, 12.0),
    ((4,), 2, 4, 7, None),
    ((2,), 9, 3, 6, None),  # snapshots are eliminated
]


def assert_same(first: Solution, second: Solution, tolerance: float) -> None:
    """Compare the states in units of the prior's standard deviation and of the image, and the equations relatively."""
    assert torch.equal(first.converged, second.converged)
    torch.testing.assert_close(first.state.offset, second.state.offset, rtol=0, atol=tolerance)
    torch.testing.assert_close(first.state.rotation, second.state.rotation, rtol=0, atol=tolerance)
    torch.testing.assert_close(first.state.centre, second.state.centre, rtol=0, atol=1e3 * tolerance)
    for name in ("cost", "camera", "coupling", "pose", "residual"):
        a, b = getattr(first.equations, name), getattr(second.equations, name)
        torch.testing.assert_close(a, b, rtol=1e3 * tolerance, atol=1e2 * tolerance * float(b.abs().max()), msg=name)


def seen_only(equations: NormalEquations, seen: torch.Tensor) -> NormalEquations:
    return replace(equations, residual=torch.where(seen.unsqueeze(-2), equations.residual, 0.0))


@pytest.mark.parametrize("name", list(LOSSES))
@pytest.mark.parametrize(("batch", "snapshots", "cameras", "fiducials", "radius"), CASES)
def test_same_minimum(
    simulate, batch: tuple[int, ...], snapshots: int, cameras: int, fiducials: int, radius: float | None, name: str
) -> None:
    case = simulate(
        *batch, snapshots=snapshots, cameras=cameras, fiducials=fiducials, radius=radius, missing=0.05, noise=0.06
    )
    problem = case.problem()
    # A bounded loss has no pull on what is far away, so it must start near.
    start = case.start(problem) if name == "squared" else case.start(problem, 0.05, case.truth)
    seen = problem.root_weight > 0
    loss = LOSSES["squared"] if name == "squared" else partial(LOSSES[name], threshold=4.0)
    compiled = levenberg_marquardt_cpu.minimize(problem, start, name, 4.0, 60, 1e-9)
    tensors = levenberg_marquardt.minimize(problem, start, loss, 60, 1e-9)
    compiled = replace(compiled, equations=seen_only(compiled.equations, seen))
    tensors = replace(tensors, equations=seen_only(tensors.equations, seen))
    assert compiled.converged.all()
    assert_same(compiled, tensors, 1e-5)


@pytest.mark.parametrize(
    "tolerances", [{"tolerance": 0.4}, {"scale_tolerance": 0.01}, {"tolerance": 0.4, "scale_tolerance": 0.01}]
)
@pytest.mark.parametrize(("batch", "snapshots", "cameras", "fiducials", "radius"), CASES)
def test_same_minimum_with_an_object_that_is_not_exact(
    simulate, batch: tuple[int, ...], snapshots: int, cameras: int, fiducials: int, radius: float | None, tolerances
) -> None:
    case = simulate(
        *batch,
        snapshots=snapshots,
        cameras=cameras,
        fiducials=fiducials,
        radius=radius,
        missing=0.05,
        bent=tolerances.get("tolerance", 0.0),
        **tolerances,
    )
    problem = case.problem()
    start, seen = case.start(problem), problem.root_weight > 0
    compiled = levenberg_marquardt_cpu.minimize(problem, start, "huber", 4.0, 80, 1e-9)
    tensors = levenberg_marquardt.minimize(problem, start, partial(LOSSES["huber"], threshold=4.0), 80, 1e-9)
    compiled = replace(compiled, equations=seen_only(compiled.equations, seen))
    tensors = replace(tensors, equations=seen_only(tensors.equations, seen))
    assert compiled.converged.all()
    assert_same(compiled, tensors, 2e-5)
    torch.testing.assert_close(compiled.state.object_offset, tensors.state.object_offset, rtol=0, atol=1e-3)
    for name in ("camera", "pose", "own", "gradient"):
        a, b = getattr(compiled.equations.object, name), getattr(tensors.equations.object, name)
        torch.testing.assert_close(
            a, b, rtol=1e-2, atol=1e-3 * float(tensors.equations.object.own.abs().max()), msg=name
        )


def fit_in_arrays(problem: Problem, start: State) -> levenberg_marquardt_cpu.SnapshotFit:
    given = (problem.uv[0, 0].numpy(), problem.root_weight[0, 0].numpy())
    first = (start.offset[0].numpy(), start.rotation[0, 0].numpy(), start.centre[0, 0].numpy())
    return levenberg_marquardt_cpu.RigSolver(problem).fit_snapshot(*given, first, "huber", 4.0, 60, 1e-9)


def test_one_snapshot_in_arrays_is_fitted_as_in_tensors(simulate) -> None:
    case = simulate(1, snapshots=1, cameras=3, missing=0.1, noise=0.06)
    problem = case.problem()
    solution = levenberg_marquardt_cpu.minimize(problem, case.start(problem), "huber", 4.0, 60, 1e-9)
    found, expected = fit_in_arrays(problem, case.start(problem)), levenberg_marquardt_cpu.SnapshotFit.of(solution)
    for field in fields(expected):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


def test_tensors_stand_in_for_missing_machine_code(simulate, monkeypatch) -> None:
    case = simulate(1, snapshots=3, cameras=2, fiducials=6, radius=None, missing=0.05, noise=0.06)
    problem = case.problem()
    start, points = case.start(problem), problem.points.expand(1, -1, -1)
    one = simulate(1, snapshots=1, cameras=2).problem()
    solutions = [
        levenberg_marquardt_cpu.minimize(each, make.start(each), "huber", 4.0, 60, 1e-9)
        for make in (case, simulate(1, snapshots=20, cameras=2, tolerance=0.4))  # poses, cameras are eliminated last
        for each in (make.problem(), replace(make, observations=make.observations.to(torch.float32)).problem())
    ]
    calls = (
        *(lambda found=found: torch.from_numpy(remaining_variance(found)) for found in solutions),
        lambda: levenberg_marquardt_cpu.rig_at(problem, start.offset + 0.3).cam_from_rig.rotation,
        lambda: levenberg_marquardt_cpu.minimize(problem, start, "huber", 4.0, 60, 1e-9).state.offset,
        lambda: (
            levenberg_marquardt_cpu.RigSolver(problem).minimize(problem, start, "huber", 4.0, 60, 1e-9).state.offset
        ),
        lambda: torch.from_numpy(fit_in_arrays(one, simulate(1, snapshots=1, cameras=2).start(one)).coupling),
        lambda: levenberg_marquardt_cpu.linearize(problem, start, "huber", 4.0).pose,
        lambda: problem.factory.project_values(points).uv,
    )
    compiled = [call() for call in calls]
    called = []
    functions = (
        levenberg_marquardt_cpu._minimize_rig,
        levenberg_marquardt_cpu.linearize_rig,
        levenberg_marquardt_cpu.turn_all,
        _diagonal,
        _diagonal_without_poses,
        project_arrays,
    )
    for function in functions:
        missing = function.interpretable
        monkeypatch.setattr(missing, "is_ready", lambda: False)
        monkeypatch.setattr(missing, "call_twin", lambda twin, *given: called.append(twin) or twin(*given))
    for call, expected in zip(calls, compiled, strict=True):
        torch.testing.assert_close(call(), expected, rtol=1e-6, atol=1e-6)
    assert len(called) == len(calls)


@pytest.mark.parametrize("snapshots", [2, 12])  # cameras, poses are eliminated first
@pytest.mark.parametrize("tolerances", [{}, {"tolerance": 0.4}])
def test_a_camera_without_labels_in_a_snapshot_leaves_no_block_unwritten(
    simulate, monkeypatch, snapshots: int, tolerances
) -> None:
    case = simulate(snapshots=snapshots, cameras=3, fiducials=5, **tolerances)
    case.observations.seen[..., 1, 2, :] = False
    problem = case.problem()
    start, empty = case.start(problem), torch.Tensor.new_empty
    expected = linearize(problem, start, partial(LOSSES["huber"], threshold=3.0))
    monkeypatch.setattr(torch.Tensor, "new_empty", lambda self, *size: empty(self, *size).fill_(torch.nan))
    found = levenberg_marquardt_cpu.linearize(problem, start, "huber", 3.0)
    for name in ("camera", "coupling", "pose", "camera_gradient", "pose_gradient"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-6, msg=name)
    if tolerances:
        for name in ("camera", "pose", "own", "gradient"):
            a, b = getattr(found.object, name), getattr(expected.object, name)
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-6, msg=name)


def test_single_precision_stays_close(simulate) -> None:
    case = simulate(16, snapshots=2, cameras=10, fiducials=8)
    problem = case.problem()
    single = replace(case, observations=case.observations.to(torch.float32)).problem()
    exact = levenberg_marquardt_cpu.minimize(problem, case.start(problem), "huber", 3.0, 50, 1e-4)
    rough = levenberg_marquardt_cpu.minimize(single, case.start(single), "huber", 3.0, 50, 1e-4)
    assert rough.state.offset.dtype == rough.equations.camera.dtype == torch.float32
    assert rough.converged.all()
    compiled = levenberg_marquardt_cpu._minimize_all.signatures
    assert compiled and "float32" not in str(compiled)  # nobody waits for the compilation of a second type
    torch.testing.assert_close(rough.state.offset.double(), exact.state.offset, rtol=0, atol=0.05)
    torch.testing.assert_close(rough.equations.cost.double(), exact.equations.cost, rtol=0.01, atol=0.05)


def test_input_is_left_alone(simulate) -> None:
    case = simulate(2, cameras=3, fiducials=5)
    problem = case.problem()
    start = case.start(problem)
    copies = start.offset.clone(), start.rotation.clone(), start.centre.clone(), problem.uv.clone()
    levenberg_marquardt_cpu.minimize(problem, start, "squared", 3.0, 20, 1e-4)
    for before, after in zip(copies, (start.offset, start.rotation, start.centre, problem.uv), strict=True):
        assert torch.equal(before, after)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
def test_broken_input_never_converges(simulate, count: int, poison: float) -> None:
    case = simulate(count, cameras=3, fiducials=5)
    problem = case.problem()
    uv = problem.uv.clone()
    uv[0, 0, 2, 0, 3] = poison
    found = levenberg_marquardt_cpu.minimize(replace(problem, uv=uv), case.start(problem), "squared", 3.0, 20, 1e-4)
    assert found.converged.tolist() == [False] + [True] * (count - 1)


def test_zero_iterations_evaluate_the_start(simulate) -> None:
    case = simulate(2, cameras=3, fiducials=5)
    problem = case.problem()
    start = case.start(problem)
    compiled = levenberg_marquardt_cpu.minimize(problem, start, "squared", 3.0, 0, 1e-4)
    tensors = levenberg_marquardt.minimize(problem, start, LOSSES["squared"], 0, 1e-4)
    torch.testing.assert_close(compiled.equations.cost, tensors.equations.cost)
    assert not compiled.converged.any()
    assert torch.equal(compiled.state.offset, start.offset)


def test_number_of_threads_is_left_alone(simulate) -> None:
    case = simulate(4, cameras=3, fiducials=5)
    problem = case.problem()
    compiled = numba.get_num_threads()
    levenberg_marquardt_cpu.minimize(problem, case.start(problem), "squared", 3.0, 20, 1e-4)
    assert torch.get_num_threads() == 1  # as set for these tests
    assert numba.get_num_threads() == compiled  # as many as there are cores, but for these tests
