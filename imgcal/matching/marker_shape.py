"""Compiled common shape of a camera's markers: an ellipse and a radial profile from their windows."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import kernels
from renderers.compiling import njit

RINGS = 0.5  # px along the shorter axis between values of a profile
FAINT = 0.25  # of the peak: darker pixels do not count for the moments
MOMENTS = 6  # iterations in which the window follows the moments
TAPS = 4  # px, half width of a blur with a standard deviation of one


@njit(cache=True, nogil=True, heavy=True)
def median(values, count):
    """Median of the first `count` values; reorders them."""
    upper = kernels.select_rank(values, count, count // 2)
    if count % 2:
        return upper
    lower = values[0]
    for i in range(1, count // 2):
        lower = max(lower, values[i])
    return (lower + upper) / 2


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _blur(line, blurred):
    """Blur a row of values with a standard deviation of one; the outer values are repeated beyond the ends."""
    weights = np.empty(2 * TAPS + 1)
    total = 0.0
    for k in range(2 * TAPS + 1):
        weights[k] = np.exp(-0.5 * (k - TAPS) ** 2)
        total += weights[k]
    size = len(line)
    wide = np.empty(size + 2 * TAPS)
    for i in range(size + 2 * TAPS):
        wide[i] = line[min(max(i - TAPS, 0), size - 1)]
    for i in range(size):
        blurred[i] = 0.0
    for k in range(2 * TAPS + 1):
        weight = weights[k] / total
        for i in range(size):
            blurred[i] += weight * wide[i + k]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _medians(stack, count):
    """Replace the first row of (K, P) by the medians of the first `count` values of each column; reorders them."""
    middle = count // 2
    for rank in range(middle + 1):  # the smallest of the unsorted values moves to the front
        for other in range(rank + 1, count):
            for j in range(stack.shape[1]):
                one, two = stack[rank, j], stack[other, j]
                stack[rank, j], stack[other, j] = min(one, two), max(one, two)
    before = middle - 1 + count % 2
    for j in range(stack.shape[1]):
        stack[0, j] = np.float32(0.5) * (stack[before, j] + stack[middle, j])


@njit(cache=True, nogil=True, error_model="numpy", heavy=True)
def _levels(patch, scratch):
    """Medians of the rim, two pixels wide, and of the centre of a window (P, P)."""
    side = len(patch)
    half = side // 2
    reach = max(1.5, 0.25 * half)
    rim, inner, near = 0, 0, int(reach)
    for i in (0, 1, side - 2, side - 1):
        for j in range(side):
            scratch[rim] = patch[i, j]
            rim += 1
    for i in range(2, side - 2):
        for j in (0, 1, side - 2, side - 1):
            scratch[rim] = patch[i, j]
            rim += 1
    level = median(scratch, rim)
    for i in range(-near, near + 1):
        for j in range(-near, near + 1):
            if i * i + j * j <= reach * reach:
                scratch[inner] = patch[half + i, half + j]
                inner += 1
    return level, median(scratch, inner)


@njit(cache=True, nogil=True, error_model="numpy", heavy=True)
def usual_window(patches, mean):
    """Fill `mean` (P, P) with the median of windows (K, P, P), each normalized by rim and centre, made symmetric.

    Returns:
        Whether any window is brighter in the centre.
    """
    count, side = len(patches), patches.shape[1]
    scratch, stack = np.empty(side * side, np.float32), np.empty((count, side), np.float32)
    level, factor, bright = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.int64)
    number = 0
    for n in range(count):
        low, high = _levels(patches[n], scratch)
        if high > low:
            level[number], factor[number], bright[number] = low, 1 / (high - low), n
            number += 1
    if number == 0:
        return False
    for i in range(side):
        for k in range(number):
            for j in range(side):
                stack[k, j] = (patches[bright[k], i, j] - level[k]) * factor[k]
        _medians(stack, number)
        for j in range(side):
            mean[i, j] = stack[0, j]
    for i in range(side // 2 + 1):  # a symmetric shape has a fixed centre
        for j in range(side):
            both = (mean[i, j] + mean[side - 1 - i, side - 1 - j]) / 2
            mean[i, j], mean[side - 1 - i, side - 1 - j] = both, both
    return True


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _moments(mean, covariance):
    """Fill (a, b, c) with the covariance [[a, b], [b, c]] of the central spot; False = no spot."""
    side = len(mean)
    half = side // 2
    smooth, columns = np.empty((side, side)), np.empty((side, side))  # column-major
    for i in range(side):
        _blur(mean[i], smooth[i])
    for j in range(side):
        for i in range(side):
            columns[j, i] = smooth[i, j]
    for j in range(side):
        _blur(columns[j], smooth[j])
    top = 0.0
    core = max(1.5, 0.25 * half) ** 2
    for j in range(side):
        for i in range(side):
            if (i - half) ** 2 + (j - half) ** 2 <= core:
                top = max(top, smooth[j, i])
    if not top > 0:
        return False
    a, b, c = (0.3 * half) ** 2, 0.0, (0.3 * half) ** 2
    for _ in range(MOMENTS):  # the window follows the moments
        limit = 9 * (a * c - b * b)
        total, uu, uv, vv = 0.0, 0.0, 0.0, 0.0
        for j in range(side):
            u = float(j - half)
            for i in range(side):
                v = float(i - half)
                near = c * u * u - 2 * b * u * v + a * v * v < limit
                weight = max(smooth[j, i] - FAINT * top, 0.0) if near else 0.0
                total += weight
                uu += weight * u * u
                uv += weight * u * v
                vv += weight * v * v
        if not total > 0:
            return False
        a, b, c = uu / total + 0.1, uv / total, vv / total + 0.1
    covariance[0], covariance[1], covariance[2] = a, b, c
    return True


@njit(cache=True, nogil=True, error_model="numpy", heavy=True)
def common_shape(patches, whitening, profile):
    """Compute the common shape of markers from windows (K, P, P) centred on them.

    Args:
        patches: grey values, markers bright.
        whitening: (2, 2) output: maps ellipses to circles, in pixels of the shorter axis.
        profile: output: brightness at radii 0, RINGS, 2 RINGS, ..., one at the centre; P values are enough.

    Returns:
        Number of values of the profile (0 = no marker), and the ratio of the longer to the shorter axis.
    """
    side = patches.shape[1]
    half = side // 2
    mean, covariance = np.empty((side, side)), np.empty(3)
    if not usual_window(patches, mean) or not _moments(mean, covariance):
        return 0, 1.0
    a, b, c = covariance[0], covariance[1], covariance[2]
    apart = np.sqrt((a - c) ** 2 / 4 + b * b)
    short, long = np.sqrt((a + c) / 2 - apart), np.sqrt((a + c) / 2 + apart)
    # Inverse square root of a 2 x 2 matrix by the Cayley-Hamilton theorem, times the shorter axis.
    scale = short / ((short + long) * short * long)
    whitening[0, 0], whitening[1, 1] = scale * (c + short * long), scale * (a + short * long)
    whitening[0, 1], whitening[1, 0] = -scale * b, -scale * b
    most = int(np.ceil(min(4.5 * short + 2, half) / RINGS))
    sums, numbers = np.zeros(most + 1), np.zeros(most + 1)
    for i in range(side):
        v = i - half
        for j in range(side):
            u = j - half
            x, y = whitening[0, 0] * u + whitening[0, 1] * v, whitening[1, 0] * u + whitening[1, 1] * v
            ring = int(np.sqrt(x * x + y * y) / RINGS + 0.5)
            if ring <= most:
                sums[ring] += mean[i, j]
                numbers[ring] += 1
    for ring in range(most + 1):
        sums[ring] /= max(numbers[ring], 1.0)
    _blur(sums, numbers)
    for ring in range(most - 1, -1, -1):
        numbers[ring] = max(numbers[ring], numbers[ring + 1])  # must not increase with the radius
    peak = numbers[0] - numbers[most]
    if not peak > 0:
        return 0, 1.0
    for ring in range(most + 1):
        profile[ring] = (numbers[ring] - numbers[most]) / peak
    profile[most + 1] = 0.0
    return most + 2, long / short
