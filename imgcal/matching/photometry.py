"""Markers measured where they are expected: all of a camera share one shape, each has its place and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from imgcal.detection import Frame
from imgcal.matching.marker_fit import RINGS, fit_markers

LEAST_SIGMA = 0.02  # px: what no fit is better than
LEAST_SIGNIFICANCE = 5.0  # amplitude over its standard deviation
FAINT = 0.25  # of the peak: where the shape is measured from
USUAL_MISFIT = 0.1  # RMS of the amplitude: what whole markers differ by in their shapes, at least
HALF_HIDDEN = 0.7  # of the radius: how far the centre may be off per misfit
LARGEST = 40  # px, half of a window


@dataclass(frozen=True)
class Measured:
    """Markers of one camera."""

    uv: NDArray[np.float64]  # (N, 2) pixels
    sigma: NDArray[np.float64]  # (N,) pixels, one standard deviation of each axis
    amplitude: NDArray[np.float64]  # (N,) grey levels
    significance: NDArray[np.float64]  # (N,) amplitude over its standard deviation
    radius: float  # px, of the disc as large as the marker's image
    misfit: NDArray[np.float64]  # (N,) RMS difference from the common shape beyond noise, in parts of the amplitude

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Those that are surely there: (N,)."""
        return (self.significance > LEAST_SIGNIFICANCE) & np.isfinite(self.uv).all(1)


@dataclass(frozen=True)
class Shape:
    """What a marker of a camera looks like: a profile over ellipses."""

    whitening: NDArray[np.float64]  # (2, 2): ellipses become circles of the same pixels as the shorter axis
    profile: NDArray[np.float64]  # (R,) brightness at radii 0, RINGS, 2 RINGS, ...
    reach: int  # px, half of the window that holds it
    dark: bool  # markers are darker than their surroundings


def measure_markers(
    frame: Frame,
    expected: NDArray[np.float64],
    radius: NDArray[np.float64],
    dark: bool,
    sure: NDArray[np.bool_],
    passes: int = 3,
) -> Measured:
    """Fit the markers of one camera near their expected places.

    Args:
        frame: (H, W) grey values.
        expected: (N, 2) pixels.
        radius: (N,) px, how large they are: roughly, but for their ratios.
        dark: markers are darker than their surroundings.
        sure: (N,) those from which the common shape is taken.
        passes: how often shape and places are found, each from the other.
    """
    height, width = frame.shape
    usual = float(np.median(radius))
    scale = radius / usual
    half = int(np.clip(np.ceil(2.2 * usual + 4), 5, LARGEST))
    inside = np.asarray(((expected > -0.5) & (expected < (width - 0.5, height - 0.5))).all(1))
    uv = np.where(inside[:, None], expected, 0.0)
    shape = None
    for _ in range(passes):
        chosen = sure & inside if (sure & inside).any() else inside
        if not chosen.any():
            return _nothing(len(expected), usual)
        shape = _shape(_patches(frame, uv[chosen], scale[chosen], half, dark), dark)
        if shape is None:
            return _nothing(len(expected), usual)
        fit = _fitted(frame, uv, inside, shape, scale)
        # Those that look like most others say better what a whole marker looks like.
        sure = sure & (fit.misfit <= max(USUAL_MISFIT, float(np.median(fit.misfit[chosen]))))
        uv = np.where((np.linalg.norm(fit.uv - expected, axis=1) < half)[:, None], fit.uv, uv)
    return fit


def _nothing(count: int, radius: float) -> Measured:
    none = np.zeros(count)
    return Measured(np.full((count, 2), np.nan), np.full(count, np.inf), none, none, radius, none)


