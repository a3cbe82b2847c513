"""Gradients through a MAP solution, by the implicit function theorem.

At the minimum the gradient g of the cost by the unknowns x is zero for any data, so dx = -H^-1 dg. One more Newton
step, x - H^-1 g with H held constant, therefore has the value of the solution and exactly its derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import Problem, State, Step, points_at, pose_at, retract, rig_at
from imgcal.estimation.robust_losses import RobustKernel


def attach_gradient(problem: Problem, solution: Solution, loss: RobustKernel) -> State:
    """Return the solution's state, connected to every tensor in `problem` that requires a gradient."""
    factory = problem.factory
    inputs = (
        problem.uv, problem.root_weight, problem.prior_std, problem.points, problem.object_prior_std,
        factory.focal_length, factory.principal_point, factory.distortion,
        factory.cam_from_rig.rotation, factory.cam_from_rig.translation,
    )  # fmt: skip
    if not (torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in inputs)):
        return solution.state
    # The solver stops where another step would hardly lower the cost. By the prior's widths, the gradient is
    # proportional to the offsets, small ones included: it is taken where Newton's next step would lead.
    constant = _detach(problem)
    next_step = _inverse_hessian(constant, solution, loss)(
        _gradient(constant, solution.state, loss, create_graph=False)
    )
    nearer = replace(solution, state=retract(constant, solution.state, *next_step.map(torch.neg)))
    gradient = _gradient(problem, nearer.state, loss, create_graph=True)
    step = _NewtonStep.apply(_inverse_hessian(constant, nearer, loss), *gradient)
    return retract(problem, solution.state, *step)


def map_cost(problem: Problem, state: State, loss: RobustKernel) -> Tensor:
    """The cost that the solver minimizes, through the projection of `CameraRig`: (B,), differentiable in everything."""
    poses = pose_at(problem, state)
    rig = rig_at(problem, state.offset)
    fiducials = points_at(problem, state) + problem.centroid
    batch, snapshots, cameras, _, count = problem.uv.shape
    points_rig = poses.apply(fiducials.unsqueeze(1)).flatten(1, 2)  # (B, S N, 3)
    radius = None if problem.radius_squared is None else problem.radius_squared.sqrt().repeat(snapshots)
    uv = rig.project(points_rig, radius).uv.view(batch, cameras, snapshots, count, 2).permute(0, 2, 1, 4, 3)
    whitened = (uv - problem.uv) * problem.root_weight.unsqueeze(-2)
    value, _ = loss(whitened.square().sum(-2))
    cost = 0.5 * value.sum((1, 2, 3)) + 0.5 * state.offset.square().sum((1, 2))
    return cost if state.object_offset is None else cost + 0.5 * state.object_offset.square().sum(1)


def _gradient(problem: Problem, state: State, loss: RobustKernel, create_graph: bool) -> Step:
    """Gradient of the cost by a step from `state`."""
    with torch.enable_grad():
        step = _zero_step(state)
        cost = map_cost(problem, retract(problem, state, *step), loss).sum()
        return Step(*torch.autograd.grad(cost, _parts(step), create_graph=create_graph))


def _zero_step(state: State) -> Step:
    camera = torch.zeros_like(state.offset, requires_grad=True)
    pose = state.centre.new_zeros(*state.centre.shape[:-1], 6, requires_grad=True)
    own = None if state.object_offset is None else torch.zeros_like(state.object_offset, requires_grad=True)
    return Step(camera, pose, own)


def _inverse_hessian(problem: Problem, solution: Solution, loss: RobustKernel) -> Callable[[Step], Step]:
    """Return the map v -> H^-1 v for the exact Hessian at the solution.

    Conjugate gradients on exact Hessian products, preconditioned by the Gauss-Newton factorization: a handful of
    iterations, because the two differ only by curvature times residual.
    """
    precondition = solution.factorization.solve

    def product(v: Step) -> Step:
        with torch.enable_grad():
            step = _zero_step(solution.state)
            cost = map_cost(problem, retract(problem, solution.state, *step), loss).sum()
            gradient = Step(*torch.autograd.grad(cost, _parts(step), create_graph=True))
            constant = Step(*(part.detach() for part in _parts(v)))
            return Step(*torch.autograd.grad(_dot(gradient, constant).sum(), _parts(step)))

    def solve(v: Step) -> Step:
        return _conjugate_gradients(product, precondition, v)

    return solve


def _conjugate_gradients(product: Callable[[Step], Step], precondition: Callable[[Step], Step], right: Step) -> Step:
    """Solve H x = right for every rig of the batch at once."""
    x = right.map(torch.zeros_like)
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
    return x


def _parts(step: Step) -> tuple[Tensor, ...]:
    """List the parts of a step; an exact object has none."""
    return tuple(part for part in step if part is not None)


def _dot(first: Step, second: Step) -> Tensor:
    products = [(a * b).flatten(1).sum(1) for a, b in zip(_parts(first), _parts(second), strict=True)]
    return torch.stack(products).sum(0)


def _add(first: Step, second: Step, factor: Tensor) -> Step:
    pairs = zip(_parts(first), _parts(second), strict=True)
    return Step(*(a + factor.view(-1, *[1] * (a.ndim - 1)) * b for a, b in pairs))


class _NewtonStep(torch.autograd.Function):
    """-H^-1 g for symmetric, constant H."""

    @staticmethod
    def forward(
        ctx: Any, inverse_hessian: Callable[[Step], Step], camera: Tensor, pose: Tensor, own: Tensor | None = None
    ) -> Step:
        ctx.inverse_hessian = inverse_hessian
        # At the minimum the step is zero up to rounding; returning exactly zero keeps the solver's answer bit for bit.
        zeros = (None if part is None else torch.zeros_like(part) for part in (camera, pose, own))
        return tuple(zeros)  # type: ignore[return-value]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        found = _Solve.apply(ctx.inverse_hessian, *gradients)
        return (None, *(None if part is None else -part for part in found))


class _Solve(torch.autograd.Function):
    """H^-1 v for symmetric, constant H. It is its own transpose, which gives higher derivatives."""

    @staticmethod
    def forward(ctx: Any, inverse_hessian: Callable[[Step], Step], *vector: Tensor) -> Step:
        ctx.inverse_hessian = inverse_hessian
        return tuple(inverse_hessian(Step(*vector)))  # type: ignore[return-value]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *_Solve.apply(ctx.inverse_hessian, *gradients))


def _detach(problem: Problem) -> Problem:
    constant = {
        field.name: value.detach()
        for field in fields(problem)
        if isinstance(value := getattr(problem, field.name), Tensor)
    }
    return replace(problem, **constant, factory=problem.factory.map_tensors(lambda tensor, _: tensor.detach()))
