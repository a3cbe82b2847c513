"""Errors of a rig in which a motion of the whole rig is the same direction for every state of the rig.

A camera's error is a motion of the camera in the rig's frame, rig_from_camera = exp(w, v) rig_from_camera0, and
differences of its other values. A motion of the whole rig, which no image can show, is then the same (w, v) for all
cameras at every linearization point. Information summed over time, with each part linearized at the estimate of its
time, therefore never includes this direction. In the parameters of `CameraRig.retract` it would: the direction changes
as the estimate moves, and a filter becomes confident about what cannot be observed.

Source: Barrau and Bonnabel, "The Invariant Extended Kalman Filter as a Stable Observer", 2017; Zhang et al.,
"Convergence and Consistency Analysis for a 3-D Invariant-EKF SLAM", 2017.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from imgcal.geometry import (
    RigidTransform,
    cross_matrix,
    left_jacobian,
    rotate,
    rotation_from_vector,
    vector_from_rotation,
)
from imgcal.types import CameraRig


def displace(rig: CameraRig, error: Tensor) -> CameraRig:
    """Apply an error.

    Args:
        rig: (*B).
        error: (*B, C, K): rotation (rad) and translation (mm) of the camera in the rig's frame, then focal length,
            principal point (pixels) and distortion.

    Returns:
        (*B).
    """
    turn = rotation_from_vector(error[..., :3])
    rotation = rig.cam_from_rig.rotation @ turn.mT
    positions = rotate(turn, rig.positions) + error[..., 3:6]
    return replace(
        rig,
        focal_length=rig.focal_length + error[..., 6:8],
        principal_point=rig.principal_point + error[..., 8:10],
        distortion=rig.distortion + error[..., 10:],
        cam_from_rig=RigidTransform(rotation, -rotate(rotation, positions)),
    )


def error_between(rig: CameraRig, reference: CameraRig) -> Tensor:
    """Invert `displace`: the error (*B, C, K) that takes `reference` to `rig`."""
    turn = rig.cam_from_rig.rotation.mT @ reference.cam_from_rig.rotation
    parts = (
        vector_from_rotation(turn),
        rig.positions - rotate(turn, reference.positions),
        rig.focal_length - reference.focal_length,
        rig.principal_point - reference.principal_point,
        rig.distortion - reference.distortion,
    )
    return torch.cat(parts, dim=-1)


def step_by_error(rig: CameraRig, turned: Tensor | None = None) -> Tensor:
    """Derivative of `CameraRig.retract`'s step by the error, for each camera.

    Args:
        rig: (*B), where the error is zero.
        turned: (*B, C, 3) rad, rotation vector of the step that took another rig to this one; None = the step starts
            from this rig.

    Returns:
        (*B, C, K, K).
    """
    rotation, positions = rig.cam_from_rig.rotation, rig.positions
    jacobian = torch.zeros(
        *positions.shape[:-1], rig.num_parameters, rig.num_parameters, dtype=positions.dtype, device=positions.device
    )
    jacobian.diagonal(dim1=-2, dim2=-1)[..., 3:] = 1
    jacobian[..., :3, :3] = -rotation if turned is None else -torch.linalg.solve(left_jacobian(turned), rotation)
    jacobian[..., 3:6, :3] = -cross_matrix(positions)
    return jacobian


def error_by_step(rig: CameraRig) -> Tensor:
    """Derivative of the error by `CameraRig.retract`'s step from this rig: (*B, C, K, K), inverts `step_by_error`."""
    back, positions = rig.cam_from_rig.rotation.mT, rig.positions
    jacobian = torch.eye(rig.num_parameters, dtype=back.dtype, device=back.device).repeat(*positions.shape[:-1], 1, 1)
    jacobian[..., :3, :3] = -back
    jacobian[..., 3:6, :3] = -cross_matrix(positions) @ back
    return jacobian
