"""The compiled normal equations and rigs against those in tensors."""

from dataclasses import replace
from functools import partial

import pytest
import torch

import imgcal
from imgcal.estimation import (
    estimate,
    has_poses,
    initial_pose,
    initial_state,
    levenberg_marquardt_cpu,
    linearize,
    make_problem,
    retract,
    rig_at,
)
from imgcal.estimation.levenberg_marquardt import select_rows
from imgcal.estimation.robust_losses import LOSSES, NamedLoss
from imgcal.synthesis import simulate_truth
from imgcal.types import CalibrationObject, Observations
from tests.imgcal.estimation.test_levenberg_marquardt_cpu import CASES, seen_only


@pytest.mark.parametrize("tolerance", [0.0, 0.4])
@pytest.mark.parametrize(("batch", "snapshots", "cameras", "fiducials", "radius"), CASES)
def test_linearization_is_that_of_tensors(
    simulate, batch: tuple[int, ...], snapshots: int, cameras: int, fiducials: int, radius: float | None, tolerance
) -> None:
    size = {"snapshots": snapshots, "cameras": cameras, "fiducials": fiducials, "radius": radius}
    case = simulate(*batch, **size, missing=0.05, tolerance=tolerance, bent=tolerance)
    problem = case.problem()
    state, seen = case.start(problem), problem.root_weight > 0
    state = replace(state, offset=state.offset + 0.3)
    if state.object_offset is not None:
        state = replace(state, object_offset=state.object_offset - 0.2)
    compiled = seen_only(levenberg_marquardt_cpu.linearize(problem, state, "huber", 3.0), seen)
    tensors = seen_only(linearize(problem, state, NamedLoss("huber", 3.0)), seen)
    for name in ("cost", "camera", "coupling", "pose", "camera_gradient", "pose_gradient", "residual"):
        a, b = getattr(compiled, name), getattr(tensors, name)
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12 * float(b.abs().max()), msg=name)
    assert (compiled.object is None) == (tolerance == 0)
    for name in ("camera", "pose", "own", "gradient") if tolerance else ():
        a, b = getattr(compiled.object, name), getattr(tensors.object, name)
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12 * float(b.abs().max()), msg=name)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_rig_at_equals_the_one_in_tensors(simulate, batch: tuple[int, ...]) -> None:
    case = simulate(*batch, cameras=3, fiducials=5)
    problem = case.problem()
    offset = torch.randn(problem.prior_std.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offset[0, 1, :3] = 0
    compiled, tensors = levenberg_marquardt_cpu.rig_at(problem, offset), rig_at(problem, offset)
    torch.testing.assert_close(compiled.cam_from_rig.rotation, tensors.cam_from_rig.rotation, rtol=0, atol=1e-14)
    torch.testing.assert_close(compiled.cam_from_rig.translation, tensors.cam_from_rig.translation, rtol=0, atol=1e-11)
    assert torch.equal(compiled.focal_length, tensors.focal_length)
    assert torch.equal(compiled.principal_point, tensors.principal_point)
    assert torch.equal(compiled.distortion, tensors.distortion)


@pytest.mark.parametrize("name", list(LOSSES))
def test_every_loss_has_the_same_equations(simulate, name: str) -> None:
    case = simulate(2, snapshots=2, cameras=3, fiducials=6, missing=0.1, noise=1.0, sigma=0.3)
    problem = case.problem()
    state = case.start(problem, 0.5, case.truth)
    loss = LOSSES["squared"] if name == "squared" else partial(LOSSES[name], threshold=4.0)
    compiled, tensors = levenberg_marquardt_cpu.linearize(problem, state, name, 4.0), linearize(problem, state, loss)
    for part in ("cost", "camera", "pose", "camera_gradient"):
        torch.testing.assert_close(getattr(compiled, part), getattr(tensors, part), rtol=1e-9, atol=1e-9, msg=part)


@pytest.mark.parametrize("snapshots", [1, 6])
def test_rigs_do_not_mix(simulate, snapshots: int) -> None:
    case = simulate(3, snapshots=snapshots, cameras=3, fiducials=6, missing=0.1)
    problem = case.problem()
    state = case.start(problem)
    together = levenberg_marquardt_cpu.linearize(problem, state, "cauchy", 3.0)
    for row in range(3):
        one = torch.tensor([row])
        alone = levenberg_marquardt_cpu.linearize(problem.select(one), select_rows(state, one), "cauchy", 3.0)
        for part in ("cost", "camera", "coupling", "pose"):
            torch.testing.assert_close(getattr(alone, part)[0], getattr(together, part)[row], rtol=1e-12, atol=1e-12)


def test_a_small_step_changes_the_cost_as_the_gradient_says(simulate) -> None:
    case = simulate(2, snapshots=2, cameras=3, fiducials=6)
    problem = case.problem()
    state = case.start(problem, 0.5)
    generator = torch.Generator().manual_seed(0)
    shapes = (2, 3, 15), (2, 2, 6)
    camera, pose = (1e-6 * torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes)
    at = levenberg_marquardt_cpu.linearize(problem, state, "squared", 1.0)
    ahead, behind = (
        levenberg_marquardt_cpu.linearize(
            problem, retract(problem, state, sign * camera, sign * pose), "squared", 1.0
        ).cost
        for sign in (1, -1)
    )
    expected = (at.camera_gradient * camera).sum((1, 2)) + (at.pose_gradient * pose).sum((1, 2))
    torch.testing.assert_close(0.5 * (ahead - behind), expected, rtol=1e-4, atol=0)


def test_rows_of_several_objects_have_the_free_turns_of_their_own() -> None:
    rig = imgcal.load_rig("T4")
    points = torch.tensor([[-100.0, 0.0, 0.0], [100.0, 0.0, 0.0]], dtype=torch.float64)
    stick = CalibrationObject(points, torch.ones(2, 3), name="stick")
    light = CalibrationObject(torch.zeros(1, 3, dtype=torch.float64), torch.ones(1, 3), name="light")
    obj = CalibrationObject.of_several([imgcal.load_object("wand4"), stick, light])
    generator = torch.Generator().manual_seed(0)
    truth = simulate_truth(rig, obj, 4, generator, None)
    seen = torch.zeros(4, rig.num_cameras, obj.num_fiducials, dtype=torch.bool)
    for row, part in enumerate((0, 1, 2, 1)):
        seen[row, :, torch.from_numpy(obj.part_of == part)] = True
    noisy = truth.uv + 0.1 * torch.randn(truth.uv.shape, generator=generator, dtype=truth.uv.dtype)
    observations = Observations(noisy, torch.full(seen.shape, 0.1, dtype=torch.float64), seen)
    problem = make_problem(observations, rig, obj, None)
    state = initial_state(problem, initial_pose(observations, rig, obj), None)
    assert problem.pose_freedom.tolist() == [6 + 5 + 3 + 5]
    compiled = levenberg_marquardt_cpu.linearize(problem, state, "squared", 1.0)
    tensors = linearize(problem, state, LOSSES["squared"])
    torch.testing.assert_close(compiled.pose, tensors.pose)
    assert float(torch.linalg.eigvalsh(compiled.pose).min()) > 1e-3
    fit = estimate(observations, rig, obj)
    assert bool(fit.converged)
    assert float(fit.rms) < 0.12
    assert has_poses(seen.numpy(), obj.points, obj.part_of).all()
    seen[1] = False
    assert has_poses(seen.numpy(), obj.points, obj.part_of).tolist() == [True, False, True, True]
