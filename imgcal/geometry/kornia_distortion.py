"""Kornia's distortion functions on the z = 1 plane; the formulas of the lens models are compared with them.

Kornia is imported where it is used: it is slow to import, and only training needs it.
"""

from __future__ import annotations

import torch
from torch import Tensor


def opencv_distortion(xy: Tensor, coefficients: Tensor) -> Tensor:
    """Distort points (B, N, 2) by OpenCV's coefficients (B, 5) or (B, 8).

    Source: kornia.geometry.calibration.distort_points (kornia 0.9), which takes pixels.
    """
    from kornia.geometry.calibration import distort_points

    eye = torch.eye(3, dtype=xy.dtype, device=xy.device).expand(len(xy), 3, 3)
    return distort_points(xy, eye, coefficients, new_K=eye)


def kannala_brandt_distortion(xy: Tensor, coefficients: Tensor) -> Tensor:
    """Distort points (B, N, 2) by the coefficients (B, 4) of OpenCV's fisheye.

    Source: kornia.geometry.camera.distort_points_kannala_brandt (kornia 0.9), which returns pixels.
    """
    from kornia.geometry.camera import distort_points_kannala_brandt

    affine = coefficients.new_tensor([1.0, 1.0, 0.0, 0.0]).expand(len(coefficients), 4)
    parameters = torch.cat((affine, coefficients), dim=-1).unsqueeze(1)
    return distort_points_kannala_brandt(xy, parameters.expand(*xy.shape[:2], 8))
