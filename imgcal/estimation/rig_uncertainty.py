"""Errors that a rig's covariance predicts at a point: of its pixel (px) and of its triangulation (mm), without gauge.

A motion of the whole rig changes no image and does not count. The errors are those that remain after the rigid motion
that minimizes them over a set of points, the working volume. To first order this is a projection of the parameters'
covariance, P S P^T with P = I - G (G^T H G)^-1 G^T H; docs/method.md has the equations.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.geometry import cross_matrix, distort_by_coefficients, distort_with_jacobian
from imgcal.types import CameraRig

ROUNDS = 3
"""Alignments in all; after the first, points are weighted by the errors that the previous one leaves."""
POINTS_AT_ONCE = 512
"""Points whose errors are computed together, so that their Jacobians stay in the processor's cache."""


@dataclass(frozen=True)
class RigUncertainty:
    """A rig and its uncertainty after the best rigid alignment with the true rig.

    Both alignments use the same points, one in pixels (what cameras show), one in mm (triangulation). The weight of an
    error above the median is the ratio of the median's variance to its own, so that one bad camera or a far corner
    does not distort the rest.
    """

    rig: CameraRig  # C cameras, no batch axes
    covariance: Tensor  # (K C, K C) before any alignment
    points: Tensor  # (P, 3) mm, points of the alignment
    px_weight: Tensor  # (C, P) of each pixel in the alignment, 0 where the camera does not see the point
    mm_weight: Tensor  # (P,) of each triangulated point, 0 where fewer than two cameras see it
    px_covariance: Tensor  # (K C, K C) after the alignment in pixels; nan where too little is seen for one
    mm_covariance: Tensor  # (K C, K C) after the alignment in mm; nan where cameras share too little for one

    def drop_cameras(self, cameras: Collection[int]) -> RigUncertainty:
        """Remove cameras and align the others again."""
        kept = [i for i in range(self.rig.num_cameras) if i not in cameras]
        width = self.rig.num_parameters
        rows = torch.tensor([width * i + j for i in kept for j in range(width)], device=self.points.device)
        return uncertainty_over(self.rig.select(kept), self.covariance[rows[:, None], rows], self.points)

    def pixel_error(self, points: Tensor) -> Tensor:
        """Predicted error of each camera's pixel of points: (C, P) px, expected (RMS) length of the difference.

        Args:
            points: (P, 3) mm in the rig frame, or (C, P, 3), separate points for each camera. Errors are also computed
                for points that a camera does not see; those are meaningless.
        """
        return _pixel_error(pixel_jacobian(self.rig, points), self.px_covariance)

    def point_error(self, points: Tensor, seen: Tensor, noise: float = 0.0) -> Tensor:
        """Predicted error of triangulated points: (P,) mm, expected (RMS) distance.

        Args:
            points: (P, 3) mm in the rig frame.
            seen: (C, P) bool, the cameras that take part, with equal weight.
            noise: px, standard deviation of each axis of one measured pixel; 0 = error of the calibration alone.

        Returns:
            The error; nan where fewer than two cameras take part.
        """
        triangulation, by_noise = _triangulation(pixel_jacobian(self.rig, points), seen)
        variance = _point_variance(triangulation, self.mm_covariance)
        return _length(variance + noise**2 * by_noise if noise else variance, seen)

    def errors(self, points: Tensor, seen: Tensor, noise: float) -> tuple[Tensor, Tensor, Tensor]:
        """Compute `pixel_error` and `point_error`, the latter without and with noise, for the same points in one pass.

        Args:
            points: (P, 3) mm in the rig frame.
            seen: (C, P) bool, the cameras that take part in triangulation.
            noise: px, standard deviation of each axis of one measured pixel.

        Returns:
            (C, P) px, (P,) mm, (P,) mm with noise.
        """
        parts = []
        for some, those in zip(points.split(POINTS_AT_ONCE), seen.split(POINTS_AT_ONCE, 1), strict=True):
            pixels = pixel_jacobian(self.rig, some)
            triangulation, by_noise = _triangulation(pixels, those)
            variance = _point_variance(triangulation, self.mm_covariance)
            noisy = _length(variance + noise**2 * by_noise, those)
            parts.append((_pixel_error(pixels, self.px_covariance), _length(variance, those), noisy))
        px, mm, mm_with_noise = (torch.cat(part, -1) for part in zip(*parts, strict=True))
        return px, mm, mm_with_noise


def _pixel_error(pixels: Tensor, covariance: Tensor) -> Tensor:
    """Expected length (C, P) px of the errors of pixels with Jacobian (C, P, 2, K)."""
    rows, cameras = pixels.flatten(1, 2), len(pixels)
    blocks = covariance.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
    own = blocks.diagonal(dim1=0, dim2=2).permute(2, 0, 1)  # (C, K, K)
    variance = (rows @ own).mul_(rows).sum(-1).unflatten(1, (-1, 2)).sum(-1)
    return variance.clamp_min(0).sqrt()


