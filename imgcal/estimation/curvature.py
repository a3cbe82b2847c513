"""Second-order covariance that the Laplace approximation leaves out, because the posterior is curved.

Where the data leave some directions wide open (one snapshot, a wide prior), moving along them changes the image
nonlinearly by more than the noise, and the well-determined directions must compensate. To second order, a step x of the
posterior's own size is followed by

    d(x) = -H^-1 J^T W q(x),      q(x) = (r(x) + r(-x)) / 2 - r(0),

where r are the residuals, J their Jacobian and W their weights at the minimum, H the information. d is even in x, so
its mean square adds to the covariance. It is averaged over pairs x, -x drawn from the Gaussian posterior.

Source: the bias of nonlinear least squares, Box, "Bias in nonlinear estimation" (J. R. Stat. Soc. B 1971), and
parameter curvature, Bates and Watts (J. R. Stat. Soc. B 1980), by sampling instead of second derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor

from imgcal.estimation.levenberg_marquardt import Factorization
from imgcal.estimation.linearization import (
    POSE_PARAMETERS,
    Problem,
    State,
    Step,
    append_scale,
    jacobian_at,
    object_columns,
    points_at,
    pose_at,
    retract,
    rig_at,
)
from imgcal.estimation.map_estimate import Estimate
from imgcal.types import CameraRig

MOST_PAIRS, LEAST_PAIRS = 256, 64
"""Pairs drawn for one snapshot of a curved posterior, and for many snapshots, where it is narrow and hardly curved."""
SLIGHT = 0.1
"""Share of the variance up to which the second order is slight: the least number of pairs is then precise enough."""
AT_ONCE, POINTS_AT_ONCE = 16, 2**16
"""Pairs that are projected together; more as long as they have at most this many points in all."""
MOST_KEPT_NUMBERS = 2**17
"""Random numbers cached for the next estimate of the same size: drawing them takes as long as using them."""


def curvature_covariance(estimate: Estimate, quantity: Callable[[CameraRig, Tensor], Tensor], flat: Tensor) -> Tensor:
    """Mean square of the second-order change of a quantity.

    Args:
        estimate: with batch axes *B.
        quantity: maps rigs (B, K) and their fiducials about the object's centroid (B, K, N, 3) mm to numbers (B, K, Q),
            zero for the estimate itself.
        flat: (*B, Q, Q) covariance of the quantity in the Gaussian posterior: the less the posterior is curved, the
            fewer pairs are drawn.

    Returns:
        (*B, Q, Q), positive semidefinite: to be added to `flat`.
    """
    pairs = MOST_PAIRS // estimate.problem.uv.shape[1]
    found = _mean_square(estimate, quantity, LEAST_PAIRS)
    if pairs > LEAST_PAIRS:
        variance, added = (matrix.diagonal(dim1=-2, dim2=-1) for matrix in (flat, found))
        if bool((added > SLIGHT * variance).any()):
            return _mean_square(estimate, quantity, pairs)
    return found


def _mean_square(estimate: Estimate, quantity: Callable[[CameraRig, Tensor], Tensor], pairs: int) -> Tensor:
    """Average the square (*B, Q, Q) of the second-order change of a quantity over pairs of steps."""
    problem, solution = estimate.problem, estimate.solution
    factorization = solution.factorization
    x = _draw(factorization, solution.state, pairs)
    follow = _follow(problem, solution.state, factorization, x)
    there, back = quantity(*_step_rigs(problem, solution.state, _add_negatives(x), follow)).chunk(2, dim=1)
    even = 0.5 * (there + back)
    result = even.mT @ even / pairs
    return result.reshape(*estimate.chi2.shape, *result.shape[1:])


def _add_negatives(x: Step) -> Step:
    """Concatenate steps (B, K, ...) and their negatives: (B, 2 K, ...)."""
    return x.map(lambda part: torch.cat((part, -part), dim=1))


def _add_rig_axis(problem: Problem) -> Problem:
    """Give the cameras an axis for many rigs each, behind the batch: (B, 1)."""
    factory = problem.factory.map_tensors(lambda tensor, _: tensor.unsqueeze(1))
    return replace(problem, factory=factory, prior_std=problem.prior_std.unsqueeze(1))


def _step_rigs(problem: Problem, state: State, x: Step, follow: Step) -> tuple[CameraRig, Tensor]:
    """Rigs (B, 2 K) and fiducials (B, 2 K, N, 3) mm after steps in both directions and their second-order response."""
    camera = (state.offset.unsqueeze(1) + x.camera).unflatten(1, (2, -1)) + follow.camera.unsqueeze(1)
    rigs = rig_at(_add_rig_axis(problem), camera.flatten(1, 2))
    points = points_at(problem, state).unsqueeze(1).expand(-1, x.camera.shape[1], -1, -1)
    if x.object is not None and follow.object is not None and problem.object_prior_std is not None:
        moved = (x.object.unflatten(1, (2, -1)) + follow.object.unsqueeze(1)).flatten(1, 2)
        points = points + _own_shift(problem, moved)
    return rigs, points


def _own_shift(problem: Problem, offset: Tensor) -> Tensor:
    """Shift of the fiducials by offsets of the object (B, K, M): (B, K, N, 3) mm."""
    assert problem.object_prior_std is not None
    step = offset * problem.object_prior_std.unsqueeze(1)
    return problem.points * step[..., -1, None, None] + step[..., :-1].unflatten(-1, (-1, 3))


def _draw(factorization: Factorization, state: State, pairs: int) -> Step:
    """Draw steps from the Gaussian posterior: camera (B, K, C, parameters), pose (B, K, S, 6), object (B, K, M)."""
    reduced = factorization.reduced
    batch, count, size, wide = reduced.whitened.shape
    kept, eliminated = _normal((batch, wide, pairs), (batch, count, size, pairs), like=reduced.kept)
    kept = torch.linalg.solve_triangular(reduced.kept.mT, kept, upper=True)
    eliminated = eliminated - reduced.whitened @ kept.unsqueeze(1)
    eliminated = torch.linalg.solve_triangular(reduced.eliminated.mT, eliminated, upper=True).permute(0, 3, 1, 2)
    own = 0 if state.object_offset is None else state.object_offset.shape[1]
    blocks, border = kept.mT[..., : wide - own], kept.mT[..., wide - own :]
    if factorization.cameras_first:
        return Step(eliminated, blocks.unflatten(-1, (-1, POSE_PARAMETERS)), border if own else None)
    return Step(blocks.unflatten(-1, state.offset.shape[1:]), eliminated, border if own else None)


def _normal(*shapes: tuple[int, ...], like: Tensor) -> tuple[Tensor, ...]:
    """Draw standard normal numbers with a fixed seed, so that equal estimates have equal covariances."""
    if sum(math.prod(shape) for shape in shapes) <= MOST_KEPT_NUMBERS:
        return _kept_normal(shapes, like.dtype, like.device)
    return _new_normal(shapes, like.dtype, like.device)


def _new_normal(shapes: tuple[tuple[int, ...], ...], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    generator = torch.Generator(device).manual_seed(0)
    return tuple(torch.randn(shape, generator=generator, dtype=dtype, device=device) for shape in shapes)


_kept_normal = lru_cache(maxsize=4)(_new_normal)


def _follow(problem: Problem, state: State, factorization: Factorization, x: Step) -> Step:
    """d(x) for steps (B, K, ...)."""
    at = jacobian_at(problem, state)
    squared = problem.root_weight.square()[..., None, None, :]
    by_rig = at.by_rig[..., :-1, :, :] * squared
    by_object = None if at.by_fiducial is None else append_scale(problem, at.by_fiducial) * squared
    steps = []
    together = max(AT_ONCE, POINTS_AT_ONCE // at.residual[..., 0, :].numel())
    for first in range(0, x.camera.shape[1], together):
        some = Step(*(part if part is None else part[:, first : first + together] for part in x))  # type: ignore[arg-type]
        there, back = _residual(problem, state, _add_negatives(some)).chunk(2, dim=1)
        bend = 0.5 * (there + back) - at.residual.unsqueeze(1)  # (B, K, S, C, 2, N)
        right = -torch.einsum("bscirn,bkscrn->bksci", by_rig, bend)
        camera, pose, own = right[..., :-POSE_PARAMETERS].sum(2), right[..., -POSE_PARAMETERS:].sum(3), None
        if by_object is not None and problem.object_prior_std is not None:
            sums = torch.einsum("bscirn,bkscrn->bkin", by_object, bend)
            own = -object_columns(sums) * problem.object_prior_std.unsqueeze(1)
        steps.append(factorization.solve_many(Step(camera, pose, own)))
    cameras, poses = (torch.cat([step[i] for step in steps], dim=1) for i in (0, 1))  # type: ignore[misc]
    objects = [step.object for step in steps if step.object is not None]
    return Step(cameras, poses, torch.cat(objects, dim=1) if objects else None)


def _residual(problem: Problem, state: State, step: Step) -> Tensor:
    """Residuals (B, K, S, C, 2, N) px after steps (B, K, ...)."""
    many = _add_rig_axis(problem)
    one = State(state.offset.unsqueeze(1), state.rotation.unsqueeze(1), state.centre.unsqueeze(1))
    there = retract(many, one, step.camera, step.pose)
    own = points_at(problem, state).unsqueeze(1)
    if step.object is not None:
        own = own + _own_shift(problem, step.object)
    points = pose_at(many, there).apply((own + problem.centroid).unsqueeze(2)).flatten(0, 1)  # (B K, S, N, 3)
    snapshots, fiducials = points.shape[1:3]
    radius = None if problem.radius_squared is None else problem.radius_squared.sqrt().repeat(snapshots)
    rigs = rig_at(many, there.offset).reshape(len(points))
    uv = rigs.project_values(points.flatten(1, 2), radius).uv  # (B K, C, S N, 2)
    uv = uv.unflatten(2, (snapshots, fiducials)).permute(0, 2, 1, 4, 3).unflatten(0, (len(problem.uv), -1))
    return uv - problem.uv.unsqueeze(1)
