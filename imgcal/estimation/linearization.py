"""Reprojection residuals with analytic Jacobians, summed into the blocks of the normal equations.

The unknowns of each camera are K *whitened* offsets from the factory values: they are divided by the prior standard
deviation, so that the prior's information is the identity and a parameter with zero standard deviation stays fixed.
Those of each snapshot are 6 local offsets of the object: a rotation (left, about its centroid) and a translation in
units of the object's depth. Where the object is known only within tolerances, it has M = 3 N + 1 offsets of its own,
also whitened: each fiducial's coordinates (mm, in the object's frame), and one scale of all distances.

Rotations that move no fiducial (a stick about its axis, a single light) have no derivative and no coupling. They get
unit information, which fixes them, adds nothing to any other unknown and leaves every determinant unchanged.

Axes: B rigs, S snapshots, C cameras, N fiducials. Components come before fiducials, so that every step works on long
contiguous rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from imgcal.geometry import (
    NEAREST_DEPTH,
    ModelNames,
    RigidTransform,
    distort_by_coefficients,
    distort_with_jacobian,
    free_turns,
    left_jacobian,
    pose_rank,
    rotation_from_vector,
)
from imgcal.types import CameraRig

POSE_PARAMETERS = 6


@dataclass(frozen=True)
class Problem:
    """The estimation problem: observations, the object, the factory rig and its prior."""

    uv: Tensor  # (B, S, C, 2, N) pixels, observed
    root_weight: Tensor  # (B, S, C, N) 1 / sigma where seen, 0 elsewhere
    points: Tensor  # (N, 3) mm, fiducials about their centroid
    centroid: Tensor  # (3,) mm in the object's frame
    radius_squared: Tensor | None  # (N,) mm^2
    factory: CameraRig  # (B,)
    prior_std: Tensor  # (B, C, K) prior standard deviation of each parameter
    object_prior_std: Tensor | None = None  # (B, M) prior standard deviation of the object's parameters; None = exact
    modes: Tensor | None = None  # (K, N, 3) mm, about the centroid, by one prior standard deviation; see `shape_modes`
    mode_offset: Tensor | None = None  # (K,) whitened offset of each mode that `points` include; None = zero
    part_of: Tensor | None = None  # (N,) object to which each fiducial belongs, for several objects; None = one

    @property
    def pose_freedom(self) -> Tensor:
        """Number of pose parameters of each rig that the observations can determine: (B,)."""
        ranks = torch.tensor([pose_rank(points) for points in self.points_of_parts()], device=self.uv.device)
        if self.part_of is None:
            return self.uv.shape[1] * ranks.expand(len(self.uv))
        return ranks[self.part_of_rows()].sum(-1)

    def points_of_parts(self) -> list[Tensor]:
        """Fiducials (N_k, 3) of each object."""
        if self.part_of is None:
            return [self.points]
        return [self.points[self.part_of == part] for part in range(int(self.part_of.max()) + 1)]

    def part_of_rows(self) -> Tensor:
        """Object in each row, for several objects: (B, S); the first object for an empty row."""
        assert self.part_of is not None
        return self.part_of[(self.root_weight > 0).any(2).int().argmax(-1)]

    def select(self, rows: Tensor) -> Problem:
        """Select rigs by their indices (R,)."""
        prior_std = None if self.object_prior_std is None else self.object_prior_std[rows]
        return replace(
            self,
            uv=self.uv[rows],
            root_weight=self.root_weight[rows],
            factory=self.factory[rows],
            prior_std=self.prior_std[rows],
            object_prior_std=prior_std,
        )


@dataclass(frozen=True)
class State:
    """The unknowns."""

    offset: Tensor  # (B, C, K) whitened: (parameter - factory) / prior_std
    rotation: Tensor  # (B, S, 3, 3) rig_from_object
    centre: Tensor  # (B, S, 3) mm, the object's centroid in the rig frame
    object_offset: Tensor | None = None  # (B, M) whitened; None = the object is exact


@dataclass(frozen=True)
class ObjectEquations:
    """The object's part of the normal equations. `own` and `gradient` include the prior's identity and gradient."""

    camera: Tensor  # (B, C, K, M) coupling with the cameras
    pose: Tensor  # (B, S, 6, M) coupling with the poses
    own: Tensor  # (B, M, M)
    gradient: Tensor  # (B, M)


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton blocks at a state. `camera` and `camera_gradient` include the prior's identity and gradient."""

    cost: Tensor  # (B,) half the sum of robust squared residuals, data and prior
    camera: Tensor  # (B, C, K, K)
    coupling: Tensor  # (B, S, C, K, 6)
    pose: Tensor  # (B, S, 6, 6)
    camera_gradient: Tensor  # (B, C, K)
    pose_gradient: Tensor  # (B, S, 6)
    residual: Tensor  # (B, S, C, 2, N) pixels, predicted minus observed
    object: ObjectEquations | None = None  # None = the object is exact


