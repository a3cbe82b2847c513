"""What the markers of a camera look like: their windows, boiled down to an ellipse and a profile, compiled."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from renderers.compiling import njit

RINGS = 0.5  # px of the shorter axis, from one value of a profile to the next
FAINT = 0.25  # of the peak: where the shape is measured from
MOMENTS = 6  # times that the window of the moments follows them
TAPS = 4  # px that a blur with a standard deviation of one reaches


@njit(cache=True, nogil=True)
def median(values, count):
    """Median of the first `count` values, which are reordered."""
    upper = _ranked(values, count, count // 2)
    if count % 2:
        return upper
    lower = values[0]
    for i in range(1, count // 2):
        lower = max(lower, values[i])
    return (lower + upper) / 2


@njit(cache=True, nogil=True)
def _ranked(values, count, rank):
    """Value of a rank among the first `count` ones; none before it is larger afterwards (Hoare)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]


@njit(cache=True, nogil=True)
def _blurred(line, blurred):
    """Blur a row of values with a standard deviation of one; the outer ones continue."""
    weights = np.empty(2 * TAPS + 1)
    total = 0.0
    for k in range(2 * TAPS + 1):
        weights[k] = np.exp(-0.5 * (k - TAPS) ** 2)
        total += weights[k]
    last = len(line) - 1
    for i in range(len(line)):
        blurred[i] = 0.0
        for k in range(2 * TAPS + 1):
            blurred[i] += weights[k] / total * line[min(max(i + k - TAPS, 0), last)]


@njit(cache=True, nogil=True)
def usual_window(patches, mean):
    """Fill `mean` (P, P) with the median of windows (K, P, P), each less its rim and over its middle, made symmetric.

    Returns:
        Whether there is any window that is brighter in the middle.
    """
    count, side = len(patches), patches.shape[1]
    half, held = side // 2, np.empty(side * side)
    level, peak, bright = np.empty(count), np.empty(count), np.empty(count, np.int64)
    core = max(1.5, 0.25 * half) ** 2
    number = 0
    for n in range(count):
        rim = 0
        for i in range(side):
            for j in range(side):
                if max(abs(i - half), abs(j - half)) >= half - 1:
                    held[rim] = patches[n, i, j]
                    rim += 1
        level[n] = median(held, rim)
        inner = 0
        for i in range(side):
            for j in range(side):
                if (i - half) ** 2 + (j - half) ** 2 <= core:
                    held[inner] = patches[n, i, j]
                    inner += 1
        peak[n] = median(held, inner) - level[n]
        if peak[n] > 0:
            bright[number] = n
            number += 1
    if number == 0:
        return False
    for i in range(side):
        for j in range(side):
            for k in range(number):
                n = bright[k]
                held[k] = (patches[n, i, j] - level[n]) / peak[n]
            mean[i, j] = median(held, number)
    for i in range(half + 1):  # of a symmetric shape: the middle stays the middle
        for j in range(side):
            both = (mean[i, j] + mean[side - 1 - i, side - 1 - j]) / 2
            mean[i, j], mean[side - 1 - i, side - 1 - j] = both, both
    return True


@njit(cache=True, nogil=True)
def _moments(mean, covariance):
    """Fill (a, b, c) with the covariance [[a, b], [b, c]] of what is connected to the middle; False = nothing is."""
    side = len(mean)
    half = side // 2
    smooth, rows = np.empty((side, side)), np.empty((side, side))
    for i in range(side):
        _blurred(mean[i], rows[i])
    for j in range(side):
        _blurred(rows[:, j], smooth[:, j])
    top = 0.0
    core = max(1.5, 0.25 * half) ** 2
    for i in range(side):
        for j in range(side):
            if (i - half) ** 2 + (j - half) ** 2 <= core:
                top = max(top, smooth[i, j])
    if not top > 0:
        return False
    a, b, c = (0.3 * half) ** 2, 0.0, (0.3 * half) ** 2
    for _ in range(MOMENTS):  # in a window that follows them
        determinant = a * c - b * b
        total, uu, uv, vv = 0.0, 0.0, 0.0, 0.0
        for i in range(side):
            v = i - half
            for j in range(side):
                u = j - half
                if (c * u * u - 2 * b * u * v + a * v * v) < 9 * determinant:
                    weight = max(smooth[i, j] - FAINT * top, 0.0)
                    total += weight
                    uu, uv, vv = uu + weight * u * u, uv + weight * u * v, vv + weight * v * v
        if not total > 0:
            return False
        a, b, c = uu / total + 0.1, uv / total, vv / total + 0.1
    covariance[0], covariance[1], covariance[2] = a, b, c
    return True


@njit(cache=True, nogil=True)
def common_shape(patches, whitening, profile):
    """Boil windows (K, P, P) with a marker in the middle of each down to what these have in common.

    Args:
        patches: grey values, brighter where markers are.
        whitening: (2, 2) filled: ellipses become circles of the same pixels as the shorter axis.
        profile: filled with the brightness at radii 0, RINGS, 2 RINGS, ..., one in the middle; P values are enough.

    Returns:
        How many values the profile has (0 = there is no marker), and the longer axis in parts of the shorter.
    """
    side = patches.shape[1]
    half = side // 2
    mean, covariance = np.empty((side, side)), np.empty(3)
    if not usual_window(patches, mean) or not _moments(mean, covariance):
        return 0, 1.0
    a, b, c = covariance[0], covariance[1], covariance[2]
    apart = np.sqrt((a - c) ** 2 / 4 + b * b)
    short, long = np.sqrt((a + c) / 2 - apart), np.sqrt((a + c) / 2 + apart)
    # The inverse of the root of a matrix of two rows, by the theorem of Cayley and Hamilton, times the shorter axis.
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
    _blurred(sums, numbers)
    for ring in range(most - 1, -1, -1):
        numbers[ring] = max(numbers[ring], numbers[ring + 1])  # it does not grow with the radius
    peak = numbers[0] - numbers[most]
    if not peak > 0:
        return 0, 1.0
    for ring in range(most + 1):
        profile[ring] = (numbers[ring] - numbers[most]) / peak
    profile[most + 1] = 0.0
    return most + 2, long / short
