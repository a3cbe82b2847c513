"""Positions of a snapshot's lights, with their uncertainty: `LightPoints`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import pixel_jacobian, step_by_error
from imgcal.geometry import RigidTransform, cross_matrix
from imgcal.monitoring import RigBelief
from imgcal.online.object_pose import common_motion
from imgcal.types import Detections

Array = NDArray[np.float64]

NEWTON_STEPS = 3
"""Gauss-Newton steps, from a position that is right to a pixel."""


@dataclass(frozen=True)
class FoundLights:
    """Which blobs of a snapshot show the same light."""

    blobs: Detections  # of the snapshot
    light: NDArray[np.int64]  # (M,) number of each blob's light, -1 = none
    point: Array  # (L, 3) mm, approximate position of each light


@dataclass(frozen=True)
class LightPoints:
    """Lights of one snapshot as points in the rig's frame.

    Errors are relative to the cameras: they exclude a motion of the whole rig with everything it sees, and the rig's
    scale, which lights do not determine.
    """

    point: Array  # (L, 3) mm
    error: Array  # (L,) mm, expected RMS error
    seen: NDArray[np.bool_]  # (C, L), which camera saw which light

    def __len__(self) -> int:
        return len(self.point)


def light_points(
    belief: RigBelief,
    found: FoundLights,
    noise: Array,
    shake: Array,
    trusted: NDArray[np.bool_],
) -> LightPoints:
    """Triangulate the lights of a snapshot with the updated rig.

    Args:
        belief: about the rig.
        found: which blobs show which light.
        noise: (C,) px of noise beyond the blobs' own sigmas.
        shake: (C,) px by which all blobs of a camera are shifted alike.
        trusted: (C,) bool, cameras whose blobs count; they also define what stands still.

    Returns:
        The lights seen by two of these cameras, in the order of `found`.
    """
    rig, blobs, count = belief.rig, found.blobs, len(found.point)
    if trusted.sum() < 2:
        return LightPoints(np.empty((0, 3)), np.empty(0), np.empty((rig.num_cameras, 0), dtype=bool))
    rows = np.flatnonzero((found.light >= 0) & trusted[blobs.camera])
    camera, light = torch.from_numpy(blobs.camera[rows]).long(), torch.from_numpy(found.light[rows]).long()
    seen = np.zeros((rig.num_cameras, count), dtype=bool)
    seen[blobs.camera[rows], found.light[rows]] = True
    variance = (
        np.square(blobs.sigma[rows]) + np.square(noise)[blobs.camera[rows]] + np.square(shake)[blobs.camera[rows]]
    )
    weight, uv = torch.from_numpy(1 / variance).double(), torch.from_numpy(blobs.uv[rows]).double()
    point = torch.from_numpy(found.point).double()
    for _ in range(NEWTON_STEPS):
        by_point, _ = _jacobians(belief, point, camera, light)
        information = _information(by_point, weight, light, count)
        image = rig.project_values(point).uv[camera, light]
        pull = torch.einsum("mri,m,mr->mi", by_point, weight, uv - image)
        step = torch.linalg.pinv(information) @ point.new_zeros(count, 3).index_add_(0, light, pull)[..., None]
        point = point + step[..., 0]
    known, covariance, follows = _errors(belief, point, weight, (camera, light))
    known &= (seen.sum(0) >= 2) & point.isfinite().all(-1).numpy()
    common = common_motion(belief, RigidTransform.identity(dtype=torch.float64), trusted)
    across = (follows + common[3:] - cross_matrix(point) @ common[:3]).flatten(0, 1)
    across = torch.cat((across, across.new_zeros(len(across), len(belief.factor) - across.shape[1])), 1)
    half = torch.linalg.solve_triangular(belief.factor, across.mT, upper=False)
    variance_of_point = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) + half.square().sum(0).view(count, 3).sum(-1)
    error = variance_of_point.clamp_min(0).sqrt()
    return LightPoints(point.numpy()[known], error.numpy()[known], seen[:, known])


def distance_errors(belief: RigBelief, found: FoundLights, noise: Array) -> Array:
    """Standard deviations (L, L) mm of the distances between the lights of a snapshot, as the rig is known.

    Args:
        belief: about the rig.
        found: which blobs show which light.
        noise: (C,) px of noise beyond the blobs' own sigmas.
    """
    rows = np.flatnonzero(found.light >= 0)
    camera, light = (torch.from_numpy(part[rows]).long() for part in (found.blobs.camera, found.light))
    variance = np.square(found.blobs.sigma[rows]) + np.square(noise)[found.blobs.camera[rows]]
    point = torch.from_numpy(found.point).double()
    known, covariance, follows = _errors(belief, point, torch.from_numpy(1 / variance).double(), (camera, light))
    padded = torch.nn.functional.pad(follows.flatten(0, 1), (0, len(belief.factor) - follows.shape[-1]))
    half = torch.linalg.solve_triangular(belief.factor, padded.mT, upper=False).mT.unflatten(0, (-1, 3))  # (L, 3, D)
    along = torch.nn.functional.normalize(point[:, None] - point, dim=-1)
    by_rig = torch.einsum("ijk,ikd->ijd", along, half) - torch.einsum("ijk,jkd->ijd", along, half)
    own = torch.einsum("ijk,ikl,ijl->ij", along, covariance, along)
    error = (by_rig.square().sum(-1) + own + own.mT).clamp_min(0).sqrt().numpy()
    return np.where(known[:, None] & known, error, np.nan)


def _errors(
    belief: RigBelief, point: Tensor, weight: Tensor, where: tuple[Tensor, Tensor]
) -> tuple[NDArray[np.bool_], Tensor, Tensor]:
    """Errors of triangulated positions (L, 3).

    Args:
        belief: about the rig.
        point: (L, 3) mm.
        weight: (M,) of the blobs.
        where: camera and light of each blob, (M,) each.

    Returns:
        Which positions are determined; their covariance (L, 3, 3) for a perfect rig; and their motion by each error of
        the rig (L, 3, C K).
    """
    (camera, light), count = where, len(point)
    by_point, by_error = _jacobians(belief, point, camera, light)
    factor, failed = torch.linalg.cholesky_ex(_information(by_point, weight, light, count))
    known = (failed == 0).numpy() & factor.isfinite().all(-1).all(-1).numpy()
    usable = torch.from_numpy(known)[:, None, None]
    covariance = torch.cholesky_inverse(torch.where(usable, factor, torch.eye(3, dtype=torch.float64)))
    coupling = torch.zeros(count, *belief.unit.shape, 3, dtype=torch.float64)
    coupling.index_put_((light, camera), torch.einsum("mri,m,mrk->mki", by_point, weight, by_error), accumulate=True)
    return known, covariance, torch.einsum("lij,lckj->lick", covariance, coupling).flatten(2)


def _jacobians(belief: RigBelief, point: Tensor, camera: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of pixels by their light's position (M, 2, 3) and by errors of their camera (M, 2, K)."""
    by_camera = pixel_jacobian(belief.rig, point)[camera, light]
    return -by_camera[..., 3:6], by_camera @ (step_by_error(belief.rig) * belief.unit[:, None])[camera]


def _information(by_point: Tensor, weight: Tensor, light: Tensor, count: int) -> Tensor:
    """Information about each light's position from its own blobs: (L, 3, 3)."""
    parts = torch.einsum("mri,m,mrj->mij", by_point, weight, by_point)
    return parts.new_zeros(count, 3, 3).index_add_(0, light, parts)
