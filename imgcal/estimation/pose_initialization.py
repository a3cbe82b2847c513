"""Initial guess of an object's pose from labelled fiducials in all cameras, without iterating on images.

The distance of a fiducial from the ray through its pixel is linear in the pose's nine rotation entries and the
translation. With the translation eliminated, a quadratic form on rotations remains, nine by nine for any number of
cameras and fiducials. It is minimized from the best of sixty starts at once.

Source: object-space error of Lu, Hager and Mjolsness (PAMI 2000), generalized cameras as in Schweighofer and Pinz (BMVC
2008), quadratic form in the rotation entries as in SQPnP (Terzakis and Lourakis, ECCV 2020).
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from imgcal.geometry import ModelNames, RigidTransform, kernels, rotation_from_vector, undistort, undistort_cpu
from imgcal.types import CalibrationObject, CameraRig, Observations
from renderers.compiling import njit

STARTS = 8
ITERATIONS = 10
"""Maximum number of Gauss-Newton steps on the rotation."""
LEAST_TURN = 1e-9
"""Radians: a smaller step means that the rotation has converged."""


@dataclass(frozen=True)
class _QuadraticForm:
    """cost(r) = r^T matrix r + 2 vector^T r + constant, where r holds the rotation's entries row by row."""

    matrix: Tensor  # (P, 9, 9)
    vector: Tensor  # (P, 9)
    translation_slope: Tensor  # (P, 3, 9) best translation = translation_constant - translation_slope @ r
    translation_constant: Tensor  # (P, 3)


def initial_pose(observations: Observations, rig: CameraRig, obj: CalibrationObject) -> RigidTransform:
    """Estimate the object's pose with a fixed rig.

    Args:
        observations: (*B, S, C, N). The pose of a snapshot that does not determine it is arbitrary, but finite.
        rig: (*B) or without batch axes.
        obj: N fiducials, planar or not.

    Returns:
        (*B, S) rig_from_object with the smallest object-space error among those in front of the cameras. Meant as a
        start: pixels are not weighted by distance.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> from imgcal.types import Observations
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
        >>> observations = Observations(truth.uv, torch.full(seen.shape, 0.05), seen)
        >>> poses = initial_pose(observations, truth.rig, obj)
        >>> float((poses.translation - truth.rig_from_object.translation).norm(dim=-1).max()) < 1  # mm
        True
    """
    batch = observations.seen.shape[:-2]
    points = obj.points.to(observations.uv)
    centroid = points.mean(0)
    centred = points - centroid
    given = (observations.uv, rig.focal_length, rig.principal_point, rig.distortion, rig.cam_from_rig.rotation)
    plain = not any(t.device.type != "cpu" or (t.requires_grad and torch.is_grad_enabled()) for t in given)
    rays, origins = _rays(observations, rig, undistort_cpu if plain else undistort)  # (P, C, N, 3), (P, C, 3)
    seen = observations.seen.reshape(-1, *observations.seen.shape[-2:]).to(rays.dtype)
    form = _quadratic_form(rays, origins, seen, centred)
    starts = _icosahedral_rotations().to(rays)
    promising = _cost(form, starts.expand(len(rays), -1, -1, -1)).topk(STARTS, largest=False).indices
    minimized = _minimize_cpu if plain else _minimize_on_rotations
    # A single light has no rotation.
    rotation = minimized(form, starts[promising], ITERATIONS if bool(centred.any()) else 0)  # (P, M, 3, 3)

    entries, cost = rotation.flatten(-2), _cost(form, rotation)
    translation = form.translation_constant[:, None] - entries @ form.translation_slope.mT
    placed = centred @ rotation.mT + translation[..., None, :]  # (P, M, N, 3)
    along = torch.einsum("pcnk,pmnk->pmcn", rays, placed) - torch.einsum("pcnk,pck->pcn", rays, origins)[:, None]
    behind = ((along <= 0) * seen[:, None]).sum((-2, -1))
    scale = cost.abs().amax(-1, keepdim=True) + 1
    best = (cost + behind * scale).argmin(-1)
    chosen = rotation[torch.arange(len(best)), best]
    shift = translation[torch.arange(len(best)), best] - (chosen @ centroid)
    return RigidTransform(chosen.reshape(*batch, 3, 3), shift.reshape(*batch, 3))


