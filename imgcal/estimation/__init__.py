"""Batched maximum a posteriori estimation of rigs, with covariance and gradients."""

from imgcal.estimation.covariance import (
    camera_covariance,
    camera_std,
    flat_std,
    object_covariance,
    pose_covariance,
    relative_covariance,
    relative_difference,
)
from imgcal.estimation.estimate import Estimate, EstimationOptions, estimate
from imgcal.estimation.initial_pose import initial_pose

__all__ = [
    "Estimate",
    "EstimationOptions",
    "camera_covariance",
    "camera_std",
    "estimate",
    "flat_std",
    "initial_pose",
    "object_covariance",
    "pose_covariance",
    "relative_covariance",
    "relative_difference",
]
