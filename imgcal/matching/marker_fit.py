"""Compiled robust least squares for position, brightness and background of markers of known common shape.

Overlapping markers are fitted in turns, each with the others subtracted.
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
"""Relative error of the common shape to allow for, of the amplitude, in each iteration."""
NEAR = 2  # the last iterations, enough where the positions are known
ROBUST = 3.0  # standard deviations from which the weight of a pixel decreases
LEAST_NOISE = 0.3  # grey levels, from rounding
FARTHEST = 2.0  # px, largest step
CORE = 0.3  # of the peak: the brighter part of a marker, which must look like the shape
HALVINGS = 12  # bisection steps for the median of residuals
OCTANTS = 8  # around a marker; residuals are summed within each
FEW = OCTANTS / (OCTANTS - 4)
"""Correction for their reduced scatter: the fit of four values has made four sums of residuals zero."""


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _median(values, count):
    """Median of the first `count` non-negative values, accurate relative to the largest."""
    low, high = np.float32(0), np.float32(0)
    for i in range(count):
        high = max(high, values[i])
    for _ in range(HALVINGS):
        middle, below = np.float32(0.5) * (low + high), np.int32(0)
        for i in range(count):
            below += np.int32(values[i] < middle)
        if 2 * below < count:
            low = middle
        else:
            high = middle
    return np.float32(0.5) * (low + high)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _linear(values, shapes, residual, doubt, count):
    """Background and amplitude of a shape, with weights of pixels reduced by `doubt` times their squared residuals."""
    one, zero = np.float32(1), np.float32(0)
    ss, s1, s11, sv, s1v = zero, zero, zero, zero, zero
    for i in range(count):
        w, t, value = one / (one + doubt * residual[i] * residual[i]), shapes[i], values[i]
        ss += w
        s1 += w * t
        s11 += w * t * t
        sv += w * value
        s1v += w * t * value
    determinant = ss * s11 - s1 * s1
    if not determinant > np.float32(1e-6) * ss * s11:
        return zero, zero
    return (s11 * sv - s1 * s1v) / determinant, (ss * s1v - s1 * sv) / determinant


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _gather(grey, n, half, uv, pixels):
    """List the pixels around marker n: their values, and their positions relative to its centre.

    Returns:
        First and last column and row, the last ones excluded.
    """
    height, width = grey.shape
    values, along_u, along_v = pixels[0], pixels[1], pixels[2]
    left, top = int(np.rint(uv[n, 0])) - half, int(np.rint(uv[n, 1])) - half
    right, bottom = min(left + 2 * half + 1, width), min(top + 2 * half + 1, height)
    left, top = max(left, 0), max(top, 0)
    for i in range(top, bottom):
        first, du, dv = (i - top) * (right - left), np.float32(left - uv[n, 0]), np.float32(i - uv[n, 1])
        last, row = first + right - left, grey[i, left:right]
        line, line_u, line_v = values[first:last], along_u[first:last], along_v[first:last]
        for j in range(right - left):
            line[j] = row[j]
            line_u[j] = du + np.float32(j)
            line_v[j] = dv
    return left, right, top, bottom


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _subtract_marker(box, m, half, size, amplitude, whitening, profile, uv, values):
    """Subtract marker m from the values in a box, within its reach."""
    left, right, top, bottom = box
    ring = 1 / (RINGS * size)
    a, b, c = ring * whitening[0, 0], ring * whitening[0, 1], ring * whitening[1, 1]
    first, last = max(int(np.floor(uv[m, 0])) - half, left), min(int(np.ceil(uv[m, 0])) + half + 1, right)
    for i in range(max(int(np.floor(uv[m, 1])) - half, top), min(int(np.ceil(uv[m, 1])) + half + 1, bottom)):
        for j in range(first, last):
            k, du, dv = (i - top) * (right - left) + j - left, j - uv[m, 0], i - uv[m, 1]
            place = np.sqrt((a * du + b * dv) ** 2 + (b * du + c * dv) ** 2)
            low = int(place)
            if low < len(profile) - 1:
                values[k] -= amplitude * (profile[low] + (place - low) * (profile[low + 1] - profile[low]))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _shape(size, whitening, profile, pixels, count):
    """Compute ring index and brightness of pixels, and the increase of brightness to the next ring."""
    along_u, along_v, place, brightness, step = pixels[1], pixels[2], pixels[3], pixels[4], pixels[5]
    ring = 1 / (RINGS * size)
    a, b, c = np.float32(ring * whitening[0, 0]), np.float32(ring * whitening[0, 1]), np.float32(ring * whitening[1, 1])
    for k in range(count):
        x, y = a * along_u[k] + b * along_v[k], b * along_u[k] + c * along_v[k]
        place[k] = np.sqrt(x * x + y * y)
    # The last two values are zero, and so is the brightness beyond.
    beyond = np.float32(len(profile) - 2)
    for k in range(count):
        low = int(min(place[k], beyond))
        grown = profile[low + 1] - profile[low]
        brightness[k] = profile[low] + grown * (place[k] - np.float32(low))
        step[k] = grown


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _sum(pixels, count, size, whitening, ground, amplitude, doubt, normal, right):
    """Compute the normal equations of (ground, amplitude, u, v).

    Returns:
        Sum of the weights, weighted squares, and number and squares of the pixels in the marker's core.
    """
    values, along_u, along_v, place = pixels[0], pixels[1], pixels[2], pixels[3]
    brightness, step, residual = pixels[4], pixels[5], pixels[6]
    ring = 1 / (RINGS * size)
    p, q, s = np.float32(ring * whitening[0, 0]), np.float32(ring * whitening[0, 1]), np.float32(ring * whitening[1, 1])
    zero, one = np.float32(0), np.float32(1)
    w0, wt, wx, wy, wtt, wtx, wty = zero, zero, zero, zero, zero, zero, zero
    wxx, wxy, wyy, wr, wrt, wrx, wry, squares, middle, core = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(count):
        t, r = brightness[k], values[k] - ground - amplitude * brightness[k]
        w = one / (one + doubt * residual[k] * residual[k])
        # Slopes along the whitened axes; those by u and v follow from their sums.
        slope = step[k] / max(place[k], np.float32(1e-6))
        x, y = slope * (p * along_u[k] + q * along_v[k]), slope * (q * along_u[k] + s * along_v[k])
        wa, wb, wc, wd = w * t, w * x, w * y, w * r
        w0 += w
        wt += wa
        wx += wb
        wy += wc
        wtt += wa * t
        wtx += wa * x
        wty += wa * y
        wxx += wb * x
        wxy += wb * y
        wyy += wc * y
        wr += wd
        wrt += wd * t
        wrx += wd * x
        wry += wd * y
        squares += wd * r
        inner = one if t > np.float32(CORE) else zero
        core += inner
        middle += inner * r * r
    # Moving the marker changes its brightness by minus the slope.
    a, b, c = -amplitude * p, -amplitude * q, -amplitude * s
    normal[0, 0], normal[1, 0], normal[1, 1] = w0, wt, wtt
    normal[2, 0], normal[3, 0] = a * wx + b * wy, b * wx + c * wy
    normal[2, 1], normal[3, 1] = a * wtx + b * wty, b * wtx + c * wty
    normal[2, 2] = a * a * wxx + 2 * a * b * wxy + b * b * wyy
    normal[3, 2] = a * b * wxx + (a * c + b * b) * wxy + b * c * wyy
    normal[3, 3] = b * b * wxx + 2 * b * c * wxy + c * c * wyy
    right[0], right[1], right[2], right[3] = wr, wrt, a * wrx + b * wry, b * wrx + c * wry
    for k in range(4):
        normal[k, k] += 1e-6 * normal[k, k] + 1e-9
    return w0, squares, core, middle


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _pull(pixels, count, size, whitening, ground, amplitude, doubt, pulls):
    """Compute the contribution of each octant to the right side of the normal equations."""
    values, along_u, along_v, place = pixels[0], pixels[1], pixels[2], pixels[3]
    brightness, step, residual = pixels[4], pixels[5], pixels[6]
    ring = 1 / (RINGS * size)
    p, q, s = np.float32(ring * whitening[0, 0]), np.float32(ring * whitening[0, 1]), np.float32(ring * whitening[1, 1])
    pulls[:] = 0.0
    for k in range(count):
        du, dv, t = along_u[k], along_v[k], brightness[k]
        octant = (1 if du > 0 else 0) + (2 if dv > 0 else 0) + (4 if abs(du) > abs(dv) else 0)
        wr = (values[k] - ground - amplitude * t) / (np.float32(1) + doubt * residual[k] * residual[k])
        pulls[octant, 0] += wr
        pulls[octant, 1] += wr * t
        if step[k] != 0:
            x, y = p * du + q * dv, q * du + s * dv
            slope = -amplitude * wr * step[k] / max(place[k], np.float32(1e-6))
            pulls[octant, 2] += slope * (p * x + q * y)
            pulls[octant, 3] += slope * (q * x + s * y)


@njit(cache=True, nogil=True, heavy=True)
def _variance(normal, pulls, variance, axis, row):
    """Variance of the position along one axis, after `cholesky(normal)`: the larger one from pixels or octants."""
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


@njit(cache=True, nogil=True, heavy=True)
def _improve(size, shape, misfit, last, count, pixels, place, result, work):
    """Move a marker (2,) by one robust step; fill its results (5,), see `fit_markers`."""
    whitening, profile = shape
    values, brightness, residual = pixels[0], pixels[4], pixels[6]
    normal, right, row, pulls = work
    _shape(size, whitening, profile, pixels, count)
    nothing = np.float32(0)
    ground, amplitude = _linear(values, brightness, residual, nothing, count)
    for k in range(count):
        residual[k] = abs(values[k] - ground - amplitude * brightness[k])
    spread = max(1.4826 * _median(residual, count), LEAST_NOISE)
    allowed = ROBUST * max(spread, misfit * amplitude)
    doubt = np.float32(1 / (allowed * allowed))
    ground, amplitude = _linear(values, brightness, residual, doubt, count)
    amplitude = max(amplitude, nothing)
    total, squares, core, middle = _sum(pixels, count, size, whitening, ground, amplitude, doubt, normal, right)
    result[0], result[3], result[4] = amplitude, middle / max(core, 1), spread * spread
    result[1], result[2] = np.inf, np.inf
    if not kernels.cholesky(normal):
        return
    kernels.cholesky_solve(normal, right)
    place[0] += min(max(right[2], -FARTHEST), FARTHEST)
    place[1] += min(max(right[3], -FARTHEST), FARTHEST)
    if last:
        variance = max(squares / max(total - 4, 1.0), LEAST_NOISE * LEAST_NOISE)
        _pull(pixels, count, size, whitening, ground, amplitude, doubt, pulls)
        result[2] = 0.5 * (_variance(normal, pulls, variance, 2, row) + _variance(normal, pulls, variance, 3, row))
        row[:] = 0.0
        row[1] = 1.0
        kernels.cholesky_solve(normal, row)
        result[1] = variance * row[1]


@njit(cache=True, nogil=True, heavy=True)
def fit_markers(grey, inside, half, scale, close, shape, iterations, with_variance, uv, found):
    """Fit markers (N) in the windows around them, one after the other.

    A marker that does not match the shape leaves correlated residuals. Whole octants are therefore treated as clusters,
    and the variance of the position follows their scatter where that exceeds the scatter of single pixels (a
    cluster-robust sandwich estimator).

    Args:
        grey: (H, W) grey values, markers bright.
        inside: (N,) the markers to fit.
        half: px, half size of a window.
        scale: (N,) size of each marker relative to the shape.
        close: (N, N) which other markers may reach into a window.
        shape: whitening (2, 2) and profile (R,).
        iterations: number of iterations; uses the last entries of `MISFIT`.
        with_variance: whether to compute variances; otherwise they stay infinite.
        uv: (N, 2) initial positions; replaced by the fitted ones.
        found: (N, 5) amplitudes of neighbours from an earlier fit; filled with amplitude, its variance, the variance
            of the position per axis, the mean squared residual within the marker, and the squared noise.
    """
    whitening, profile = shape
    pixels = np.zeros((7, (2 * half + 1) ** 2), np.float32)
    work = np.empty((4, 4)), np.empty(4), np.empty(4), np.empty((OCTANTS, 4))
    shape = whitening, np.append(profile, profile[-1:]).astype(np.float32)
    for iteration in range(len(MISFIT) - iterations, len(MISFIT)):
        for n in range(len(uv)):
            if not inside[n]:
                continue
            box = _gather(grey, n, half, uv, pixels)
            count = max(box[1] - box[0], 0) * max(box[3] - box[2], 0)
            if count < 8:
                found[n, 0] = 0.0
                continue
            for m in range(len(uv)):
                if close[n, m] and found[m, 0] > 0:
                    _subtract_marker(box, m, half, scale[m], found[m, 0], whitening, profile, uv, pixels[0])
            last = with_variance and iteration == len(MISFIT) - 1
            _improve(scale[n], shape, MISFIT[iteration], last, count, pixels, uv[n], found[n], work)