@cache
def _icosahedral_rotations() -> Tensor:
    """The rotations of the icosahedron: (60, 3, 3)."""
    return torch.from_numpy(Rotation.create_group("I").as_matrix())


def _rays(
    observations: Observations, rig: CameraRig, undistort: Callable[[Tensor, Tensor, ModelNames], tuple[Tensor, Tensor]]
) -> tuple[Tensor, Tensor]:
    """Viewing rays in the rig frame, rigs and snapshots flattened: unit directions (P, C, N, 3), origins (P, C, 3)."""
    dtype = observations.uv.dtype
    rig = rig.to(dtype)
    uv = torch.where(observations.seen[..., None], observations.uv, rig.principal_point.unsqueeze(-2).unsqueeze(-4))
    flat = (rig.principal_point, rig.focal_length)
    principal, focal = (value.unsqueeze(-2).unsqueeze(-4) for value in flat)
    distortion = rig.distortion.unsqueeze(-3).expand(*uv.shape[:-2], -1)
    xy, _ = undistort((uv - principal) / focal, distortion, rig.lens_model)
    directions = torch.nn.functional.normalize(torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1), dim=-1)
    rotation = rig.cam_from_rig.rotation.unsqueeze(-4)
    rays = (directions @ rotation).reshape(-1, *directions.shape[-3:])
    origins = rig.positions.unsqueeze(-3).expand(*uv.shape[:-2], 3)
    return rays, origins.reshape(-1, *origins.shape[-2:])


def _quadratic_form(rays: Tensor, origins: Tensor, seen: Tensor, points: Tensor) -> _QuadraticForm:
    """Sum the squared distances of the fiducials from their rays into a quadratic form."""
    eye = torch.eye(3, dtype=rays.dtype, device=rays.device)
    shown = rays * seen[..., None]
    # A ray r projects a point x across it to (1 - r r^T) x.
    across = seen.sum(1)[..., None, None] * eye - torch.einsum("pcni,pcnj->pnij", shown, rays)  # (P, N, 3, 3)
    along = (rays * origins[:, :, None]).sum(-1, keepdim=True)
    pulled = seen.mT @ origins - (shown * along).sum(1)  # (P, N, 3)
    total, flat = across.sum(1), across.flatten(2).mT  # (P, 3, 3), (P, 9, N)
    slope = (flat @ points).reshape(-1, 3, 9)
    squares = (points[:, :, None] * points[:, None]).flatten(1)  # (N, 9)
    matrix = (flat @ squares).unflatten(-1, (3, 3)).unflatten(1, (3, 3)).transpose(2, 3).flatten(3).flatten(1, 2)
    linear = (pulled.mT @ points).flatten(1)
    # A single ray leaves the translation along it undetermined, and none leaves all of it; slight regularization keeps
    # the solution finite. The trace is two for each ray.
    total = total + 1e-9 * total.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(2.0)[:, None, None] * eye
    solved = torch.linalg.solve(total, torch.cat((slope, pulled.sum(1)[..., None]), dim=-1))
    translation_slope, constant = solved[..., :9], solved[..., 9]
    return _QuadraticForm(
        matrix=matrix - slope.mT @ translation_slope,
        vector=(slope.mT @ constant[..., None]).squeeze(-1) - linear,
        translation_slope=translation_slope,
        translation_constant=constant,
    )


def _cost(form: _QuadraticForm, rotation: Tensor) -> Tensor:
    """Object-space error of rotations (P, M, 3, 3), up to a constant: (P, M) mm^2."""
    entries = rotation.flatten(-2)
    return (entries * (entries @ form.matrix + 2 * form.vector[:, None])).sum(-1)


def _minimize_on_rotations(form: _QuadraticForm, rotation: Tensor, iterations: int) -> Tensor:
    """Damped Gauss-Newton from many starts at once: (P, M, 3, 3) -> (P, M, 3, 3)."""
    vector = form.vector[:, None, :, None]
    generators = _generators(rotation)
    trace = form.matrix.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None, None]
    damping = 1e-6 * trace * torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    damping = torch.where(trace > 0, damping, torch.eye(3, dtype=rotation.dtype, device=rotation.device))  # one light
    for _ in range(iterations):
        tangent = torch.einsum("gij,pmjk->pmikg", generators, rotation).flatten(-3, -2)  # (P, M, 9, 3)
        # One product for the tangents and the rotation of all starts: (9, 9) @ (9, 4 M).
        both = torch.cat((tangent, rotation.flatten(-2)[..., None]), dim=-1)
        weighted = torch.einsum("pij,pmjk->pmik", form.matrix, both)
        right = tangent.mT @ (weighted[..., 3:] + vector)
        step = _solve_symmetric(tangent.mT @ weighted[..., :3] + damping, right.squeeze(-1))
        length = step.norm(dim=-1, keepdim=True)
        step = step * (0.7 / length.clamp_min(0.7))
        rotation = rotation_from_vector(-step) @ rotation
    return rotation


