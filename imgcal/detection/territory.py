"""Compiled territories: the pixels of a window that belong to a blob because they are not nearer to others."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.detection.candidates import BLOCK
from renderers.compiling import njit

SKIRT = 3.5  # px, how far the blurred edge reaches beyond the detected component
SPREAD = 5  # px, up to which distances are exact
MARGIN = SPREAD + 1  # px around the area: distances are also needed in the adjacent pixels
_FAR = 200  # px^2; fits into 8 bit even with two distances added


@njit(cache=True, nogil=True, heavy=True)
def spread_labels(tile, labels, first, name, scratch, own, other):
    """Compute squared distances (px^2) to the component `name` and to others; return whether there are others."""
    rows, columns = own.shape
    own[:] = _FAR
    other[:] = _FAR
    crowded = False
    # The first tile is an empty one before the frame.
    for r in range(max(first[0] // BLOCK, -1) + 1, min((first[0] + rows - 1) // BLOCK + 2, tile.shape[0] - 1)):
        for c in range(max(first[1] // BLOCK, -1) + 1, min((first[1] + columns - 1) // BLOCK + 2, tile.shape[1] - 1)):
            t = tile[r, c]
            if t == 0:
                continue
            top, left = (r - 1) * BLOCK - first[0], (c - 1) * BLOCK - first[1]
            for y in range(max(-top, 0), min(BLOCK, rows - top)):
                for x in range(max(-left, 0), min(BLOCK, columns - left)):
                    if labels[t, y, x] == name:
                        own[top + y, left + x] = 0
                    elif labels[t, y, x] > 0:
                        other[top + y, left + x] = 0
                        crowded = True
    _spread(own, scratch)
    if crowded:
        _spread(other, scratch)
    return crowded


@njit(cache=True, nogil=True, heavy=True)
def _spread(squared, scratch):
    """Convert 0 and `_FAR` to squared distances from the zeros, up to `SPREAD` px along each axis.

    Rows are treated as one line: what wraps from one row to the next does not get past the margin.
    """
    flat, along = squared.reshape(-1), scratch.reshape(-1)
    _lower(flat, along, np.int64(1))
    _lower(along, flat, squared.shape[1])


@njit(cache=True, nogil=True, heavy=True)
def _lower(values, result, stride):
    """Compute the minimum over d of d ** 2 plus the values at distance `d * stride`."""
    for p in range(len(values)):
        result[p] = values[p]
    for d in range(1, SPREAD + 1):
        gap = d * stride
        left, right, middle = values[: -2 * gap], values[2 * gap :], result[gap:-gap]
        for p in range(len(middle)):
            middle[p] = min(middle[p], np.uint8(min(left[p], right[p]) + d * d))


@njit(cache=True, nogil=True, heavy=True)
def claim(own, other, crowded, smooth, territory):
    """Set pixels of the area to 1 if they are within a blob's skirt and not nearer to others; all others to 0.

    Pixels at equal distance form the border of both blobs.

    Returns:
        The brightest border with a neighbour, 0 without a neighbour.
    """
    rows, columns = own.shape
    territory[:] = 0
    limit = np.uint8(SKIRT * SKIRT)
    for i in range(MARGIN, rows - MARGIN):
        to, near, far = territory[i], own[i], other[i]
        for j in range(MARGIN, columns - MARGIN):
            to[j] = np.float32(near[j] <= limit and near[j] <= far[j])
    saddle = np.float32(0)
    if not crowded:
        return saddle
    for i in range(MARGIN, rows - MARGIN):
        for j in range(MARGIN, columns - MARGIN):
            if territory[i, j] > 0 and smooth[i, j] > saddle:
                for y in range(i - 1, i + 2):
                    for x in range(j - 1, j + 2):
                        if other[y, x] <= own[y, x]:
                            saddle = max(saddle, smooth[i, j])
    return saddle
