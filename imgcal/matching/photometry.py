"""Measurement of markers at expected places: all in a camera share one shape, each has its position and brightness."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.matching.camera_fit import USUAL_MISFIT, fit_camera
from imgcal.matching.marker_fit import MISFIT, NEAR

LEAST_SIGMA = 0.02  # px: best accuracy of a fit
LEAST_SIGNIFICANCE = 5.0  # amplitude over its standard deviation
HALF_HIDDEN = 0.7  # of the radius: possible shift of the centre per misfit
# Of the radius: standard deviation of a whole marker's centre, per misfit beyond that of pixels.
UNEVEN, EVEN = 0.2, 0.03
LARGEST = 40  # px, largest half size of a window


@dataclass(frozen=True)
class Measured:
    """Markers of one camera."""

    uv: NDArray[np.float64]  # (N, 2) pixels
    sigma: NDArray[np.float64]  # (N,) pixels, standard deviation per axis
    amplitude: NDArray[np.float64]  # (N,) grey levels
    significance: NDArray[np.float64]  # (N,) amplitude over its standard deviation
    radius: float  # px, of the disc with the area of the marker's image
    misfit: NDArray[np.float64]  # (N,) RMS difference from the common shape beyond noise, relative to the amplitude

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Markers that are certainly present: (N,)."""
        return (self.significance > LEAST_SIGNIFICANCE) & np.isfinite(self.uv).all(1)


def measure_markers(
    frame: Frame,
    expected: NDArray[np.float64],
    radius: NDArray[np.float64],
    dark: bool,
    sure: NDArray[np.bool_],
    iterations: tuple[int, ...] = (len(MISFIT), NEAR),
) -> Measured:
    """Fit the markers of one camera near their expected places.

    Args:
        frame: (H, W) grey values.
        expected: (N, 2) pixels.
        radius: (N,) px, approximate sizes; only their ratios must be accurate.
        dark: markers are darker than their surroundings.
        sure: (N,) the markers that define the common shape.
        iterations: iterations on the positions in each pass; a pass estimates the shape, then the positions.
    """
    height, width = frame.shape
    usual = _quantile(radius, 0.5)
    scale = radius / usual
    inside = np.asarray(((expected > -0.5) & (expected < (width - 0.5, height - 0.5))).all(1))
    if not inside.any():
        return _unmeasured(len(expected), usual)
    half = min(max(math.ceil(2.2 * usual + 4), 5), LARGEST)
    grey, corner = _part(frame, expected[inside], 2 * half * float(scale.max()), dark)
    start = np.ascontiguousarray(np.where(inside[:, None], expected - corner, 0.0))
    sure = np.asarray(sure, dtype=bool)
    uv, found, misfit = np.empty_like(start), np.zeros((len(start), 5)), np.zeros(len(start))
    size = fit_camera(grey, start, inside, sure, scale, half, np.array(iterations), uv, found, misfit)
    if size == 0:
        return _unmeasured(len(expected), usual)
    amplitude, spread, place = found.T[:3]
    # If the centre of a marker does not match the common shape, part of it may be hidden.
    least = max(USUAL_MISFIT, 2 * _quantile(misfit[inside], 0.25))
    doubt = HALF_HIDDEN * np.maximum(misfit - least, 0) * size * scale
    # Uneven brightness also shifts the centre, and the fit follows it without residuals.
    uneven = UNEVEN * np.maximum(misfit - EVEN, 0) * size * scale
    sigma = np.sqrt(place + LEAST_SIGMA**2 + doubt**2 + uneven**2)
    significance = np.where(inside & (amplitude > 0), amplitude / np.sqrt(np.maximum(spread, 1e-12)), 0.0)
    return Measured(uv + corner, sigma, amplitude, significance, size, misfit)


def _quantile(values: NDArray[np.float64], share: float) -> float:
    """Quantile of values (N,), ten times faster than `np.quantile` for a few."""
    ordered, place = np.sort(values), share * (len(values) - 1)
    low, high = ordered[math.floor(place)], ordered[math.ceil(place)]
    return float(low + (place % 1) * (high - low))


def _unmeasured(count: int, radius: float) -> Measured:
    none = np.zeros(count)
    return Measured(np.full((count, 2), np.nan), np.full(count, np.inf), none, none, radius, none)


def _part(
    frame: Frame, uv: NDArray[np.float64], reach: float, dark: bool
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Cut out the surroundings of places (N, 2), with bright markers; also return its first column and row."""
    corner = np.maximum(np.floor(uv.min(0) - reach), 0).astype(np.int64)
    right, bottom = (np.ceil(uv.max(0) + reach) + 1).astype(np.int64).tolist()
    left, top = corner.tolist()
    part = frame[top:bottom, left:right].astype(np.float32)
    return -part if dark else part, corner