def _minimize_cpu(form: _QuadraticForm, rotation: Tensor, iterations: int) -> Tensor:
    """Do the work of `_minimize_on_rotations` for tensors on the CPU, without gradients."""
    result = rotation.double().contiguous()
    matrix, vector = (part.detach().double().contiguous().numpy() for part in (form.matrix, form.vector))
    _minimize_each(matrix, vector, result.numpy(), iterations)
    return result.to(rotation.dtype)


@njit(fastmath=kernels.FAST)
def _minimize_each(matrix, vector, rotation, iterations):
    """Replace rotations (P, M, 3, 3) by minimizers of their quadratic forms (P, 9, 9), (P, 9)."""
    tangent, pulled, right = np.zeros((3, 9)), np.empty((4, 9)), np.empty(3)
    square, turned, left, old = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    step = np.empty(3)
    for p in range(rotation.shape[0]):
        trace = 0.0
        for i in range(9):
            trace += matrix[p, i, i] / 9
        if trace <= 0:
            continue  # a single light has no rotation
        for m in range(rotation.shape[1]):
            now = rotation[p, m]
            for _ in range(iterations):
                for axis in range(3):
                    j, k = (axis + 1) % 3, (axis + 2) % 3
                    for i in range(3):
                        tangent[axis, 3 * k + i] = now[j, i]
                        tangent[axis, 3 * j + i] = -now[k, i]
                for i in range(9):
                    value = vector[p, i]
                    for j in range(9):
                        value += matrix[p, i, j] * now[j // 3, j % 3]
                    pulled[3, i] = value
                    for axis in range(3):
                        value = 0.0
                        for j in range(9):
                            value += matrix[p, i, j] * tangent[axis, j]
                        pulled[axis, i] = value
                for axis in range(3):
                    right[axis] = 0.0
                    for i in range(9):
                        right[axis] += tangent[axis, i] * pulled[3, i]
                    for other in range(3):
                        value = 1e-6 * trace if axis == other else 0.0
                        for i in range(9):
                            value += tangent[axis, i] * pulled[other, i]
                        square[axis, other] = value
                length = _solve_three(square, right, step)
                for axis in range(3):
                    step[axis] *= -0.7 / max(length, 0.7)
                for i in range(3):
                    for j in range(3):
                        old[i, j] = now[i, j]
                kernels.exponential(step, turned, left)
                kernels.multiply(turned, old, now)
                if length < LEAST_TURN:
                    break


@njit(fastmath=kernels.FAST)
def _solve_three(matrix, right, solution):
    """Solve a symmetric three-by-three system by cofactors and return the norm of the solution."""
    determinant, length = 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        determinant += matrix[0, i] * (matrix[1, j] * matrix[2, k] - matrix[1, k] * matrix[2, j])
    for i in range(3):
        value, a, b = 0.0, (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            value += (matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]) * right[j]
        solution[i] = value / determinant
        length += solution[i] ** 2
    return np.sqrt(length)


def _solve_symmetric(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve three-by-three systems by cofactors, faster than library calls: (*B, 3, 3), (*B, 3) -> (*B, 3)."""
    first, second, third = matrix.unbind(-2)
    cofactors = torch.stack(
        (torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second)), dim=-2
    )
    determinant = (first * cofactors[..., 0, :]).sum(-1, keepdim=True)
    return (cofactors @ right[..., None]).squeeze(-1) / determinant


def _generators(like: Tensor) -> Tensor:
    """The three infinitesimal generators of rotations: (3, 3, 3)."""
    generators = like.new_zeros(3, 3, 3)
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        generators[axis, k, j], generators[axis, j, k] = 1.0, -1.0
    return generators
