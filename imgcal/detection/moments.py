"""Compiled moments of a blob in its window: its shape, and its centroid where no ellipse can be fitted."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from renderers.compiling import njit

TWO_PEAKED = 0.515  # bimodality coefficient
WAIST = 0.92  # of the mass to either side along the major axis: below, the blob is two merged ones
LONGEST_PATCH = 3.0  # elongation of a flat square at 70 degrees; longer ones are seams and edges
PART = 0.4  # of the largest mass in a bin: less is noise beside the blob, not a second blob
PROFILE = 24  # most bins of the mass along the major axis
LEAST_WIDE = 1.6  # px, standard deviation along the minor axis: the waist of a narrower blob is lost in the blur


@njit(cache=True, nogil=True, fastmath=True)
def find_ramp(grey, weight, scale, ramp):
    """Derivative of the weighted value by the 3 x 3 mean, whose noise also moves the weight between 0 and 1."""
    zero, one = np.float32(0), np.float32(1)
    for i in range(grey.shape[0]):
        part, value, slope = weight[i], grey[i], ramp[i]
        for j in range(grey.shape[1]):
            slope[j] = value[j] * scale if zero < part[j] < one else zero


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def find_centroid(grey, weight, ramp, x, y):
    """Compute the centroid of a blob from all pixels at (x, y) from the centre of the window, as one row.

    Returns:
        Centroid x, y, and two sums of squared distances from it: weighted by the squared gain of each pixel's noise,
        and by the weight.
    """
    wide, pixels = grey.shape[1], grey.size
    value, part, slope = grey.reshape(-1), weight.reshape(-1), ramp.reshape(-1)
    above, middle, below = slope[: -2 * wide], slope[wide:-wide], slope[2 * wide :]
    value, part, x, y = value[wide:-wide], part[wide:-wide], x[wide : pixels - wide], y[wide : pixels - wide]
    b = bx = by = g = gx = gy = gg = t = tx = ty = tt = np.float32(0)
    for p in range(1, len(value) - 1):
        outer = above[p - 1] + above[p] + above[p + 1] + below[p - 1] + below[p] + below[p + 1]
        gain = part[p] + (outer + middle[p - 1] + middle[p] + middle[p + 1]) * np.float32(1 / 9)
        gain *= gain
        mass, square = part[p] * value[p], x[p] * x[p] + y[p] * y[p]
        b, bx, by = b + mass, bx + mass * x[p], by + mass * y[p]
        g, gx, gy, gg = g + gain, gx + gain * x[p], gy + gain * y[p], gg + gain * square
        t, tx, ty, tt = t + part[p], tx + part[p] * x[p], ty + part[p] * y[p], tt + part[p] * square
    brightness = max(float(b), 1e-6)
    x0, y0 = bx / brightness, by / brightness
    away = x0 * x0 + y0 * y0
    return x0, y0, gg - 2 * (x0 * gx + y0 * gy) + away * g, tt - 2 * (x0 * tx + y0 * ty) + away * t


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def find_waist(grey, weight, x, y, most, axis, middle, spread):
    """Smallest ratio along an axis of the mass to the lesser of the peaks on its two sides; 1 = there is no waist.

    The axis is given by its cosine and sine, the blob's mean and standard deviation (px) along it; the rest is as in
    `find_shape`.
    """
    value, part = grey.reshape(-1), weight.reshape(-1)
    profile, width = np.zeros(PROFILE), max(1.0, spread / 3.5)
    for p in range(len(value)):
        mass = min(max(part[p] * value[p], np.float32(0)), most)
        at = (x[p] * axis[0] + y[p] * axis[1] - middle) / width + PROFILE / 2
        if mass > 0 and 0 <= at < PROFILE - 1:
            left = int(at)
            profile[left] += mass * (left + 1 - at)
            profile[left + 1] += mass * (at - left)
    after = np.empty(PROFILE)  # largest mass from here on
    after[PROFILE - 1] = profile[PROFILE - 1]
    for i in range(PROFILE - 2, -1, -1):
        after[i] = max(profile[i], after[i + 1])
    least, before, most_mass = 1.0, 0.0, after[0]
    for i in range(1, PROFILE - 1):
        before = max(before, profile[i - 1])
        sides = min(before, after[i + 1])
        if sides > PART * most_mass:
            least = min(least, profile[i] / sides)
    return least


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def find_shape(grey, weight, x, y, most, patch):
    """Find the elongation of a blob with masses clipped at `most`, whether it has two parts along its major axis, its
    centroid, and its moments xx, xy, yy. A flat `patch` may be a square.

    Source: Sarle's bimodality coefficient, (skewness ** 2 + 1) / kurtosis: 0.50 for any filled ellipse and less when it
    is blurred, 0.60 for two discs that touch and 0.51 to 0.57 when they are blurred. A uniform rod has 0.56, but no
    waist.
    """
    value, part, zero, most = grey.reshape(-1), weight.reshape(-1), np.float32(0), np.float32(most)
    t = sx = sy = sxx = syy = sxy = cube = fourth = zero
    for p in range(len(value)):
        mass = min(max(part[p] * value[p], zero), most)
        t, sx, sy = t + mass, sx + mass * x[p], sy + mass * y[p]
        sxx, syy, sxy = sxx + mass * x[p] * x[p], syy + mass * y[p] * y[p], sxy + mass * x[p] * y[p]
    total = max(float(t), 1e-6)
    x0, y0 = sx / total, sy / total
    xx, yy, xy = sxx / total - x0 * x0, syy / total - y0 * y0, sxy / total - x0 * y0
    angle, swing = 0.5 * np.arctan2(2 * xy, xx - yy), np.hypot(xx - yy, 2 * xy)
    major, minor = (xx + yy + swing) / 2, (xx + yy - swing) / 2
    elongation = np.sqrt(major / max(minor, 1 / 12))  # at least a pixel wide
    cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    start = np.float32(x0 * cosine + y0 * sine)
    for p in range(len(value)):
        mass = min(max(part[p] * value[p], zero), most)
        along = x[p] * cosine + y[p] * sine - start
        moment = mass * along * along
        cube, fourth = cube + moment * along, fourth + moment * along * along
    third, fourth = cube / total, fourth / total
    bimodality = (third**2 / max(major, 1e-6) ** 3 + 1) * major**2 / max(fourth, 1e-6)
    two_peaked = bimodality > TWO_PEAKED and elongation > 1.3
    if two_peaked and patch and minor > LEAST_WIDE**2 and elongation < LONGEST_PATCH:
        # Squares seen at an angle are as flat as two touching discs, but have no waist.
        two_peaked = find_waist(grey, weight, x, y, most, (cosine, sine), start, np.sqrt(major)) < WAIST
    return elongation, two_peaked, (x0, y0), (xx, xy, yy)
