"""Gradients through a MAP solution, by the implicit function theorem.

At the minimum the gradient g of the cost by the unknowns x is zero whatever the data are, so dx = -H^-1 dg. One more
Newton step, x - H^-1 g with H held constant, therefore has the value of the solution and exactly its derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from imgcal.estimation import arrow
from imgcal.estimation.linearize import Problem, State, moved, pose_at, rig_at
from imgcal.estimation.robust import Loss
from imgcal.estimation.solver import Solution, factorize

Pair = tuple[Tensor, Tensor]  # camera part (B, C, 15), pose part (B, S, 6)


def attach_gradient(problem: Problem, solution: Solution, loss: Loss) -> State:
    """Return the solution's state, connected to whatever in `problem` requires a gradient."""
    factory = problem.factory
    inputs = (
        problem.uv, problem.root_weight, problem.spread, problem.points, factory.focal_length, factory.principal_point,
        factory.distortion, factory.cam_from_rig.rotation, factory.cam_from_rig.translation,
    )  # fmt: skip
    if not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)):
        return solution.state
    gradient = _gradient(problem, solution.state, loss, create_graph=True)
    step = _NewtonStep.apply(*gradient, _inverse_hessian(_detached(problem), solution, loss))
    return moved(problem, solution.state, *step)


def map_cost(problem: Problem, state: State, loss: Loss) -> Tensor:
    """The cost that the solver minimizes, through the projection of `CameraRig`: (B,), differentiable in everything."""
    poses = pose_at(problem, state)
    rig = rig_at(problem, state.offset)
    fiducials = problem.points + problem.centroid
    batch, snapshots, cameras, _, count = problem.uv.shape
    points_rig = poses.apply(fiducials).flatten(1, 2)  # (B, S N, 3)
    radius = None if problem.radius_squared is None else problem.radius_squared.sqrt().repeat(snapshots)
    uv = rig.project(points_rig, radius).uv.view(batch, cameras, snapshots, count, 2).permute(0, 2, 1, 4, 3)
    whitened = (uv - problem.uv) * problem.root_weight.unsqueeze(-2)
    value, _ = loss(whitened.square().sum(-2))
    return 0.5 * value.sum((1, 2, 3)) + 0.5 * state.offset.square().sum((1, 2))


def _gradient(problem: Problem, state: State, loss: Loss, create_graph: bool) -> Pair:
    """Gradient of the cost by a step away from `state`."""
    with torch.enable_grad():
        step = _zero_step(state)
        cost = map_cost(problem, moved(problem, state, *step), loss).sum()
        return _pair(torch.autograd.grad(cost, step, create_graph=create_graph))


def _zero_step(state: State) -> Pair:
    camera = torch.zeros_like(state.offset, requires_grad=True)
    pose = state.centre.new_zeros(*state.centre.shape[:-1], 6, requires_grad=True)
    return camera, pose


def _inverse_hessian(problem: Problem, solution: Solution, loss: Loss) -> Callable[[Pair], Pair]:
    """Return the map v -> H^-1 v for the exact Hessian at the solution.

    Conjugate gradients on exact Hessian products, preconditioned by the Gauss-Newton factorization: a handful of
    iterations, because the two differ only by curvature times residual.
    """
    reduced, cameras_first = factorize(solution.equations)

    def precondition(v: Pair) -> Pair:
        if cameras_first:
            return arrow.solve(reduced, v[0], v[1])
        pose, camera = arrow.solve(reduced, v[1], v[0])
        return camera, pose

    def product(v: Pair) -> Pair:
        with torch.enable_grad():
            step = _zero_step(solution.state)
            cost = map_cost(problem, moved(problem, solution.state, *step), loss).sum()
            gradient = _pair(torch.autograd.grad(cost, step, create_graph=True))
            return _pair(torch.autograd.grad(_dot(gradient, (v[0].detach(), v[1].detach())).sum(), step))

    def solve(v: Pair) -> Pair:
        return _conjugate_gradients(product, precondition, v)

    return solve


def _conjugate_gradients(product: Callable[[Pair], Pair], precondition: Callable[[Pair], Pair], right: Pair) -> Pair:
    """Solve H x = right for every rig of the batch at once."""
    x = tuple(torch.zeros_like(part) for part in right)
    residual = right
    z = precondition(residual)
    direction = z
    energy = _dot(residual, z)
    target = energy * torch.finfo(energy.dtype).eps ** 1.5
    for _ in range(50):
        if bool((energy <= target).all()):
            break
        image = product(direction)
        curvature = _dot(direction, image)
        alpha = torch.where(curvature > 0, energy / curvature.clamp_min(1e-300), 0.0)
        x = _add(x, direction, alpha)
        residual = _add(residual, image, -alpha)
        z = precondition(residual)
        previous, energy = energy, _dot(residual, z)
        direction = _add(z, direction, torch.where(previous > 0, energy / previous.clamp_min(1e-300), 0.0))
    return x[0], x[1]


def _pair(both: tuple[Tensor, ...]) -> Pair:
    return both[0], both[1]


def _dot(first: Pair, second: Pair) -> Tensor:
    return (first[0] * second[0]).sum((1, 2)) + (first[1] * second[1]).sum((1, 2))


def _add(first: tuple[Tensor, ...], second: tuple[Tensor, ...], factor: Tensor) -> Pair:
    scale = factor[:, None, None]
    return first[0] + scale * second[0], first[1] + scale * second[1]


class _NewtonStep(torch.autograd.Function):
    """-H^-1 g, with H symmetric and held constant."""

    @staticmethod
    def forward(ctx: Any, camera: Tensor, pose: Tensor, inverse_hessian: Callable[[Pair], Pair]) -> Pair:
        ctx.inverse_hessian = inverse_hessian
        # At the minimum the step itself is zero up to rounding; taking it as zero keeps the solver's answer to the bit.
        return torch.zeros_like(camera), torch.zeros_like(pose)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        camera, pose = ctx.inverse_hessian((gradients[0], gradients[1]))
        return -camera, -pose, None


def _detached(problem: Problem) -> Problem:
    return Problem(
        problem.uv.detach(), problem.root_weight.detach(), problem.points.detach(), problem.centroid.detach(),
        problem.radius_squared, problem.factory.map_tensors(lambda tensor, _: tensor.detach()), problem.spread.detach(),
    )  # fmt: skip