def rig_at(problem: Problem, offset: Tensor) -> CameraRig:
    """Convert whitened offsets (B, C, K) to a rig."""
    return problem.factory.retract(offset * problem.prior_std)


def pose_at(problem: Problem, state: State) -> RigidTransform:
    """Convert the state's poses to transforms of the object's own frame: (B, S) rig_from_object."""
    return RigidTransform(state.rotation, state.centre - state.rotation @ problem.centroid)


def points_at(problem: Problem, state: State) -> Tensor:
    """Fiducials relative to the centroid of the object as given: (B, N, 3) mm in the object's frame."""
    points = problem.points.expand(len(state.offset), -1, -1)
    if state.object_offset is None or problem.object_prior_std is None:
        return points
    offset = state.object_offset * problem.object_prior_std
    return points * (1 + offset[:, -1, None, None]) + offset[:, :-1].unflatten(-1, (-1, 3))


class Step(NamedTuple):
    """A change of a state, or a vector of the same shape, such as a gradient."""

    camera: Tensor  # (B, C, K) whitened
    pose: Tensor  # (B, S, 6)
    object: Tensor | None = None  # (B, M) whitened; None = the object is exact

    def map(self, function: Callable[[Tensor], Tensor]) -> Step:
        """Apply a function to every part that is not None."""
        return Step(function(self.camera), function(self.pose), None if self.object is None else function(self.object))


def retract(
    problem: Problem, state: State, camera_step: Tensor, pose_step: Tensor, object_step: Tensor | None = None
) -> State:
    """Add a step: cameras (B, C, K) whitened, poses (B, S, 6), object (B, M) whitened or None; see `Step`."""
    rotation = rotation_from_vector(pose_step[..., :3]) @ state.rotation
    depth = _depth_unit(state)
    offset = state.object_offset
    if offset is not None and object_step is not None:
        offset = offset + object_step
    return State(state.offset + camera_step, rotation, state.centre + pose_step[..., 3:] * depth, offset)


def linearize(problem: Problem, state: State, loss: Callable[[Tensor], tuple[Tensor, Tensor]]) -> NormalEquations:
    """Evaluate residuals and Jacobians, and accumulate the normal equations.

    Args:
        problem: the problem.
        state: where to linearize.
        loss: maps squared whitened residuals (B, S, C, N) to (robust loss, its derivative), both per observation.

    Returns:
        The blocks. The cost is infinite where an observed fiducial lies behind its camera.
    """
    at = jacobian_at(problem, state)
    residual = at.residual
    squared = (residual * problem.root_weight.unsqueeze(-2)).square().sum(-2)
    value, slope = loss(squared)
    cost = 0.5 * value.sum((1, 2, 3)) + 0.5 * state.offset.square().sum((1, 2))
    cost = torch.where(at.behind, torch.inf, cost)

    root_weight = (problem.root_weight * slope.sqrt())[..., None, None, :]
    rows = (at.by_rig * root_weight).flatten(-2)  # (B, S, C, K + 7, 2N): K camera, 6 pose, 1 residual
    products = rows @ rows.mT
    k = state.offset.shape[-1]
    last = k + POSE_PARAMETERS
    over_snapshots = products[..., :k, :].sum(1)
    over_cameras = products[..., k:, k:].sum(2)
    eye = torch.eye(k, dtype=rows.dtype, device=rows.device)
    pose = over_cameras[..., :POSE_PARAMETERS, :POSE_PARAMETERS]
    turns = torch.stack([free_turns(points) for points in problem.points_of_parts()])
    if bool(turns.any()):
        turns = turns[0] if problem.part_of is None else turns[problem.part_of_rows()]
        pose = pose.clone()
        pose[..., :3, :3] += state.rotation @ turns @ state.rotation.mT
    own = None
    if at.by_fiducial is not None and state.object_offset is not None:
        cost = cost + 0.5 * state.object_offset.square().sum(1)
        own = _object_equations(problem, state.object_offset, at.by_rig * root_weight, at.by_fiducial * root_weight)
    return NormalEquations(
        cost=cost,
        camera=over_snapshots[..., :k] + eye,
        coupling=products[..., :k, k:last],
        pose=pose,
        camera_gradient=over_snapshots[..., last] + state.offset,
        pose_gradient=over_cameras[..., :POSE_PARAMETERS, POSE_PARAMETERS],
        residual=residual,
        object=own,
    )


