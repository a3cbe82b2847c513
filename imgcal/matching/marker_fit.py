"""Place, brightness and background of markers whose common shape is known: robust least squares, compiled.

Markers that overlap are fitted in turns, each with the others taken away.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import kernels
from imgcal.matching.marker_shape import RINGS
from renderers.compiling import njit

MISFIT = (0.2, 0.1, 0.05, 0.03)
"""Of the amplitude: by how much the common shape may be wrong, in each iteration."""
NEAR = 2  # of these iterations are enough where the places are known
ROBUST = 3.0  # standard deviations from which a pixel counts less and less
LEAST_NOISE = 0.3  # grey levels: that of rounding
FARTHEST = 2.0  # px of one step
CORE = 0.3  # of the peak: the part of a marker that must look like the shape
BINS = 256  # of the histogram that gives the median of residuals
OCTANTS = 8  # around a marker, whose residuals are taken together
FEW = OCTANTS / (OCTANTS - 4)
"""By how much they scatter less than independent ones would: the fit of four values has made their sums zero."""


@njit(inline="always", fastmath=True)
def _shape(du, dv, size, whitening, profile):
    """Brightness at a place relative to the middle of a marker, and its slope by u and v; see `photometry.Shape`."""
    a, b, c = whitening[0, 0], whitening[0, 1], whitening[1, 1]
    x, y = (a * du + b * dv) / size, (b * du + c * dv) / size
    radius = np.sqrt(x * x + y * y)
    place = radius * (1 / RINGS)
    low = min(int(place), len(profile) - 2)
    step = profile[low + 1] - profile[low]
    value = profile[low] + step * min(place - low, 1.0)
    slope = step / (RINGS * size * max(radius, 1e-9)) if place - low <= 1.0 else 0.0
    return value, slope * (a * x + b * y), slope * (b * x + c * y)


@njit(cache=True, nogil=True, fastmath=True)
def _median(values, count, histogram):
    """Median of the first `count` absolute values, to a part of the largest."""
    most = 0.0
    for i in range(count):
        most = max(most, abs(values[i]))
    if not most > 0:
        return 0.0
    histogram[:] = 0
    factor = (BINS - 1) / most
    for i in range(count):
        histogram[int(abs(values[i]) * factor)] += 1
    below = 0
    for place in range(BINS):
        if 2 * (below + histogram[place]) >= count:
            return (place + (0.5 * count - below) / max(histogram[place], 1)) / factor
        below += histogram[place]
    return most


@njit(cache=True, nogil=True, fastmath=True)
def _linear(values, shapes, weight, count):
    """Background and amplitude of a shape."""
    ss, s1, s11, sv, s1v = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        w, t, value = weight[i], shapes[i], values[i]
        ss += w
        s1 += w * t
        s11 += w * t * t
        sv += w * value
        s1v += w * t * value
    determinant = ss * s11 - s1 * s1
    if not determinant > 1e-9 * ss * s11:
        return 0.0, 0.0
    return (s11 * sv - s1 * s1v) / determinant, (ss * s1v - s1 * sv) / determinant


@njit(cache=True, nogil=True, fastmath=True)
def _gathered(grey, n, half, scale, members, neighbours, shape, uv, found, pixels):
    """List the pixels around marker n: value without its neighbours, shape, slopes, and place from its middle.

    Returns:
        How many there are.
    """
    whitening, profile = shape
    height, width = grey.shape
    left, top = int(np.rint(uv[n, 0])) - half, int(np.rint(uv[n, 1])) - half
    values, brightness, slope_u, slope_v, along_u, along_v = pixels
    count = 0
    for i in range(max(top, 0), min(top + 2 * half + 1, height)):
        dv = i - uv[n, 1]
        for j in range(max(left, 0), min(left + 2 * half + 1, width)):
            du = j - uv[n, 0]
            values[count] = grey[i, j]
            brightness[count], slope_u[count], slope_v[count] = _shape(du, dv, scale[n], whitening, profile)
            along_u[count], along_v[count] = du, dv
            count += 1
    for near in range(neighbours):
        m = members[near]
        du, dv = uv[n, 0] - uv[m, 0], uv[n, 1] - uv[m, 1]
        for k in range(count):
            other, _, _ = _shape(along_u[k] + du, along_v[k] + dv, scale[m], whitening, profile)
            values[k] -= found[m, 0] * other
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _summed(pixels, weight, count, ground, amplitude, normal, right, pulls):
    """Fill the normal equations of (ground, amplitude, u, v) and what each octant contributes to their right side.

    Returns:
        Sum of the weights, weighted squares, and squares and number of pixels in the middle of the marker.
    """
    values, brightness, slope_u, slope_v, along_u, along_v = pixels
    normal[:], right[:], pulls[:] = 0.0, 0.0, 0.0
    total, squares, core, middle = 0.0, 0.0, 0, 0.0
    for k in range(count):
        w, t = weight[k], brightness[k]
        r = values[k] - ground - amplitude * t
        a, b, x, y = t, -amplitude * slope_u[k], along_u[k], along_v[k]
        c = -amplitude * slope_v[k]
        octant = (1 if x > 0 else 0) + (2 if y > 0 else 0) + (4 if abs(x) > abs(y) else 0)
        wr, wa, wb = w * r, w * a, w * b
        pulls[octant, 0] += wr
        pulls[octant, 1] += wr * a
        pulls[octant, 2] += wr * b
        pulls[octant, 3] += wr * c
        total += w
        squares += wr * r
        normal[1, 0] += wa
        normal[2, 0] += wb
        normal[3, 0] += w * c
        normal[1, 1] += wa * a
        normal[2, 1] += wa * b
        normal[3, 1] += wa * c
        normal[2, 2] += wb * b
        normal[3, 2] += wb * c
        normal[3, 3] += w * c * c
        if t > CORE:
            core += 1
            middle += r * r
    normal[0, 0] = total
    for a in range(4):
        normal[a, a] += 1e-6 * normal[a, a] + 1e-9
        for octant in range(OCTANTS):
            right[a] += pulls[octant, a]
    return total, squares, core, middle


@njit(cache=True, nogil=True)
def _variance(normal, pulls, variance, axis, row):
    """Variance of the place along one axis, after `cholesky(normal)`: that of its pixels, or of its octants."""
    row[:] = 0.0
    row[axis] = 1.0
    kernels.cholesky_solve(normal, row)
    scatter = 0.0
    for octant in range(OCTANTS):
        pull = 0.0
        for a in range(4):
            pull += row[a] * pulls[octant, a]
        scatter += pull * pull
    return max(variance * row[axis], FEW * scatter)


@njit(cache=True, nogil=True)
def fit_markers(grey, inside, half, scale, close, shape, iterations, uv, found):
    """Fit markers (N) in the windows around them, place by place.

    A marker that does not look like the shape leaves residuals that belong together: what pulls it to one side is said
    by whole octants, and it is these whose scatter the variance of its place follows, where it is more than that of
    single pixels (a sandwich estimator of clusters).

    Args:
        grey: (H, W) grey values, brighter where markers are.
        inside: (N,) markers that are fitted.
        half: px, half of a window.
        scale: (N,) size of each marker in parts of the shape.
        close: (N, N) which other markers may reach into a window.
        shape: whitening (2, 2) and profile (R,).
        iterations: the last ones of `MISFIT`.
        uv: (N, 2) where to begin; filled with the places.
        found: (N, 5) amplitudes, of neighbours that were fitted before; filled with amplitude, its variance, the
            variance of the place along an axis, the mean squared residual within the marker, and the squared noise.
    """
    side = 2 * half + 1
    pixels = np.empty((6, side * side))
    weight, residual, histogram = np.empty(side * side), np.empty(side * side), np.empty(BINS, np.int64)
    members = np.empty(len(uv), np.int64)
    normal, right, row, pulls = np.empty((4, 4)), np.empty(4), np.empty(4), np.empty((OCTANTS, 4))
    for iteration in range(len(MISFIT) - iterations, len(MISFIT)):
        for n in range(len(uv)):
            if not inside[n]:
                continue
            neighbours = 0
            for m in range(len(uv)):
                if close[n, m] and found[m, 0] > 0:
                    members[neighbours] = m
                    neighbours += 1
            count = _gathered(grey, n, half, scale, members, neighbours, shape, uv, found, pixels)
            if count < 8:
                found[n, 0] = 0.0
                continue
            values, brightness = pixels[0], pixels[1]
            for k in range(count):
                weight[k] = 1.0
            ground, amplitude = _linear(values, brightness, weight, count)
            for k in range(count):
                residual[k] = values[k] - ground - amplitude * brightness[k]
            spread = max(1.4826 * _median(residual, count, histogram), LEAST_NOISE)
            allowed = ROBUST * max(spread, MISFIT[iteration] * amplitude)
            for k in range(count):
                weight[k] = 1 / (1 + (residual[k] / allowed) ** 2)
            ground, amplitude = _linear(values, brightness, weight, count)
            amplitude = max(amplitude, 0.0)
            total, squares, core, middle = _summed(pixels, weight, count, ground, amplitude, normal, right, pulls)
            variance = max(squares / max(total - 4, 1.0), LEAST_NOISE * LEAST_NOISE)
            found[n, 0], found[n, 3], found[n, 4] = amplitude, middle / max(core, 1), spread * spread
            found[n, 1], found[n, 2] = np.inf, np.inf
            if not kernels.cholesky(normal):
                continue
            kernels.cholesky_solve(normal, right)
            uv[n, 0] += min(max(right[2], -FARTHEST), FARTHEST)
            uv[n, 1] += min(max(right[3], -FARTHEST), FARTHEST)
            found[n, 2] = 0.5 * (
                _variance(normal, pulls, variance, 2, row) + _variance(normal, pulls, variance, 3, row)
            )
            row[:] = 0.0
            row[1] = 1.0
            kernels.cholesky_solve(normal, row)
            found[n, 1] = variance * row[1]
