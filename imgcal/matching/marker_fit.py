"""Place, brightness and background of markers whose common shape is known: robust least squares, compiled.

Markers that overlap are fitted in turns, each with the others taken away.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import kernels
from renderers.compiling import njit

RINGS = 0.5  # px of the shorter axis, from one value of a profile to the next
MISFIT = (0.2, 0.1, 0.05, 0.03)
"""Of the amplitude: by how much the common shape may be wrong, in each iteration."""
ROBUST = 3.0  # standard deviations from which a pixel counts less and less
LEAST_NOISE = 0.3  # grey levels: that of rounding
FARTHEST = 2.0  # px of one step
CORE = 0.3  # of the peak: the part of a marker that must look like the shape
BINS = 256  # of the histogram that gives the median of residuals


@njit(inline="always")
def _shape(du, dv, size, whitening, profile):
    """Brightness at a place relative to the middle of a marker, and its slope by u and v; see `photometry.Shape`."""
    a, b, c = whitening[0, 0], whitening[0, 1], whitening[1, 1]
    x, y = (a * du + b * dv) / size, (b * du + c * dv) / size
    radius = np.sqrt(x * x + y * y)
    low = int(radius / RINGS)
    if low >= len(profile) - 1:
        return 0.0, 0.0, 0.0
    step = profile[low + 1] - profile[low]
    value = profile[low] + step * (radius / RINGS - low)
    slope = step / (RINGS * size * max(radius, 1e-9))
    return value, slope * (a * x + b * y), slope * (b * x + c * y)


@njit(cache=True)
def _median(values, weight, count):
    """Median of the absolute values that have a weight, to a part of the largest."""
    most, number = 0.0, 0
    for i in range(count):
        if weight[i] > 0:
            number += 1
            most = max(most, abs(values[i]))
    if not most > 0:
        return 0.0
    histogram = np.zeros(BINS, np.int64)
    for i in range(count):
        if weight[i] > 0:
            histogram[min(BINS - 1, int(abs(values[i]) / most * BINS))] += 1
    below = 0
    for place in range(BINS):
        if 2 * (below + histogram[place]) >= number:
            return most * (place + (0.5 * number - below) / max(histogram[place], 1)) / BINS
        below += histogram[place]
    return most


@njit(cache=True)
def _linear(values, shapes, weight, count):
    """Background and amplitude of a shape."""
    ss, s1, s11, sv, s1v = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        w, t = weight[i], shapes[i, 0]
        ss += w
        s1 += w * t
        s11 += w * t * t
        sv += w * values[i]
        s1v += w * t * values[i]
    determinant = ss * s11 - s1 * s1
    if not determinant > 1e-9 * ss * s11:
        return 0.0, 0.0
    return (s11 * sv - s1 * s1v) / determinant, (ss * s1v - s1 * sv) / determinant


@njit(cache=True, nogil=True)
def fit_markers(windows, real, corner, scale, close, shape, uv, found):
    """Fit markers (N) in their windows, place by place.

    Args:
        windows: (N, P, P) grey values, brighter where markers are.
        real: (N, P, P) pixels that are in the frame.
        corner: (N, 2) first column and row of each window.
        scale: (N,) size of each marker in parts of the shape.
        close: (N, N) which other markers may reach into a window.
        shape: whitening (2, 2) and profile (R,).
        uv: (N, 2) where to begin; filled with the places.
        found: (N, 5) filled with amplitude, its variance, the variance of the place along an axis, the mean squared
            residual within the marker, and the squared noise.
    """
    whitening, profile = shape
    side = windows.shape[1]
    count = side * side
    values, weight, residual = np.empty(count), np.empty(count), np.empty(count)
    shapes = np.empty((count, 3))
    members = np.empty(len(windows), np.int64)
    normal, right, row = np.empty((4, 4)), np.empty(4), np.empty(4)
    for iteration in range(len(MISFIT)):
        for n in range(len(windows)):
            inside, neighbours = 0, 0
            for m in range(len(windows)):
                if close[n, m] and found[m, 0] > 0:
                    members[neighbours] = m
                    neighbours += 1
            for i in range(side):
                for j in range(side):
                    k = i * side + j
                    u, v = float(corner[n, 0] + j), float(corner[n, 1] + i)
                    value = windows[n, i, j]
                    for near in range(neighbours):
                        m = members[near]
                        other, _, _ = _shape(u - uv[m, 0], v - uv[m, 1], scale[m], whitening, profile)
                        value -= found[m, 0] * other
                    values[k] = value
                    weight[k] = 1.0 if real[n, i, j] else 0.0
                    inside += 1 if real[n, i, j] else 0
                    shapes[k, 0], shapes[k, 1], shapes[k, 2] = _shape(
                        u - uv[n, 0], v - uv[n, 1], scale[n], whitening, profile
                    )
            if inside < 8:
                found[n, 0] = 0.0
                continue
            ground, amplitude = _linear(values, shapes, weight, count)
            for k in range(count):
                residual[k] = values[k] - ground - amplitude * shapes[k, 0]
            spread = max(1.4826 * _median(residual, weight, count), LEAST_NOISE)
            noise = max(spread, MISFIT[iteration] * amplitude)
            for k in range(count):
                weight[k] /= 1 + (residual[k] / (ROBUST * noise)) ** 2
            ground, amplitude = _linear(values, shapes, weight, count)
            amplitude = max(amplitude, 0.0)
            total, squares, core, middle = 0.0, 0.0, 0, 0.0
            for a in range(4):
                right[a] = 0.0
                for b in range(4):
                    normal[a, b] = 0.0
            for k in range(count):
                w, r = weight[k], values[k] - ground - amplitude * shapes[k, 0]
                row[0], row[1] = 1.0, shapes[k, 0]
                row[2], row[3] = -amplitude * shapes[k, 1], -amplitude * shapes[k, 2]
                for a in range(4):
                    right[a] += w * row[a] * r
                    for b in range(a + 1):
                        normal[a, b] += w * row[a] * row[b]
                total += w
                squares += w * r * r
                if shapes[k, 0] > CORE and weight[k] > 0:
                    core += 1
                    middle += r * r
            for a in range(4):
                normal[a, a] += 1e-6 * normal[a, a] + 1e-9
            variance = max(squares / max(total - 4, 1.0), LEAST_NOISE * LEAST_NOISE)
            found[n, 0], found[n, 3], found[n, 4] = amplitude, middle / max(core, 1), spread * spread
            found[n, 1], found[n, 2] = np.inf, np.inf
            if not kernels.cholesky(normal):
                continue
            kernels.cholesky_solve(normal, right)
            uv[n, 0] += min(max(right[2], -FARTHEST), FARTHEST)
            uv[n, 1] += min(max(right[3], -FARTHEST), FARTHEST)
            for a in range(4):
                row[a] = 1.0 if a == 1 else 0.0
            kernels.cholesky_solve(normal, row)
            found[n, 1], found[n, 2] = variance * row[1], 0.0
            for b in range(2, 4):
                for a in range(4):
                    row[a] = 1.0 if a == b else 0.0
                kernels.cholesky_solve(normal, row)
                found[n, 2] += 0.5 * variance * row[b]