def append_scale(problem: Problem, by_fiducial: Tensor) -> Tensor:
    """Append the derivative with respect to the object's scale: (B, S, C, 3, 2, N) -> (B, S, C, 4, 2, N)."""
    by_scale = (by_fiducial * problem.points.mT[:, None]).sum(-3, keepdim=True)
    return torch.cat((by_fiducial, by_scale), dim=-3)


def object_columns(sums: Tensor) -> Tensor:
    """Order sums (..., 4, N) like the object's parameters (..., M): coordinates of each fiducial, then the scale."""
    return torch.cat((sums[..., :3, :].mT.flatten(-2), sums[..., 3, :].sum(-1, keepdim=True)), dim=-1)


def _object_equations(problem: Problem, offset: Tensor, rows: Tensor, by_fiducial: Tensor) -> ObjectEquations:
    """Accumulate the object's part of the normal equations.

    Args:
        problem: the problem.
        offset: (B, M) the object's state.
        rows: (B, S, C, K + 7, 2, N) weighted Jacobian and residual, in the order of `jacobian_at`.
        by_fiducial: (B, S, C, 3, 2, N) weighted derivative of each pixel by its own fiducial's coordinates (mm).
    """
    fiducials = rows.shape[-1]
    each = append_scale(problem, by_fiducial)
    to_rest = torch.einsum("bscirn,bscjrn->bscijn", rows, each)  # (B, S, C, K + 7, 4, N)
    prior_std = problem.object_prior_std
    assert prior_std is not None

    among = torch.einsum("bscirn,bscjrn->bijn", each, each)  # (B, 4, 4, N)
    size = 3 * fiducials + 1
    own = among.new_zeros(len(among), size, size)
    blocks = own[:, :-1, :-1].unflatten(1, (fiducials, 3)).unflatten(-1, (fiducials, 3))
    blocks.diagonal(dim1=1, dim2=3).copy_(among[:, :3, :3])
    own[:, -1, :-1] = own[:, :-1, -1] = among[:, :3, 3].mT.flatten(1)
    own[:, -1, -1] = among[:, 3, 3].sum(-1)
    own = own * prior_std[:, :, None] * prior_std[:, None]
    wide = prior_std[:, None, None]
    first = rows.shape[-3] - POSE_PARAMETERS - 1
    last = first + POSE_PARAMETERS
    return ObjectEquations(
        camera=object_columns(to_rest[..., :first, :, :].sum(1)) * wide,
        pose=object_columns(to_rest[..., first:last, :, :].sum(2)) * wide,
        own=own + torch.eye(size, dtype=own.dtype, device=own.device),
        gradient=object_columns(to_rest[..., last, :, :].sum((1, 2))) * prior_std + offset,
    )


def _depth_unit(state: State) -> Tensor:
    """Unit of translations, chosen so that they move the image as much as rotations: (B, S, 1) mm."""
    return state.centre.norm(dim=-1, keepdim=True).clamp_min(1.0)


@dataclass(frozen=True)
class Jacobian:
    """Derivatives of the pixels at a state."""

    by_rig: Tensor  # (B, S, C, K + 7, 2, N): by K whitened camera and 6 pose parameters; the residual as last row
    by_fiducial: Tensor | None  # (B, S, C, 3, 2, N) by the fiducial's own coordinates (mm); None = the object is exact
    residual: Tensor  # (B, S, C, 2, N) pixels, predicted minus observed
    behind: Tensor  # (B,) bool: an observed fiducial lies behind its camera