def _point_variance(triangulation: Tensor, covariance: Tensor) -> Tensor:
    """Expected squared error (P,) mm^2 of points with Jacobian (P, 3, K C)."""
    rows = triangulation.flatten(0, 1)
    return (rows @ covariance).mul_(rows).sum(-1).unflatten(0, (-1, 3)).sum(-1)


def _length(variance: Tensor, seen: Tensor) -> Tensor:
    """Expected length (P,) of an error; nan where fewer than two cameras take part."""
    return torch.where(seen.sum(0) >= 2, variance.clamp_min(0).sqrt(), torch.nan)


def uncertainty_over(rig: CameraRig, covariance: Tensor, points: Tensor) -> RigUncertainty:
    """Remove the gauge from the covariance of a rig's parameters.

    Args:
        rig: C cameras, no batch axes.
        covariance: (K C, K C) of all cameras' parameters, as `estimation.camera_covariance`.
        points: (P, 3) mm on which the estimated and the true rig are aligned.
    """
    seen = rig.project(points).visible
    motion = rigid_motion(rig, points.mean(0))
    pixels = pixel_jacobian(rig, points)
    triangulation, _ = _triangulation(pixels, seen)
    shared = seen.sum(0) >= 2
    px_weight, mm_weight = seen.to(points), shared.to(points)
    px_rows, mm_rows = pixels.flatten(1, 2), triangulation.flatten(0, 1)
    by_motion = motion.unflatten(0, (rig.num_cameras, -1))
    px_moved, mm_moved = px_rows @ by_motion, mm_rows @ motion
    mm_spread = mm_rows @ covariance
    mm_variance = (mm_spread * mm_rows).sum(-1)

    def align() -> tuple[Tensor, Tensor]:
        """Covariance after the alignment in pixels, and the map from errors to the motion of the one in mm."""
        weighted = px_weight.repeat_interleave(2, dim=1)[..., None] * px_moved
        px_best = _best_if_possible(motion, (px_rows.mT @ weighted).flatten(0, 1))
        mm_best = _best_if_possible(motion, mm_rows.mT @ (mm_weight.repeat_interleave(3)[:, None] * mm_moved))
        return _remove_motion(covariance, motion, px_best), mm_best

    px_covariance, mm_best = align()
    for _ in range(ROUNDS - 1):
        # The weights only need the error that remains after the previous alignment.
        px_weight = _weight(_pixel_error(pixels, px_covariance), seen)
        variance = _aligned_variance(mm_variance, mm_spread, mm_moved, mm_best, covariance)
        mm_weight = _weight(_length(variance.unflatten(0, (-1, 3)).sum(-1), seen), shared)
        px_covariance, mm_best = align()
    mm_covariance = _remove_motion(covariance, motion, mm_best)
    return RigUncertainty(rig, covariance, points, px_weight, mm_weight, px_covariance, mm_covariance)


def _aligned_variance(variance: Tensor, spread: Tensor, moved: Tensor, best: Tensor, covariance: Tensor) -> Tensor:
    """Variance (R,) of linear functions (R, K C) of the parameters after removing the motion that `best` extracts.

    Args:
        variance: (R,) before.
        spread: (R, K C) derivatives with respect to the parameters, times the covariance.
        moved: (R, 6) derivatives times the motion.
        best: (6, K C), see `_best_motion`.
        covariance: (K C, K C).
    """
    across, own = spread @ best.mT, best @ covariance @ best.mT
    return variance + ((moved @ own - 2 * across) * moved).sum(-1)


def _weight(error: Tensor, valid: Tensor) -> Tensor:
    """Median variance over own variance, at most one; zero where not valid."""
    valid = valid & error.isfinite()
    if not bool(valid.any()):
        return torch.zeros_like(error)
    median = error[valid].median()
    weight = torch.where(error > median, median / error, 1.0).square()
    return torch.where(valid, weight, 0.0)


def _remove_motion(covariance: Tensor, motion: Tensor, best: Tensor) -> Tensor:
    """Covariance (K, K) of the parameters after removing the motion that `best` (6, K) extracts."""
    left = covariance - motion @ (best @ covariance)
    return left - (left @ best.mT) @ motion.mT


def _best_motion(motion: Tensor, weighted: Tensor) -> Tensor:
    """Linear map from parameters to their best-fitting motion: (6, K), (G^T H G)^-1 G^T H.

    Args:
        motion: (K, 6), G.
        weighted: (K, 6), H G.

    Raises:
        RefusedError: the metric does not determine the motion.
    """
    normal = motion.mT @ weighted
    scale = normal.diagonal().clamp_min(torch.finfo(normal.dtype).tiny).rsqrt()
    factor, failed = torch.linalg.cholesky_ex(scale[:, None] * normal * scale)
    if bool(failed):
        raise RefusedError("predicted error: the cameras see too little of the working volume")
    return scale[:, None] * torch.cholesky_solve(scale[:, None] * weighted.mT, factor)


