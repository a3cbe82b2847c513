"""The object's pose in a snapshot, with its covariance: `ObjectPose`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import Gauge, object_prior_std, pixel_jacobian, step_by_error
from imgcal.geometry import RigidTransform, cross_matrix
from imgcal.monitoring import RigBelief
from imgcal.types import Detections

POSE, EXTRINSICS = 6, 6


@dataclass(frozen=True)
class ObjectPose:
    """The object's pose in one snapshot.

    Convention: the true pose is exp(w) R, t + v, where R and t are those of `rig_from_object`, w (rad) turns about the
    rig's axes and v (mm) shifts along them. Errors (w, v) are relative to the cameras: they exclude a motion of the
    whole rig with everything it sees, which no image shows.
    """

    rig_from_object: RigidTransform
    covariance: Tensor  # (6, 6) of w (rad) and v (mm)
    markers: int  # number of fiducials seen
    cameras: int  # number of cameras that saw some
    points_object: Tensor | None = None  # (N, 3) mm, the fiducials as currently estimated
    seen: NDArray[np.bool_] | None = None  # (C, N), which camera saw which fiducial

    def matrix(self) -> NDArray[np.float64]:
        """The pose as (4, 4), translation in mm."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rig_from_object.rotation.numpy()
        matrix[:3, 3] = self.rig_from_object.translation.numpy()
        return matrix

    def std(self) -> tuple[float, float]:
        """Expected RMS error of the rotation (rad) and of the object's origin (mm)."""
        variance = self.covariance.diagonal().clamp_min(0)
        return float(variance[:3].sum().sqrt()), float(variance[3:].sum().sqrt())

    def points_rig(self) -> tuple[Tensor, Tensor]:
        """The fiducials, (N, 3) mm in the rig's frame, and their expected RMS error (N,) mm."""
        assert self.points_object is not None
        turned = self.points_object @ self.rig_from_object.rotation.mT
        by_pose = torch.cat((-cross_matrix(turned), torch.eye(3).to(turned).expand(len(turned), 3, 3)), dim=-1)
        variance = torch.einsum("nij,jk,nik->n", by_pose, self.covariance.to(turned), by_pose)
        return turned + self.rig_from_object.translation, variance.clamp_min(0).sqrt()


def object_pose(
    belief: RigBelief,
    rig_from_object: RigidTransform,
    blobs: Detections,
    noise: NDArray[np.float64],
    shake: NDArray[np.float64],
    trusted: NDArray[np.bool_],
) -> ObjectPose | None:
    """Estimate a pose's covariance from its own blobs and the updated belief about rig and object.

    Args:
        belief: about the rig, the snapshot included.
        rig_from_object: the most probable pose, without batch axes.
        blobs: of the snapshot, labelled where identified.
        noise: (C,) px of noise beyond the blobs' own sigmas.
        shake: (C,) px by which all blobs of a camera are shifted alike.
        trusted: (C,) bool, cameras whose labels count; they also define what stands still.

    Returns:
        The pose; None if these blobs do not determine it.
    """
    rows = np.flatnonzero((blobs.fiducial >= 0) & trusted[blobs.camera])
    if not len(rows):
        return None
    camera, fiducial = torch.from_numpy(blobs.camera[rows]).long(), torch.from_numpy(blobs.fiducial[rows]).long()
    weight = torch.from_numpy(1 / (np.square(blobs.sigma[rows]) + np.square(noise[blobs.camera[rows]]))).double()
    by_pose, by_error, by_object = _jacobians(belief, rig_from_object, camera, fiducial)
    weighted = by_pose * weight[:, None, None]
    count, width = belief.unit.shape
    information = torch.einsum("mri,mrj->ij", weighted, by_pose)
    coupling = _sums(torch.einsum("mri,mrk->mik", weighted, by_error), camera, count)  # (C, 6, K)
    # A camera that shakes shifts all fiducials alike by an unknown amount, which is integrated out.
    # (C, 2, 6) and (C, 2, K):
    shift_pose, shift_error = (_sums(part * weight[:, None, None], camera, count) for part in (by_pose, by_error))
    shared = 1 / (1 / torch.from_numpy(shake).double().square().clamp_min(1e-30) + _sums(weight, camera, count))
    information = information - torch.einsum("cri,c,crj->ij", shift_pose, shared, shift_pose)
    coupling = coupling - torch.einsum("cri,c,crk->cik", shift_pose, shared, shift_error)
    factor, failed = torch.linalg.cholesky_ex(information)
    if bool(failed) or not bool(factor.isfinite().all()):
        return None
    # (6, D):
    across = torch.cat((coupling.transpose(0, 1).flatten(1), torch.einsum("mri,mrk->ik", weighted, by_object)), dim=1)
    follows = torch.cholesky_solve(across, factor)  # minus the derivative of the pose by the rig
    follows[:, : count * width] += common_motion(belief, rig_from_object, trusted)
    half = torch.linalg.solve_triangular(belief.factor, follows.mT, upper=False)
    covariance = torch.cholesky_inverse(factor) + half.mT @ half
    seen = np.zeros((count, len(belief.points_object)), dtype=bool)
    seen[blobs.camera[rows], blobs.fiducial[rows]] = True
    markers, cameras = int(seen.any(0).sum()), int(seen.any(1).sum())
    return ObjectPose(rig_from_object, covariance, markers, cameras, belief.points_object, seen)


def _jacobians(
    belief: RigBelief, pose: RigidTransform, camera: Tensor, fiducial: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of pixels by the pose (M, 2, 6), by errors of their camera (M, 2, K) and by the object (M, 2, Q)."""
    rig, obj, points = belief.rig, belief.obj, belief.points_object
    rotated = points @ pose.rotation.mT
    by_camera = pixel_jacobian(rig, rotated + pose.translation)[camera, fiducial]
    by_point = -by_camera[..., 3:6]
    turned = torch.linalg.cross(rotated[fiducial, None].expand_as(by_point), by_point)
    by_error = by_camera @ (step_by_error(rig) * belief.unit[:, None])[camera]
    by_object = by_point.new_zeros(len(camera), 2, len(belief.object_offset))
    if len(belief.object_offset):
        std, own = object_prior_std(obj), by_point @ pose.rotation
        places = 3 * fiducial[:, None] + torch.arange(3)
        by_object.scatter_(2, places[:, None].expand(-1, 2, -1), own * std[places][:, None])
        by_object[..., -1] = (own * (obj.points - obj.points.mean(0))[fiducial][:, None]).sum(-1) * std[-1]
    return torch.cat((turned, by_point), -1), by_error, by_object


def common_motion(belief: RigBelief, pose: RigidTransform, trusted: NDArray[np.bool_]) -> Tensor:
    """Motion of the pose (6, K C) that goes with the errors of the rig shared by its cameras."""
    motion = Gauge(torch.from_numpy(trusted).double()).averaging_matrix(belief.rig).unflatten(1, (-1, EXTRINSICS))
    by_error = torch.zeros(POSE, *belief.unit.shape, dtype=torch.float64)
    by_error[..., :EXTRINSICS] = motion * belief.unit[:, :EXTRINSICS]
    carried = torch.eye(POSE, dtype=torch.float64)
    carried[3:, :3] = -cross_matrix(pose.translation)
    return carried @ by_error.flatten(1)


def _sums(values: Tensor, camera: Tensor, count: int) -> Tensor:
    """Sum (M, ...) per camera: (C, ...)."""
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, camera, values)
