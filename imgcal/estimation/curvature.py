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

from imgcal.estimation import levenberg_marquardt_cpu
from imgcal.estimation.levenberg_marquardt import Factorization
from imgcal.estimation.linearization import (
    POSE_PARAMETERS,
    Jacobian,
    Problem,
    State,
    Step,
    append_scale,
    jacobian_at,
    object_columns,
    points_at,
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

    def change(x: Step, follow: Step) -> Tensor:
        rigs = _step_rigs(estimate.problem, estimate.solution.state, _add_negatives(x), follow)
        there, back = quantity(*rigs).chunk(2, dim=1)
        return 0.5 * (there + back)

    found = _mean_square(estimate, change, flat.reshape(-1, *flat.shape[-2:]))
    return found.reshape(*estimate.chi2.shape, *found.shape[1:])


def whitened_curvature(estimate: Estimate, flat: Tensor) -> Tensor:
    """Mean square of the second-order change of the cameras' whitened offsets: (B, K C, K C).

    Offsets are what steps change, so x and -x cancel, and what follows them remains.

    Args:
        estimate: with batch axes *B, B rigs in all.
        flat: (B, K C, K C) covariance of the offsets in the Gaussian posterior.
    """
    return _mean_square(estimate, lambda _, follow: follow.camera.flatten(2), flat)


def _mean_square(estimate: Estimate, change: Callable[[Step, Step], Tensor], flat: Tensor) -> Tensor:
    """Average the square (B, Q, Q) of a second-order change over enough pairs of steps.

    Args:
        estimate: with batch axes *B, B rigs in all.
        change: maps steps x (B, K, ...) and the steps that follow them to numbers (B, K, Q).
        flat: (B, Q, Q) covariance to which the result is added.
    """
    most = MOST_PAIRS // estimate.problem.uv.shape[1]
    at = jacobian_at(estimate.problem, estimate.solution.state)

    def over(pairs: int) -> Tensor:
        x = _draw(estimate.solution.factorization, estimate.solution.state, pairs)
        even = change(x, _follow(estimate, at, x))
        return even.mT @ even / pairs

    found = over(LEAST_PAIRS)
    if most > LEAST_PAIRS:
        variance, added = (matrix.diagonal(dim1=-2, dim2=-1) for matrix in (flat, found))
        if bool((added > SLIGHT * variance).any()):
            return over(most)
    return found


def _add_negatives(x: Step) -> Step:
    """Concatenate steps (B, K, ...) and their negatives: (B, 2 K, ...)."""
    return x.map(lambda part: torch.cat((part, -part), dim=1))


def _rigs_at(problem: Problem, offset: Tensor) -> CameraRig:
    """Convert whitened offsets (B, K, C, parameters) of K rigs for each problem: rigs (B K)."""
    many = offset.shape[1]
    factory = problem.factory.map_tensors(lambda tensor, _: tensor.repeat_interleave(many, 0))
    problem = replace(problem, factory=factory, prior_std=problem.prior_std.repeat_interleave(many, 0))
    convert = levenberg_marquardt_cpu.rig_at if offset.device.type == "cpu" else rig_at
    return convert(problem, offset.flatten(0, 1))


def _step_rigs(problem: Problem, state: State, x: Step, follow: Step) -> tuple[CameraRig, Tensor]:
    """Rigs (B, 2 K) and fiducials (B, 2 K, N, 3) mm after steps in both directions and their second-order response."""
    camera = (state.offset.unsqueeze(1) + x.camera).unflatten(1, (2, -1)) + follow.camera.unsqueeze(1)
    rigs = _rigs_at(problem, camera.flatten(1, 2)).reshape(*x.camera.shape[:2])
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


def _follow(estimate: Estimate, at: Jacobian, x: Step) -> Step:
    """d(x) for steps (B, K, ...)."""
    problem, state = estimate.problem, estimate.solution.state
    squared = problem.root_weight.square()[..., None, None, :]
    by_rig = (at.by_rig[..., :-1, :, :] * squared).flatten(-2)  # (B, S, C, parameters, 2 N)
    by_object = None if at.by_fiducial is None else append_scale(problem, at.by_fiducial) * squared
    steps = []
    together = max(AT_ONCE, POINTS_AT_ONCE // at.residual[..., 0, :].numel())
    for first in range(0, x.camera.shape[1], together):
        some = Step(*(part if part is None else part[:, first : first + together] for part in x))  # type: ignore[arg-type]
        there, back = _pixels(problem, state, _add_negatives(some)).chunk(2, dim=1)
        bend = 0.5 * (there + back) - (at.residual + problem.uv).unsqueeze(1)  # (B, K, S, C, 2, N)
        right = -(by_rig @ bend.movedim(1, -1).flatten(3, 4)).movedim(-1, 1)  # (B, K, S, C, parameters)
        camera, pose, own = right[..., :-POSE_PARAMETERS].sum(2), right[..., -POSE_PARAMETERS:].sum(3), None
        if by_object is not None and problem.object_prior_std is not None:
            sums = torch.einsum("bscirn,bkscrn->bkin", by_object, bend)
            own = -object_columns(sums) * problem.object_prior_std.unsqueeze(1)
        steps.append(estimate.solution.factorization.solve_many(Step(camera, pose, own)))
    cameras, poses = (torch.cat([step[i] for step in steps], dim=1) for i in (0, 1))  # type: ignore[misc]
    objects = [step.object for step in steps if step.object is not None]
    return Step(cameras, poses, torch.cat(objects, dim=1) if objects else None)


def _pixels(problem: Problem, state: State, step: Step) -> Tensor:
    """Pixels (B, K, S, C, 2, N) after steps (B, K, ...)."""
    one = State(state.offset.unsqueeze(1), state.rotation.unsqueeze(1), state.centre.unsqueeze(1))
    there = retract(problem, one, step.camera, step.pose)
    own = points_at(problem, state).unsqueeze(1)
    if step.object is not None:
        own = own + _own_shift(problem, step.object)
    points = own.unsqueeze(2) @ there.rotation.mT + there.centre.unsqueeze(-2)  # (B, K, S, N, 3)
    snapshots, fiducials = points.shape[2:4]
    radius = None if problem.radius_squared is None else problem.radius_squared.sqrt().repeat(snapshots)
    uv = _rigs_at(problem, there.offset).project_values(points.flatten(2, 3).flatten(0, 1), radius).uv
    uv = uv.unflatten(2, (snapshots, fiducials)).permute(0, 2, 1, 4, 3)  # (B K, S, C, 2, N)
    return uv.unflatten(0, (len(problem.uv), -1))
