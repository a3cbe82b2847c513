"""Errors that a rig's covariance predicts at a point: of its pixel (px) and of its triangulation (mm), without gauge.

A motion of the whole rig changes no image and does not count. The errors are those that remain after the rigid motion
that minimizes them over a set of points, the working volume. To first order this is a projection of the parameters'
covariance, P S P^T with P = I - G (G^T H G)^-1 G^T H; docs/method.md has the equations.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.geometry import cross_matrix, distort_by_coefficients, distort_with_jacobian
from imgcal.types import CameraRig

ROUNDS = 3
"""Alignments in all; after the first, points are weighted by the errors that the previous one leaves."""
PARTS = 4
"""Parts in which a product with a symmetric matrix is computed; each saves half of its own size."""
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
        return _pixel_error(_pixel_rows(self.rig, points), self.px_covariance)

    def point_error(self, points: Tensor, seen: Tensor | None = None, noise: float = 0.0) -> Tensor:
        """Predicted error of triangulated points: (P,) mm, expected (RMS) distance.

        Args:
            points: (P, 3) mm in the rig frame.
            seen: (C, P) bool, the cameras that take part, with equal weight; None = those with the point in view.
            noise: px, standard deviation of each axis of one measured pixel; 0 = error of the calibration alone.

        Returns:
            The error; nan where fewer than two cameras take part.
        """
        seen = self.rig.project(points).visible if seen is None else seen
        triangulation, by_noise = _triangulation(_pixel_rows(self.rig, points), seen)
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
            pixels = _pixel_rows(self.rig, some)
            triangulation, by_noise = _triangulation(pixels, those)
            variance = _point_variance(triangulation, self.mm_covariance)
            noisy = _length(variance + noise**2 * by_noise, those)
            parts.append((_pixel_error(pixels, self.px_covariance), _length(variance, those), noisy))
        px, mm, mm_with_noise = (torch.cat(part, -1) for part in zip(*parts, strict=True))
        return px, mm, mm_with_noise


def _pixel_error(pixels: Tensor, covariance: Tensor) -> Tensor:
    """Expected length (C, P) px of the errors of pixels with derivatives (C, K, 2, P)."""
    rows, cameras = pixels.flatten(2), len(pixels)
    blocks = covariance.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
    own = blocks.diagonal(dim1=0, dim2=2).permute(2, 0, 1)  # (C, K, K)
    variance = (own @ rows).mul_(rows).sum(1).unflatten(1, (2, -1)).sum(1)
    return variance.clamp_min(0).sqrt()


def _point_variance(triangulation: Tensor, covariance: Tensor) -> Tensor:
    """Expected squared error (P,) mm^2 of points with derivatives (K C, 3, P)."""
    rows = triangulation.flatten(1)
    # The covariance is symmetric: a part of its rows only needs the columns up to its own, those before it twice.
    lower, variance = covariance.tril() + covariance.tril(-1), rows.new_zeros(rows.shape[1])
    for first, last in pairwise(len(rows) * part // PARTS for part in range(PARTS + 1)):
        variance += (lower[first:last, :last] @ rows[:last]).mul_(rows[first:last]).sum(0)
    return variance.unflatten(0, (3, -1)).sum(0)


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
    pixels = _pixel_rows(rig, points)
    triangulation, _ = _triangulation(pixels, seen)
    shared = seen.sum(0) >= 2
    px_weight, mm_weight = seen.to(points), shared.to(points)
    px_rows, mm_rows = pixels.flatten(2), triangulation.flatten(1)  # (C, K, 2 P), (K C, 3 P)
    by_motion = motion.unflatten(0, (rig.num_cameras, -1))
    px_moved, mm_moved = by_motion.mT @ px_rows, motion.mT @ mm_rows  # (C, 6, 2 P), (6, 3 P)
    mm_variance = _point_variance(triangulation, covariance)

    def align() -> tuple[Tensor, Tensor]:
        """Covariance after the alignment in pixels, and the map from errors to the motion of the one in mm."""
        weighted = px_weight.repeat(1, 2)[:, None] * px_moved
        px_best = _best_if_possible(motion, (px_rows @ weighted.mT).flatten(0, 1))
        mm_best = _best_if_possible(motion, mm_rows @ (mm_weight.repeat(3) * mm_moved).mT)
        return _remove_motion(covariance, motion, px_best), mm_best

    px_covariance, mm_best = align()
    for _ in range(ROUNDS - 1):
        # The weights only need the error that remains after the previous alignment.
        px_weight = _weight(_pixel_error(pixels, px_covariance), seen)
        variance = mm_variance + _change_by_alignment(mm_rows, mm_moved, mm_best, covariance)
        mm_weight = _weight(_length(variance, seen), shared)
        px_covariance, mm_best = align()
    mm_covariance = _remove_motion(covariance, motion, mm_best)
    return RigUncertainty(rig, covariance, points, px_weight, mm_weight, px_covariance, mm_covariance)


def _change_by_alignment(rows: Tensor, moved: Tensor, best: Tensor, covariance: Tensor) -> Tensor:
    """Change (P,) of the expected squared error of points by removing the motion that `best` extracts.

    Args:
        rows: (K C, 3 P) derivatives of the points by the parameters.
        moved: (6, 3 P) derivatives by the motion.
        best: (6, K C), see `_best_motion`.
        covariance: (K C, K C).
    """
    extracted = best @ covariance
    across, own = extracted @ rows, extracted @ best.mT
    return ((own @ moved - 2 * across) * moved).sum(0).unflatten(0, (3, -1)).sum(0)


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
    return _pixel_rows(rig, points).permute(0, 3, 2, 1)


def _pixel_rows(rig: CameraRig, points: Tensor) -> Tensor:
    """Compute `pixel_jacobian` in an order in which every step runs over long rows: (C, K, 2, P)."""
    rotation, focal = rig.cam_from_rig.rotation, rig.focal_length[..., None]
    in_camera = rotation @ points.mT + rig.cam_from_rig.translation[..., None]  # (C, 3, P)
    px, py, depth = in_camera.unbind(1)
    x, y = px / depth, py / depth
    xd, yd, jxx, jxy, jyy, _ = distort_with_jacobian(x, y, rig.distortion, rig.lens_model)
    per_depth = focal / depth[:, None]  # (C, 2, P)
    by_x, by_y = per_depth * torch.stack((jxx, jxy), 1), per_depth * torch.stack((jxy, jyy), 1)
    by_z = -(by_x * x[:, None] + by_y * y[:, None])
    by_point = torch.stack((by_x, by_y, by_z), 1)  # (C, 3, 2, P)
    rows = by_point.new_zeros(len(rotation), rig.num_parameters, *by_point.shape[2:])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # the cross product, far faster by hand
        torch.mul(in_camera[:, j, None], by_point[:, k], out=rows[:, i])
        rows[:, i].addcmul_(in_camera[:, k, None], by_point[:, j], value=-1)
    rows[:, 3:6] = (-rotation.mT @ by_point.flatten(2)).view(by_point.shape)
    rows[:, 6, 0], rows[:, 7, 1] = xd, yd
    rows[:, 8, 0] = rows[:, 9, 1] = 1
    for axis, by_coefficients in enumerate(distort_by_coefficients(x, y, rig.distortion, rig.lens_model)):
        torch.mul(by_coefficients.mT, focal[:, axis, None], out=rows[:, 10:, axis])
    return rows


def _triangulation(pixels: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Derivative of triangulated points by the rig's parameters, and their variance from pixel noise.

    With exact pixels, the best-fitting point moves by -(sum K^T K)^-1 sum K^T J dp, where J is the derivative of the
    pixels by the parameters, and K by the point.

    Args:
        pixels: (C, K, 2, P) the J of every camera.
        seen: (C, P) bool, the cameras that take part.

    Returns:
        (K C, 3, P) mm per parameter, with opposite sign; (P,) variance of the point, mm^2, for unit pixel variance.
    """
    by_point = pixels[:, 3:6] * -seen.to(pixels)[:, None, None]  # (C, 3, 2, P)
    stacked = by_point.transpose(0, 1).flatten(1, 2)  # (3, 2 C, P)
    information = (stacked[:, None] * stacked).sum(2)  # (3, 3, P)
    inverse = inverse_or_zero(information.movedim(-1, 0)).movedim(0, -1)
    by_pixel = (inverse[:, :, None] * by_point[:, None]).sum(2)  # (C, 3, 2, P)
    response = pixels[:, :, 0, None] * by_pixel[:, None, :, 0]  # (C, K, 3, P)
    response.addcmul_(pixels[:, :, 1, None], by_pixel[:, None, :, 1])
    return response.flatten(0, 1), inverse.diagonal().sum(-1)


def inverse_or_zero(information: Tensor) -> Tensor:
    """Inverse of symmetric matrices (P, 3, 3); zero where they are not positive definite."""
    (a, b, c), (_, d, e), (_, _, f) = (row.unbind(-1) for row in information.unbind(-2))
    df, bf, be, af, ae, ad = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * df + b * bf + c * be
    adjugate = torch.stack((df, bf, be, bf, af, ae, be, ae, ad), -1).unflatten(-1, (3, 3))
    good = (a > 0) & (ad > 0) & (determinant > 0)
    return torch.where(good, 1 / determinant, 0.0)[..., None, None] * adjugate
