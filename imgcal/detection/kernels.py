"""Compiled measurement of blobs in their windows: background, territory, weights, moments.

Scratch arrays hold the part of the window that the blob may reach, its *area*, from row and column `MARGIN` on, and the
pixels around it. Loops start at constant bounds, because otherwise they are not vectorized. The tests implement the
same in plain NumPy.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.detection.fitting import BAND, FARTHEST, MOST, PARAMETERS, ROWS, fit_centre, start_ellipse
from imgcal.detection.moments import find_centroid, find_ramp, find_shape
from imgcal.detection.territory import MARGIN, SKIRT, claim, spread_labels
from imgcal.geometry import kernels
from imgcal.types import BlobFlag
from renderers.compiling import njit

HALF_SIZES = (7, 10, 14, 20, 29, 42, 60)  # px; windows of 2 h + 1
REACH = 4  # px from a component to the border of its window: the skirt and a ring beyond it
RING = 2  # px, width of the border of a window from which the background is estimated
CLIP = (4.0, 9.0)  # standard deviations of a 3 x 3 mean below which a pixel is background: weak blob, bright blob
CLIP_PEAK = 0.1  # of the peak: the threshold between these two limits
SIGNIFICANT = 6.0  # standard deviations of a 3 x 3 mean that the brightest one of a blob must reach
MISFIT = 0.05  # of the peak, beyond the noise: largest RMS residual of an ellipse; above, the centroid is used
CROWDED = 0.6  # of the peak: two blobs count as merged if the border between them is this bright
CROWDED_CLIPPED = 0.9  # the same between clipped peaks that were split, because their light adds up there
# A neighbour's light shifts the centre of a clipped blob by this times the radius, times the border's brightness over
# the peak to the power 1.5. From simulations of bright lamps with halos.
SHARED = 0.1
SMALLEST_SIGMA = 0.0005  # px, remaining error of pixel sampling without noise
# px * sqrt(px): position error, times sqrt(radius), where clipping turns a soft edge into a step; the worst case of the
# exposures (2 to 15 times full scale) in the tests.
CLIPPED_SIGMA = 0.045
CLIPPED_FIT = 0.01  # the same where a fit leaves out clipped pixels
_MERGED, _SATURATED, _BORDER = int(BlobFlag.MERGED), int(BlobFlag.SATURATED), int(BlobFlag.BORDER)


@njit(cache=True, nogil=True)
def measure_all(frame, candidates, levels, limits, blobs):
    """Measure all candidates of a frame.

    Args:
        frame: (H, W) grey values.
        candidates: tile, labels, boxes, label and whole of `Candidates`.
        levels: largest grey value, the same for dark blobs or -1 for bright ones, and the level of saturation.
        limits: smallest peak, smallest and largest radius, largest elongation.
        blobs: outputs: the columns of `Blobs` except the camera, and whether each candidate is kept.
    """
    tile, labels, boxes, label, whole = candidates
    full_scale, invert, saturation = levels
    uv, sigma, radius, contrast, flags, blur, kept = blobs
    widest = 0
    for k in range(len(boxes)):
        widest = max(widest, half_size(boxes[k], whole[k]))
    side = 2 * widest + 1 + 2 * MARGIN
    scratch, ring = np.empty((4, side * side), np.float32), np.empty((4, 4 * RING * side), np.float32)
    fit = np.empty((ROWS, MOST), np.float32)
    distances, offsets = np.empty((3, side * side), np.uint8), np.empty((2, side * side), np.float32)
    least, smallest, largest, longest = limits
    for k in range(len(boxes)):
        u, v = (boxes[k, 0] + boxes[k, 2]) // 2, (boxes[k, 1] + boxes[k, 3]) // 2
        half = half_size(boxes[k], whole[k])
        noise, slope, plane = _background(frame, u, v, half, invert, ring)
        first, rows, columns = _area(frame, boxes[k], u, v, half)
        shape, pixels = (rows, columns), rows * columns  # contiguous arrays: only these are vectorized
        grey, smooth = scratch[0, :pixels].reshape(shape), scratch[1, :pixels].reshape(shape)
        weight, ramp = scratch[2, :pixels].reshape(shape), scratch[3, :pixels].reshape(shape)
        own, other = distances[0, :pixels].reshape(shape), distances[1, :pixels].reshape(shape)
        brightest = _copy(frame, first, u, v, invert, plane, grey, offsets)
        _blur(grey, smooth)
        spare = distances[2, :pixels].reshape(shape)
        crowded = spread_labels(tile, labels, first, label[k], spare, own, other)
        saddle = claim(own, other, crowded, smooth, weight)
        scale = _weigh(smooth, noise, weight)
        peak, peak_mean, brightness = _find_peaks(grey, smooth, weight)
        radius[k], contrast[k] = np.sqrt(brightness / peak / np.pi), peak / full_scale
        stands_out = peak >= least and peak_mean > SIGNIFICANT / 3 * noise
        if not (stands_out and smallest <= radius[k] <= largest):
            continue
        x, y = offsets[0, :pixels], offsets[1, :pixels]
        # The component of a flat patch covers all of it.
        patch = (boxes[k, 2] - boxes[k, 0] + 1) * (boxes[k, 3] - boxes[k, 1] + 1) > brightness / peak
        elongation, two_peaked, middle, moments = find_shape(grey, weight, x, y, float(peak_mean) / 2, patch)
        kept[k] = elongation <= longest
        if not kept[k]:
            continue
        clipped = brightest >= saturation and _is_saturated(frame, first, invert, saturation, weight)
        shared = min(saddle / peak_mean, 1.0)  # light at the border with neighbours
        merged = two_peaked or shared > (CROWDED_CLIPPED if clipped and _differ(boxes[k], whole[k]) else CROWDED)
        flags[k] = clipped * _SATURATED + merged * _MERGED + _is_at_border(boxes[k], frame) * _BORDER
        known = x0 = y0 = residual = 0.0
        if not flags[k] & _MERGED:
            start = start_ellipse(peak, radius[k], clipped, moments, middle)
            count = _gather(grey, x, y, own, other, spare, plane, saturation if clipped else 1e9, start, fit)
            if count > PARAMETERS:
                x0, y0, known, residual, blur[k] = fit_centre(fit, count, start, clipped, noise)
        fits = known * radius[k] ** 2 > max(noise**2, residual) and residual - noise**2 < (MISFIT * peak) ** 2
        if fits and (x0 - middle[0]) ** 2 + (y0 - middle[1]) ** 2 < FARTHEST**2:
            variance = max(noise**2, residual) / known + (slope * brightness / known) ** 2
            variance += clipped * CLIPPED_FIT**2 / max(radius[k], 1.0)
        else:
            find_ramp(grey, weight, scale, ramp)
            x0, y0, lever, tilt = find_centroid(grey, weight, ramp, x, y)
            # Each pixel's noise moves the centroid by its lever arm over the brightness; mean of both axes.
            variance = (noise**2 * lever / 2 + (slope * tilt / 2) ** 2) / brightness**2
            variance += clipped * CLIPPED_SIGMA**2 / max(radius[k], 1.0)
        variance += clipped * shared**3 * (SHARED * radius[k]) ** 2
        uv[k, 0], uv[k, 1], sigma[k] = u + x0, v + y0, np.sqrt(variance + SMALLEST_SIGMA**2)


@njit(cache=True, nogil=True)
def half_size(box, whole):
    """Half size of the smallest window around a box that holds the whole component before it was split.

    The background is only outside of that.
    """
    u, v = (box[0] + box[2]) // 2, (box[1] + box[3]) // 2
    reach = max(whole[2] - u, u - whole[0], whole[3] - v, v - whole[1]) + REACH
    for half in HALF_SIZES:
        if half >= reach:
            return half
    return HALF_SIZES[-1]


@njit(cache=True, nogil=True)
def _differ(box, whole):
    """Check whether a component is part of a larger one."""
    return box[0] != whole[0] or box[1] != whole[1] or box[2] != whole[2] or box[3] != whole[3]


@njit(cache=True, nogil=True)
def _is_at_border(box, frame):
    """Check whether a box comes within a pixel of the frame's border."""
    return min(box[0], box[1]) <= 1 or box[2] >= frame.shape[1] - 2 or box[3] >= frame.shape[0] - 2