def _best_if_possible(motion: Tensor, weighted: Tensor) -> Tensor:
    try:
        return _best_motion(motion, weighted)
    except RefusedError:
        return torch.full_like(motion.mT, torch.nan)


def rigid_motion(rig: CameraRig, centre: Tensor) -> Tensor:
    """Derivative of all parameters by a motion of the whole rig: (K C, 6), rotation about `centre` (rad), shift (mm).

    A camera's position changes by w x (position - centre) + t, its left rotation by -R w. A point that moves with the
    rig keeps its pixels.
    """
    turn = rig.cam_from_rig.rotation
    motion = turn.new_zeros(rig.num_cameras, rig.num_parameters, 6)
    motion[:, 0:3, 0:3] = -turn
    motion[:, 3:6, 0:3] = -cross_matrix(rig.positions - centre)
    motion[:, 3:6, 3:6] = torch.eye(3, dtype=turn.dtype, device=turn.device)
    return motion.flatten(0, 1)


def pixel_jacobian(rig: CameraRig, points: Tensor) -> Tensor:
    """Derivative of the pixels of points with respect to the parameters of their camera: (C, P, 2, K).

    Args:
        rig: C cameras, no batch axes.
        points: (P, 3) or (C, P, 3) mm in the rig frame.
    """
    rotation = rig.cam_from_rig.rotation
    in_camera = points @ rotation.mT + rig.cam_from_rig.translation[:, None]  # (C, P, 3)
    depth = in_camera[..., 2:]
    xy = in_camera[..., :2] / depth
    x, y = xy.unbind(-1)
    xd, yd, jxx, jxy, jyy, _ = distort_with_jacobian(x, y, rig.distortion, rig.lens_model)
    focal = rig.focal_length[:, None]
    per_depth = focal / depth  # (C, P, 2)
    by_x, by_y = per_depth * torch.stack((jxx, jxy), -1), per_depth * torch.stack((jxy, jyy), -1)
    by_point = torch.stack((by_x, by_y, -(by_x * x[..., None] + by_y * y[..., None])), -1)  # (C, P, 2, 3)
    jacobian = by_point.new_zeros(*by_point.shape[:-1], rig.num_parameters)
    jacobian[..., 0:3] = torch.linalg.cross(in_camera[..., None, :], by_point)
    jacobian[..., 3:6] = (by_point.flatten(1, 2) @ -rotation).view(by_point.shape)
    jacobian[..., 0, 6], jacobian[..., 1, 7] = xd, yd
    jacobian[..., 0, 8] = jacobian[..., 1, 9] = 1
    by_coefficients = torch.stack(distort_by_coefficients(x, y, rig.distortion, rig.lens_model), dim=-2)
    torch.mul(by_coefficients, focal[..., None], out=jacobian[..., 10:])
    return jacobian


def _triangulation(pixels: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Derivative of triangulated points by the rig's parameters, and their variance from pixel noise.

    With exact pixels, the best-fitting point moves by -(sum K^T K)^-1 sum K^T J dp, where J is the derivative of the
    pixels by the parameters, and K by the point.

    Args:
        pixels: (C, P, 2, K) the J of every camera.
        seen: (C, P) bool, the cameras that take part.

    Returns:
        (P, 3, K C) mm per parameter, with opposite sign; (P,) variance of the point, mm^2, for unit pixel variance.
    """
    by_point = pixels[..., 3:6] * -seen.to(pixels)[..., None, None]  # (C, P, 2, 3)
    stacked = by_point.transpose(0, 1).flatten(1, 2)  # (P, 2 C, 3)
    inverse = inverse_or_zero(stacked.mT @ stacked)
    first, second = (inverse @ by_point.mT).unsqueeze(-2).unbind(-1)  # (C, P, 3, 1): mm by pixel
    along, across = pixels.unsqueeze(-3).unbind(-2)  # (C, P, 1, K)
    response = pixels.new_empty(len(stacked), 3, len(pixels), pixels.shape[-1])  # laid out for later products
    torch.mul(first, along, out=response.permute(2, 0, 1, 3)).addcmul_(second, across)
    variance = inverse.diagonal(dim1=-2, dim2=-1).sum(-1)
    return response.flatten(-2), variance


def inverse_or_zero(information: Tensor) -> Tensor:
    """Inverse of (P, 3, 3); zero where singular."""
    factor, failed = torch.linalg.cholesky_ex(information)
    eye = torch.eye(3, dtype=information.dtype, device=information.device)
    good = (failed == 0)[:, None, None]
    return torch.where(good, torch.cholesky_inverse(torch.where(good, factor, eye)), 0.0)


def detach_double(rig: CameraRig) -> CameraRig:
    """Copy a rig in double precision, detached from the graph."""
    return replace(rig.map_tensors(lambda tensor, _: tensor.detach()), image_size=rig.image_size).to(torch.float64)