def robust_weight(problem: Problem, at: Jacobian, loss: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Tensor:
    """Weight of each squared residual (px^-2) in the normal equations: (B, S, C, N)."""
    _, slope = loss((at.residual * problem.root_weight.unsqueeze(-2)).square().sum(-2))
    return problem.root_weight.square() * slope


def jacobian_at(problem: Problem, state: State) -> Jacobian:
    """Differentiate all pixels with respect to the unknowns.

    With p = R (q + centre - position) the point in the camera and q the rotated fiducial, the derivative of a pixel
    with respect to a left rotation of the camera is p x d, with respect to the position -R^T d, with respect to a
    rotation of the object q x R^T d, where d is the pixel's derivative with respect to p; with respect to the
    fiducial's coordinates in the object's frame it is Q^T R^T d, where Q is the object's rotation.
    """
    parameters = state.offset * problem.prior_std
    turn = parameters[..., :3]
    factory = problem.factory
    rotation = (rotation_from_vector(turn) @ factory.cam_from_rig.rotation).unsqueeze(1)  # (B, 1, C, 3, 3)
    position = (factory.positions + parameters[..., 3:6])[:, None, :, :, None]
    focal = (factory.focal_length + parameters[..., 6:8])[:, None, :, :, None]
    principal = (factory.principal_point + parameters[..., 8:10])[:, None, :, :, None]
    distortion = (factory.distortion + parameters[..., 10:])[:, None]

    rotated = (state.rotation @ points_at(problem, state).mT.unsqueeze(1)).unsqueeze(2)  # (B, S, 1, 3, N)
    points = rotation @ (rotated + state.centre[:, :, None, :, None] - position)  # (B, S, C, 3, N)
    behind = ((points[..., 2, :] <= NEAREST_DEPTH) & (problem.root_weight > 0)).flatten(1).any(-1)

    lens = _lens(points, problem.radius_squared, focal, distortion, factory.lens_model)
    residual = lens.distorted * focal + principal - problem.uv
    by_turn = torch.linalg.cross(points.unsqueeze(-2).expand_as(lens.by_point), lens.by_point, dim=-3)
    by_centre = (rotation.mT @ lens.by_point.flatten(-2)).unflatten(-1, lens.by_point.shape[-2:])

    k = parameters.shape[-1]
    jacobian = residual.new_zeros(*residual.shape[:3], k + POSE_PARAMETERS + 1, *residual.shape[3:])
    jacobian[..., 0:3, :, :] = (left_jacobian(turn).mT.unsqueeze(1) @ by_turn.flatten(-2)).view_as(by_turn)
    jacobian[..., 3:6, :, :] = -by_centre
    jacobian[..., 6:8, :, :].diagonal(dim1=-3, dim2=-2).copy_(lens.distorted.mT)
    jacobian[..., 8:10, :, :].diagonal(dim1=-3, dim2=-2).fill_(1)
    jacobian[..., 10:k, :, :] = lens.by_distortion
    jacobian[..., :k, :, :] *= problem.prior_std[:, None, :, :, None, None]
    by_turn = jacobian[..., k : k + 3, :, :]
    torch.linalg.cross(rotated.unsqueeze(-2).expand_as(by_centre), by_centre, dim=-3, out=by_turn)
    torch.mul(by_centre, _depth_unit(state)[:, :, None, :, None, None], out=jacobian[..., k + 3 : k + 6, :, :])
    jacobian[..., -1, :, :] = residual
    by_fiducial = None
    if problem.object_prior_std is not None:
        turned = state.rotation.mT.unsqueeze(2) @ by_centre.flatten(-2)
        by_fiducial = turned.unflatten(-1, by_centre.shape[-2:])
    return Jacobian(jacobian, by_fiducial, residual, behind)


@dataclass(frozen=True)
class _Lens:
    distorted: Tensor  # (B, S, C, 2, N) on the z = 1 plane
    by_point: Tensor  # (B, S, C, 3, 2, N) pixels per mm: derivative with respect to the point in the camera
    by_distortion: Tensor  # (B, S, C, D, 2, N) pixels


def _lens(
    points: Tensor, radius_squared: Tensor | None, focal: Tensor, distortion: Tensor, models: ModelNames
) -> _Lens:
    """Image of points (B, S, C, 3, N), for focal (B, 1, C, 2, 1), distortion (B, 1, C, D), and its derivatives."""
    depth = points[..., 2, :].clamp_min(NEAREST_DEPTH)
    if radius_squared is None:
        per_depth = 1 / depth
        log_slope = -per_depth
    else:
        # Spheres: x = X Z / (Z^2 - r^2), see projection.apparent_centre_scale.
        squared = depth * depth
        per_depth = depth / (squared - radius_squared)
        log_slope = -(squared + radius_squared) / (depth * (squared - radius_squared))
    x, y = points[..., 0, :] * per_depth, points[..., 1, :] * per_depth
    xd, yd, jxx, jxy, jyy, _ = distort_with_jacobian(x, y, distortion, models)
    by_x = focal * per_depth.unsqueeze(-2) * torch.stack((jxx, jxy), dim=-2)
    by_y = focal * per_depth.unsqueeze(-2) * torch.stack((jxy, jyy), dim=-2)
    by_z = (by_x * x.unsqueeze(-2) + by_y * y.unsqueeze(-2)) * (log_slope / per_depth).unsqueeze(-2)
    by_coefficients = torch.stack(distort_by_coefficients(x, y, distortion, models))  # (2, B, S, C, N, D)
    by_distortion = focal.unsqueeze(-3) * by_coefficients.movedim(0, -1).transpose(-3, -1).transpose(-3, -2)
    return _Lens(torch.stack((xd, yd), dim=-2), torch.stack((by_x, by_y, by_z), dim=-3), by_distortion)