@njit(cache=True, nogil=True)
def _area(frame, box, u, v, half):
    """First pixel (v, u), rows and columns of the scratch arrays.

    The skirt of a component may reach the pixels around its box that are in the frame and not in the window's ring.
    """
    reach, inner = int(SKIRT), half - RING
    left, right = max(box[0] - reach, u - inner, 0), min(box[2] + reach, u + inner, frame.shape[1] - 1)
    top, bottom = max(box[1] - reach, v - inner, 0), min(box[3] + reach, v + inner, frame.shape[0] - 1)
    return (top - MARGIN, left - MARGIN), bottom - top + 1 + 2 * MARGIN, right - left + 1 + 2 * MARGIN


@njit(cache=True, nogil=True, heavy=True)
def _grey(frame, v, u, invert):
    """Grey value of a pixel; for dark blobs it is subtracted from `invert` (-1 = bright).

    Beyond the border the last row or column is repeated.
    """
    value = np.float32(frame[min(max(v, 0), frame.shape[0] - 1), min(max(u, 0), frame.shape[1] - 1)])
    return np.float32(invert) - value if invert >= 0 else value


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _background(frame, u, v, half, invert, ring):
    """Fit a plane to the ring around a blob, robust to clutter there.

    Returns:
        Noise, the standard deviation of a pixel, at least that of rounding to grey levels; the standard deviation of
        the plane's slopes; the plane's value at the centre of the window, and its slopes.
    """
    count = 0
    for y in range(-half, half + 1):
        step = 1 if abs(y) > half - RING else 2 * half + 1 - RING
        for start in range(1 if step == 1 else RING):
            for x in range(start - half, half + 1, step):
                ring[0, count], ring[1, count], ring[2, count] = _grey(frame, v + y, u + x, invert), x, y
                ring[3, count] = ring[0, count]
                count += 1
    value, x, y = ring[0, :count], ring[1, :count], ring[2, :count]
    middle = kernels.select_rank(ring[3], count, count // 2)
    quarter = kernels.select_rank(ring[3], count // 2 + 1, count // 4)
    # The lower half gives the spread, because clutter in the ring is bright. One grey level allows for quantization.
    reach = 4 * (np.float32(1.4826) * (middle - quarter) + 1)
    n = sx = sy = sxx = sxy = syy = g = gx = gy = np.float64(0)
    for r in range(count):
        # Subtract the median: grey values of 16 bit then lose nothing in single precision.
        value[r] -= middle
        w = np.float32(1) if abs(value[r]) < reach else np.float32(0)
        n += w
        sx, sy = sx + w * x[r], sy + w * y[r]
        sxx, sxy, syy = sxx + w * x[r] * x[r], sxy + w * x[r] * y[r], syy + w * y[r] * y[r]
        g, gx, gy = g + w * value[r], gx + w * value[r] * x[r], gy + w * value[r] * y[r]
    c0, cx, cy = _solve(n + 1e-3, sx, sy, sxx + 1e-3, sxy, syy + 1e-3, g, gx, gy)
    squares = 0.0
    for r in range(count):
        residual = value[r] - c0 - cx * x[r] - cy * y[r]
        squares += residual * residual if abs(value[r]) < reach else 0.0
    noise = max(np.sqrt(squares / max(n - 3, 1.0)), 12**-0.5)
    return noise, noise / np.sqrt(max((sxx + syy) / 2, 1.0)), (middle + c0, cx, cy)


@njit(cache=True, nogil=True, fastmath=True)
def _solve(a, b, c, d, e, f, x, y, z):
    """Solve the symmetric system [[a, b, c], [b, d, e], [c, e, f]] by cofactors."""
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * aa + b * ab + c * ac
    return (aa * x + ab * y + ac * z) / det, (ab * x + bb * y + bc * z) / det, (ac * x + bc * y + cc * z) / det


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _copy(frame, first, u, v, invert, plane, grey, offsets):
    """Copy the area and its margin from a frame, subtract the background, and fill offsets from (u, v).

    Returns:
        The brightest pixel, background included.
    """
    rows, columns = grey.shape
    inside = first[1] >= 0 and first[1] + columns <= frame.shape[1]
    brightest = np.float32(-1)
    for i in range(rows):
        source = frame[min(max(first[0] + i, 0), frame.shape[0] - 1)]
        level = np.float32(plane[0] + plane[2] * (first[0] + i - v) + plane[1] * (first[1] - u))
        slope, row = np.float32(plane[1]), grey[i]
        for j in range(columns):
            value = np.float32(source[first[1] + j]) if inside else _grey(frame, first[0] + i, first[1] + j, -1)
            if invert >= 0:
                value = np.float32(invert) - value
            brightest = max(brightest, value)
            row[j] = value - level - slope * np.float32(j)
            offsets[0, i * columns + j], offsets[1, i * columns + j] = first[1] + j - u, first[0] + i - v
    return brightest


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _blur(values, means):
    """Average the 3 x 3 pixels around each pixel of the area and of the adjacent pixels."""
    rows, columns = values.shape
    for i in range(1, rows - 1):
        above, middle, below, mean = values[i - 1], values[i], values[i + 1], means[i]
        for j in range(1, columns - 1):
            outer = above[j - 1] + above[j] + above[j + 1] + below[j - 1] + below[j] + below[j + 1]
            mean[j] = (outer + middle[j - 1] + middle[j] + middle[j + 1]) * np.float32(1 / 9)


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _gather(grey, x, y, own, other, marks, plane, saturation, start, fit):
    """Collect the unsaturated pixels around the edge of a blob that belong to it, for `fit_centre`.

    Returns:
        Their number, 0 if there are too many; the last rows of `fit` are their offsets x, y and grey values.
    """
    (rows, columns), count = grey.shape, 0
    limit, inner = np.uint8(SKIRT * SKIRT), np.float32(max(start[1] - BAND, 0.0) ** 2 - 1)
    xx, xy, yy, x0, y0 = start[2:].astype(np.float32)
    value = grey.reshape(-1)
    near, far = own.reshape(-1), other.reshape(-1)
    most, level, tilt_x, tilt_y = (
        np.float32(saturation - 0.1), np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2]),
    )  # fmt: skip
    listed_x, listed_y, listed_value = fit[ROWS - 3], fit[ROWS - 2], fit[ROWS - 1]
    two, zero, one, flat = np.float32(2), np.uint8(0), np.uint8(1), marks.reshape(-1)
    for p in range(len(value)):  # treats all pixels alike, so that it is vectorized
        dx, dy = x[p] - x0, y[p] - y0
        outer = xx * dx * dx + two * xy * dx * dy + yy * dy * dy >= inner
        dim = level + tilt_x * x[p] + tilt_y * y[p] + value[p] < most
        flat[p] = one if (near[p] <= limit) & (near[p] <= far[p]) & outer & dim else zero
    for i in range(MARGIN, rows - MARGIN):
        for p in range(i * columns + MARGIN, (i + 1) * columns - MARGIN):
            listed_x[count], listed_y[count], listed_value[count] = x[p], y[p], value[p]
            count += int(flat[p])
        if count + columns > MOST:
            return 0
    return count


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _weigh(smooth, noise, weight):
    """Convert the territory in `weight` to weights of the blob's pixels, from 0 to 1 with increasing brightness.

    Returns:
        Slope of the weight over the 3 x 3 mean.
    """
    rows, columns = smooth.shape
    top = np.float32(0)
    for i in range(MARGIN, rows - MARGIN):
        part, mean = weight[i], smooth[i]
        for j in range(MARGIN, columns - MARGIN):
            top = max(top, mean[j] * part[j])
    scale = np.float32(1 / min(max(CLIP_PEAK * top, CLIP[0] / 3 * noise), CLIP[1] / 3 * noise))
    zero, one = np.float32(0), np.float32(1)
    for i in range(MARGIN, rows - MARGIN):
        part, mean = weight[i], smooth[i]
        for j in range(MARGIN, columns - MARGIN):
            part[j] *= min(max(mean[j] * scale - one, zero), one)
    return scale


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _find_peaks(grey, smooth, weight):
    """Brightest pixel and brightest 3 x 3 mean of the blob, and the sum of the blob."""
    peak, top, total = np.float32(1e-6), np.float32(0), np.float32(0)
    for i in range(MARGIN, grey.shape[0] - MARGIN):
        part, value, mean = weight[i], grey[i], smooth[i]
        for j in range(MARGIN, grey.shape[1] - MARGIN):
            inside = part[j] > np.float32(0.5)
            peak = max(peak, value[j] if inside else np.float32(0))
            top = max(top, mean[j] if inside else np.float32(0))
            total += part[j] * value[j]
    return peak, top, max(float(total), 1e-6)


@njit(cache=True, nogil=True)
def _is_saturated(frame, first, invert, saturation, weight):
    """Check whether a pixel of the blob is at or above saturation."""
    for i in range(MARGIN, weight.shape[0] - MARGIN):
        for j in range(MARGIN, weight.shape[1] - MARGIN):
            if weight[i, j] > 0.5 and _grey(frame, first[0] + i, first[1] + j, invert) >= saturation:
                return True
    return False
