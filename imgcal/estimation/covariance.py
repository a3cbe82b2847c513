"""Posterior covariance of an estimate: of each camera, of the cameras relative to one another, of the poses.

All are Laplace approximations: the inverse of the Gauss-Newton information at the minimum, prior included.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import arrow
from imgcal.estimation.estimate import Estimate
from imgcal.estimation.linearize import POSE_PARAMETERS
from imgcal.estimation.solver import factorize
from imgcal.rig import PARAMETERS, CameraRig
from imgcal.rotations import cross_matrix, left_jacobian
from imgcal.transforms import RigidTransform


def camera_covariance(estimate: Estimate) -> Tensor:
    """Joint covariance of all cameras' parameters.

    Returns:
        (*B, 15 C, 15 C) in the units and order of `rig.PARAMETER_NAMES`, camera after camera; rotations are small left
        rotations about the estimated orientation. Includes the gauge: a motion of the whole rig is known only as well
        as the prior knows it; see `relative_covariance`.

    Raises:
        RefusedError: the information is singular (a snapshot with too few fiducials).
    """
    equations = estimate.solution.equations
    reduced, cameras_first = factorize(equations)
    if bool(reduced.failed.any()):
        raise RefusedError("covariance: the observations do not determine the object's pose in every snapshot")
    cameras = equations.camera.shape[1]
    if cameras_first:
        inverse = torch.cholesky_inverse(reduced.eliminated)
        half = torch.linalg.solve_triangular(reduced.eliminated.mT, reduced.whitened, upper=True).flatten(1, 2)
        spread = torch.linalg.solve_triangular(reduced.kept, half.mT, upper=False)
        covariance = spread.mT @ spread
        blocks = covariance.unflatten(1, (cameras, PARAMETERS)).unflatten(-1, (cameras, PARAMETERS))
        blocks.diagonal(dim1=1, dim2=3).add_(inverse.permute(0, 2, 3, 1))
    else:
        covariance = torch.cholesky_inverse(reduced.kept)
    scale = _unwhitening(estimate).flatten(1, 2)  # (B, 15 C, 15): one block a camera
    blocks = covariance.unflatten(1, (cameras, PARAMETERS)).unflatten(-1, (cameras, PARAMETERS))
    per_camera = scale.unflatten(1, (cameras, PARAMETERS))
    physical = torch.einsum("bcij,bcjdk,bdlk->bcidl", per_camera, blocks, per_camera)
    size = cameras * PARAMETERS
    return physical.reshape(*estimate.chi2.shape, size, size)


def camera_std(estimate: Estimate) -> Tensor:
    """One standard deviation of every parameter: (*B, C, 15)."""
    variance = camera_covariance(estimate).diagonal(dim1=-2, dim2=-1)
    return variance.clamp_min(0).sqrt().unflatten(-1, (estimate.rig.cameras, PARAMETERS))


def relative_covariance(estimate: Estimate, reference: int = 0) -> Tensor:
    """Covariance with the extrinsics relative to a reference camera: free of the gauge.

    Returns:
        (*B, 15 C, 15 C) like `camera_covariance`; the rotation is that of cam_from_reference, the position that of the
        camera in the reference camera's frame. The reference's own six entries are zero.
    """
    covariance = camera_covariance(estimate)
    jacobian = relative_jacobian(estimate.rig, reference)
    return jacobian @ covariance @ jacobian.mT


def relative_jacobian(rig: CameraRig, reference: int) -> Tensor:
    """Derivative of all parameters relative to a reference camera by the parameters: (*B, 15 C, 15 C).

    For cam_from_reference = R_i R_r^T, a left rotation w_i - R_i R_r^T w_r; for the position p = R_r (c_i - c_r), the
    change w_r x p + R_r (dc_i - dc_r).
    """
    cameras, rotation, positions = rig.cameras, rig.cam_from_rig.rotation, rig.positions
    to_reference = rotation[..., reference : reference + 1, :, :]
    relative = rotation @ to_reference.mT  # (*B, C, 3, 3)
    place = (to_reference @ (positions - positions[..., reference : reference + 1, :])[..., None]).squeeze(-1)
    eye = torch.eye(cameras * PARAMETERS, dtype=rotation.dtype, device=rotation.device)
    jacobian = eye.expand(*rotation.shape[:-3], -1, -1).clone()
    blocks = jacobian.unflatten(-2, (cameras, PARAMETERS)).unflatten(-1, (cameras, PARAMETERS))
    for i in range(cameras):
        blocks[..., i, 3:6, i, 3:6] = to_reference.squeeze(-3)
        blocks[..., i, 0:3, reference, 0:3] -= relative[..., i, :, :]
        blocks[..., i, 3:6, reference, 3:6] -= to_reference.squeeze(-3)
        blocks[..., i, 3:6, reference, 0:3] -= cross_matrix(place[..., i, :])
    blocks[..., reference, :6, :, :] = 0  # exactly, not up to the rounding of R_r R_r^T
    return blocks.flatten(-2).flatten(-3, -2)


def relative_difference(rig: CameraRig, other: CameraRig, reference: int = 0) -> Tensor:
    """Error of a rig against another one, extrinsics relative to a reference camera: (*B, C, 15), gauge-free."""
    return _relative_to(rig, reference).difference(_relative_to(other, reference))


def _relative_to(rig: CameraRig, reference: int) -> CameraRig:
    transform = rig.cam_from_rig
    one = slice(reference, reference + 1)
    reference_from_rig = RigidTransform(transform.rotation[..., one, :, :], transform.translation[..., one, :])
    return replace(rig, cam_from_rig=transform @ reference_from_rig.inverse())


def _unwhitening(estimate: Estimate) -> Tensor:
    """Derivative of the parameters by the whitened offsets: (B, C, 15, 15)."""
    problem, state = estimate.problem, estimate.solution.state
    spread = problem.spread.detach()
    scale = torch.diag_embed(spread)
    left = left_jacobian(state.offset[..., :3] * spread[..., :3])
    scale[..., :3, :3] = left * spread[..., None, :3]
    return scale


def pose_covariance(estimate: Estimate) -> Tensor:
    """Covariance of each snapshot's pose: (*B, S, 6, 6), rotation (rad, left, about the centroid) and centroid (mm)."""
    equations = estimate.solution.equations
    snapshots = equations.pose.shape[1]
    reduced = arrow.reduce(equations.camera, equations.coupling.transpose(1, 2), equations.pose)
    if bool(reduced.failed.any()):
        raise RefusedError("covariance: the observations do not determine the object's pose in every snapshot")
    full = torch.cholesky_inverse(reduced.kept)
    blocks = full.unflatten(1, (snapshots, POSE_PARAMETERS)).unflatten(-1, (snapshots, POSE_PARAMETERS))
    own = blocks.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    unit = estimate.solution.state.centre.norm(dim=-1).clamp_min(1.0)
    scale = torch.ones_like(own[..., 0])
    scale[..., 3:] = unit[..., None]
    return (own * scale[..., None] * scale[..., None, :]).reshape(*estimate.chi2.shape, snapshots, 6, 6)
