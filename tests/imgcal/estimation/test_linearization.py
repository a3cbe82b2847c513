"""Analytic Jacobians and normal equations against autograd through `CameraRig.project`."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imgcal.estimation import Problem, State, linearize, map_cost, points_at, pose_at, retract, rig_at, squared
from imgcal.estimation.robust_losses import cauchy

CASES = [((), 1, 3, 5), ((1,), 2, 4, 6), ((2, 3), 2, 3, 5), ((4,), 1, 4, 4)]


def disturbed(problem: Problem, state: State) -> State:
    generator = torch.Generator().manual_seed(1)
    camera = torch.randn(state.offset.shape, generator=generator, dtype=torch.float64)
    pose = 0.03 * torch.randn(*state.centre.shape[:-1], 6, generator=generator, dtype=torch.float64)
    return retract(problem, state, camera, pose)


@pytest.mark.parametrize("radius", [None, 15.0])
@pytest.mark.parametrize(("batch", "snapshots", "cameras", "fiducials"), CASES)
def test_normal_equations_match_autograd(
    simulate, batch: tuple[int, ...], snapshots: int, cameras: int, fiducials: int, radius: float | None
) -> None:
    case = simulate(
        *batch, snapshots=snapshots, cameras=cameras, fiducials=fiducials, radius=radius, missing=0.2, noise=0.5
    )
    problem = case.problem()
    state = disturbed(problem, case.start(problem))
    found = linearize(problem, state, squared)
    count = len(state.offset)

    def whitened(camera_step: Tensor, pose_step: Tensor) -> Tensor:
        """Residuals of the data: (B, -1)."""
        there = retract(problem, state, camera_step, pose_step)
        rig, points = rig_at(problem, there.offset), pose_at(problem, there).apply(problem.points + problem.centroid)
        radii = None if problem.radius_squared is None else problem.radius_squared.sqrt().repeat(snapshots)
        uv = rig.project(points.flatten(1, 2), radii).uv.unflatten(2, (snapshots, fiducials)).permute(0, 2, 1, 4, 3)
        return ((uv - problem.uv) * problem.root_weight.unsqueeze(-2)).flatten(1)

    zero = torch.zeros(count, cameras, 15).double(), torch.zeros(count, snapshots, 6).double()
    by_camera, by_pose = torch.autograd.functional.jacobian(lambda *s: whitened(*s).sum(0), zero, vectorize=True)
    residual = whitened(*zero)
    camera_rows, pose_rows = by_camera.movedim(1, 0).flatten(2), by_pose.movedim(1, 0).flatten(2)  # (B, M, .)
    hessian = camera_rows.mT @ camera_rows
    size = cameras * 15
    camera = torch.zeros(count, size, size).double()
    for c in range(cameras):
        camera[:, 15 * c : 15 * c + 15, 15 * c : 15 * c + 15] = found.camera[:, c]
    expected = hessian + torch.eye(size).double()
    torch.testing.assert_close(camera, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    pose = pose_rows.mT @ pose_rows
    for s in range(snapshots):
        block = pose[:, 6 * s : 6 * s + 6, 6 * s : 6 * s + 6]
        torch.testing.assert_close(found.pose[:, s], block, rtol=1e-9, atol=1e-9 * float(block.abs().max()))
    coupling = (camera_rows.mT @ pose_rows).unflatten(1, (cameras, 15)).unflatten(-1, (snapshots, 6))
    coupling = coupling.permute(0, 3, 1, 2, 4)
    torch.testing.assert_close(found.coupling, coupling, rtol=1e-9, atol=1e-9 * float(coupling.abs().max()))
    torch.testing.assert_close(
        found.camera_gradient.flatten(1), (camera_rows.mT @ residual[..., None]).squeeze(-1) + state.offset.flatten(1)
    )
    torch.testing.assert_close(found.pose_gradient.flatten(1), (pose_rows.mT @ residual[..., None]).squeeze(-1))


@pytest.mark.parametrize(("batch", "snapshots", "cameras", "fiducials"), CASES)
def test_equations_of_the_object_match_autograd(
    simulate, batch: tuple[int, ...], snapshots: int, cameras: int, fiducials: int
) -> None:
    case = simulate(
        *batch, snapshots=snapshots, cameras=cameras, fiducials=fiducials, radius=15.0, missing=0.2, noise=0.5,
        tolerance=0.7, scale_tolerance=0.02,
    )  # fmt: skip
    problem = case.problem()
    state = disturbed(problem, case.start(problem))
    generator = torch.Generator().manual_seed(2)
    own = torch.randn(problem.object_prior_std.shape, generator=generator, dtype=torch.float64)
    state = replace(state, object_offset=own)
    found = linearize(problem, state, squared).object

    def cost(*step: Tensor) -> Tensor:
        return map_cost(problem, retract(problem, state, *step), squared).sum()

    def whitened(*step: Tensor) -> Tensor:
        """Residuals of the data: (B, -1)."""
        there = retract(problem, state, *step)
        rig, shape = rig_at(problem, there.offset), points_at(problem, there) + problem.centroid
        points = pose_at(problem, there).apply(shape.unsqueeze(1))
        radii = problem.radius_squared.sqrt().repeat(snapshots)
        uv = rig.project(points.flatten(1, 2), radii).uv.unflatten(2, (snapshots, fiducials)).permute(0, 2, 1, 4, 3)
        return ((uv - problem.uv) * problem.root_weight.unsqueeze(-2)).flatten(1).sum(0)

    zero = (torch.zeros_like(state.offset), torch.zeros(len(own), snapshots, 6).double(), torch.zeros_like(own))
    rows = torch.autograd.functional.jacobian(whitened, zero, vectorize=True)
    by_camera, by_pose, by_object = (part.movedim(1, 0).flatten(2) for part in rows)  # (B, rows, .)
    eye = torch.eye(3 * fiducials + 1).double()
    for name, block, expected in (
        ("own", found.own, by_object.mT @ by_object + eye),
        ("camera", found.camera.flatten(1, 2), by_camera.mT @ by_object),
        ("pose", found.pose.flatten(1, 2), by_pose.mT @ by_object),
        ("gradient", found.gradient, torch.func.grad(cost, argnums=2)(*zero)),
    ):
        limit = 1e-9 * float(expected.abs().max())
        torch.testing.assert_close(
            block, expected, rtol=1e-9, atol=limit, msg=lambda text, name=name: f"{name}: {text}"
        )


@pytest.mark.parametrize("loss", [squared, cauchy])
def test_cost_and_gradient_match_the_plain_cost(simulate, loss) -> None:
    case = simulate(2, cameras=3, fiducials=5, missing=0.2, noise=0.3, radius=10.0)
    problem = case.problem()
    state = disturbed(problem, case.start(problem))
    found = linearize(problem, state, loss)
    camera = torch.zeros(2, 3, 15, dtype=torch.float64, requires_grad=True)
    pose = torch.zeros(2, 2, 6, dtype=torch.float64, requires_grad=True)
    cost = map_cost(problem, retract(problem, state, camera, pose), loss)
    torch.testing.assert_close(found.cost, cost.detach())
    by_camera, by_pose = torch.autograd.grad(cost.sum(), (camera, pose))
    torch.testing.assert_close(found.camera_gradient, by_camera, rtol=1e-8, atol=1e-6)
    torch.testing.assert_close(found.pose_gradient, by_pose, rtol=1e-8, atol=1e-6)


def test_seen_fiducial_behind_a_camera_costs_infinity(simulate) -> None:
    case = simulate(2, cameras=3, fiducials=5)
    problem = case.problem()
    state = case.start(problem)
    centre = state.centre.clone()
    centre[1, 0, 2] = -500
    assert linearize(problem, replace(state, centre=centre), squared).cost.isinf().tolist() == [False, True]
    hidden = problem.root_weight.clone()
    hidden[1, 0] = 0
    unseen = replace(problem, root_weight=hidden)
    assert linearize(unseen, replace(state, centre=centre), squared).cost.isfinite().all()


def test_zero_spread_leaves_a_unit_block(simulate) -> None:
    case = simulate(1, cameras=3, fiducials=5)
    problem = case.problem()
    prior_std = problem.prior_std.clone()
    prior_std[:, 1, 6] = 0
    found = linearize(replace(problem, prior_std=prior_std), case.start(problem), squared)
    row = torch.zeros(15, dtype=torch.float64)
    row[6] = 1
    torch.testing.assert_close(found.camera[0, 1, 6], row, rtol=0, atol=0)
    assert not found.coupling[0, :, 1, 6].any()
    assert float(found.camera_gradient[0, 1, 6]) == 0