def _patches(
    frame: Frame, uv: NDArray[np.float64], scale: NDArray[np.float64], half: int, dark: bool
) -> NDArray[np.float64]:
    """Cut windows about places (N, 2), resampled so that these are in the middle: (N, 2 half + 1, 2 half + 1)."""
    steps = np.arange(-half, half + 1, dtype=np.float32)
    rows = steps[None, :, None] * scale[:, None, None] + uv[:, 1, None, None]
    columns = steps[None, None, :] * scale[:, None, None] + uv[:, 0, None, None]
    top, left = int(max(rows.min() - 1, 0)), int(max(columns.min() - 1, 0))
    part = frame[top : int(rows.max() + 3), left : int(columns.max() + 3)].astype(np.float32)
    shape, side = (len(uv), 2 * half + 1, 2 * half + 1), 2 * half + 1
    maps = [np.broadcast_to(x, shape).reshape(-1, side).astype(np.float32) for x in (columns - left, rows - top)]
    values = cv2.remap(part, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = np.asarray(values, dtype=np.float64).reshape(shape)
    return -values if dark else values


def _shape(patches: NDArray[np.float64], dark: bool) -> Shape | None:
    """Take the common shape from windows (K, P, P) with a marker in the middle of each; None = there is none."""
    half = patches.shape[1] // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    rim = np.maximum(abs(u), abs(v)) >= half - 1
    level = np.median(patches[:, rim], axis=1)
    stack = patches - level[:, None, None]
    core = np.hypot(u, v) <= max(1.5, 0.25 * half)
    peak = np.median(stack[:, core], axis=1)
    bright = peak > 0
    if not bright.any():
        return None
    mean = np.median(stack[bright] / peak[bright, None, None], axis=0)
    mean = (mean + mean[::-1, ::-1]) / 2  # of a symmetric shape: the middle stays the middle
    smooth = gaussian_filter(mean, 1.0)
    top = smooth[core].max()
    if not top > 0:
        return None
    # Moments of what is connected to the middle, in a window that follows them.
    covariance = np.eye(2) * (0.3 * half) ** 2
    for _ in range(6):
        inverse = np.linalg.inv(covariance)
        distance = inverse[0, 0] * u * u + 2 * inverse[0, 1] * u * v + inverse[1, 1] * v * v
        weight = np.maximum(smooth - FAINT * top, 0) * (distance < 9)
        total = weight.sum()
        if not total > 0:
            return None
        moments = np.array([[(weight * u * u).sum(), (weight * u * v).sum()], [0, (weight * v * v).sum()]]) / total
        moments[1, 0] = moments[0, 1]
        covariance = moments + 0.1 * np.eye(2)
    values, axes = np.linalg.eigh(covariance)
    short = np.sqrt(values[0])
    whitening = axes @ np.diag(short / np.sqrt(values)) @ axes.T
    white = np.stack((u, v), -1) @ whitening.T
    ring = np.rint(np.hypot(white[..., 0], white[..., 1]) / RINGS).astype(np.int64)
    most = int(np.ceil(min(4.5 * short + 2, half) / RINGS))
    kept = ring <= most
    profile = np.bincount(ring[kept], mean[kept], most + 1) / np.maximum(np.bincount(ring[kept], minlength=most + 1), 1)
    profile = np.maximum.accumulate(gaussian_filter(profile, 1.0, mode="nearest")[::-1])[::-1]
    profile = np.append(profile - profile[-1], 0.0)
    if not profile[0] > 0:
        return None
    reach = int(np.clip(np.ceil((most + 1) * RINGS * np.sqrt(values[1]) / short), 4, half))
    return Shape(whitening, profile / profile[0], reach, dark)


def _fitted(
    frame: Frame, start: NDArray[np.float64], inside: NDArray[np.bool_], shape: Shape, scale: NDArray[np.float64]
) -> Measured:
    """Fit place, amplitude and background of each marker (N, 2)."""
    half = int(np.ceil(shape.reach * scale.max()))
    corner = np.rint(start).astype(np.int64) - half
    v, u = np.mgrid[: 2 * half + 1, : 2 * half + 1]
    rows, columns = v[None] + corner[:, 1, None, None], u[None] + corner[:, 0, None, None]
    height, width = frame.shape
    real = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width) & inside[:, None, None]
    values = frame[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    close = np.abs(start[:, None] - start[None]).max(-1) < 2 * half
    close &= inside[:, None] & inside[None] & ~np.eye(len(start), dtype=bool)
    uv, found = start.copy(), np.zeros((len(start), 5))
    given = (np.ascontiguousarray(shape.whitening), np.ascontiguousarray(shape.profile))
    fit_markers(-values if shape.dark else values, real, corner, scale, close, given, uv, found)
    amplitude, spread, place, middle, noise = found.T
    # Where the middle of a marker does not look like the common shape, part of it may be hidden.
    misfit = np.sqrt(np.maximum(middle - 1.5 * noise, 0)) / np.maximum(amplitude, 1e-9)
    usual = max(USUAL_MISFIT, 2 * float(np.quantile(misfit[inside], 0.25))) if inside.any() else USUAL_MISFIT
    doubt = HALF_HIDDEN * np.maximum(misfit - usual, 0) * reach_of(shape) * scale
    sigma = np.sqrt(place + LEAST_SIGMA**2 + doubt**2)
    significance = np.where(inside & (amplitude > 0), amplitude / np.sqrt(np.maximum(spread, 1e-12)), 0.0)
    return Measured(uv, sigma, amplitude, significance, reach_of(shape), misfit)


def reach_of(shape: Shape) -> float:
    """Radius (px) of the disc as large as a shape."""
    rings = np.arange(len(shape.profile))
    return float(np.sqrt(2 * np.sum(shape.profile * rings) * RINGS**2 / np.linalg.det(shape.whitening)))
