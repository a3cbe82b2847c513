"""Compiled fit of all markers of a camera: alternates between their common shape and their positions."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.matching.marker_fit import fit_markers
from imgcal.matching.marker_shape import RINGS, common_shape, median
from renderers.compiling import njit

USUAL_MISFIT = 0.1  # RMS relative to the amplitude: smallest shape difference to expect between whole markers
LEAST_HALF = 4  # px, of a window


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def cut(grey, uv, scale, half, patches):
    """Fill windows (K, P, P) centred at places (K, 2), resampled to the markers' scales."""
    height, width = grey.shape
    left, right = np.empty(2 * half + 1, np.int64), np.empty(2 * half + 1, np.float32)
    for k in range(len(uv)):
        for j in range(2 * half + 1):
            u = min(max(uv[k, 0] + scale[k] * (j - half), 0.0), width - 1.0)
            left[j] = min(int(u), width - 2)
            right[j] = u - left[j]
        for i in range(2 * half + 1):
            v = min(max(uv[k, 1] + scale[k] * (i - half), 0.0), height - 1.0)
            top = min(int(v), height - 2)
            down = np.float32(v - top)
            for j in range(2 * half + 1):
                u = left[j]
                upper = grey[top, u] + right[j] * (grey[top, u + 1] - grey[top, u])
                lower = grey[top + 1, u] + right[j] * (grey[top + 1, u + 1] - grey[top + 1, u])
                patches[k, i, j] = upper + down * (lower - upper)


@njit(cache=True, nogil=True, heavy=True)
def fit_camera(grey, start, inside, sure, scale, half, iterations, uv, found, misfit):
    """Fit the markers (N) of one camera.

    Args:
        grey: (H, W) grey values, markers bright, at least two rows and columns.
        start: (N, 2) pixels, expected positions.
        inside: (N,) whether each is in the image; at least one.
        sure: (N,) the markers that define the common shape.
        scale: (N,) size of each marker relative to the usual one.
        half: px, half size of the first windows.
        iterations: (P,) iterations on the positions in each pass; a pass estimates the shape, then the positions.
        uv: (N, 2) output: positions.
        found: (N, 5) zeros; outputs of `fit_markers`.
        misfit: (N,) output: RMS difference from the common shape beyond noise, relative to the amplitude.

    Returns:
        Radius (px) of the disc with the shape's area; 0 = no markers.
    """
    count, side = len(start), 2 * half + 1
    place, sure = start.copy(), sure & inside
    whitening, profile = np.empty((2, 2)), np.empty(side + 2)
    close, some = np.zeros((count, count), np.bool_), np.empty(count)
    radius = 0.0
    for number in range(len(iterations)):
        chosen = np.flatnonzero(sure if sure.any() else inside)
        patches = np.empty((len(chosen), 2 * half + 1, 2 * half + 1), np.float32)
        cut(grey, place[chosen], scale[chosen], half, patches)
        values, longer = common_shape(patches, whitening, profile)
        if values == 0:
            return 0.0
        reach = min(max(int(np.ceil((values - 1) * RINGS * longer)), LEAST_HALF), half)
        window = int(np.ceil(reach * scale.max()))
        for n in range(count):
            for m in range(count):
                apart = max(abs(place[n, 0] - place[m, 0]), abs(place[n, 1] - place[m, 1]))
                close[n, m] = n != m and inside[n] and inside[m] and apart < 2 * window
        uv[:] = place
        shape, last = (whitening, profile[:values]), number == len(iterations) - 1
        fit_markers(grey, inside, window, scale, close, shape, iterations[number], last, uv, found)
        for n in range(count):
            misfit[n] = np.sqrt(max(found[n, 3] - 1.5 * found[n, 4], 0.0)) / max(found[n, 0], 1e-9)
        for k in range(len(chosen)):
            some[k] = misfit[chosen[k]]
        # Markers that look like most others define the shape of a whole marker better.
        usual = max(USUAL_MISFIT, median(some, len(chosen)))
        for n in range(count):
            sure[n] = sure[n] and misfit[n] <= usual
            if np.hypot(uv[n, 0] - start[n, 0], uv[n, 1] - start[n, 1]) < half:
                place[n] = uv[n]
        total = 0.0
        for ring in range(values):
            total += profile[ring] * ring
        stretch = whitening[0, 0] * whitening[1, 1] - whitening[0, 1] * whitening[1, 0]
        radius = RINGS * np.sqrt(2 * total / stretch)
        half = min(half, reach + LEAST_HALF)
    return radius
