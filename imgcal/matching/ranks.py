"""Compiled ranks: how rare values are within a map, by a histogram."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.matching.marker_shape import median
from renderers.compiling import njit

BINS = 4096
MOST = 9.0
"""Upper limit of surprise: a bright reflection is no better marker for its brightness."""
EVERY = 3  # step of rows and columns for the noise estimate


@njit(cache=True, nogil=True, error_model="numpy", heavy=True)
def raise_ranks(values, size, tries, ranks):
    """Raise ranks, where they are lower, to minus the logarithm of the share of values that are at least as large.

    Args:
        values: (H, W).
        size: (2,) width and height of the valid part.
        tries: number of maps that are searched; multiplies the share, as a correction for multiple testing.
        ranks: (H, W) from 0 to `MOST`; raised in place.
    """
    width, height = size
    low, high = values[0, 0], values[0, 0]
    for i in range(height):
        for j in range(width):
            low, high = min(low, values[i, j]), max(high, values[i, j])
    # The interesting values are few and large: bins are narrow at zero and wide far out. They follow a logarithm of
    # |x| + 1 that is linear between powers of two, like the bits of a float.
    one, ends = np.ones(1, np.float32), np.empty(2, np.float32)
    ends[0], ends[1] = abs(low) + np.float32(1), abs(high) + np.float32(1)
    zero, bits = one.view(np.int32)[0], ends.view(np.int32)
    first = bits[0] - zero if low > 0 else zero - bits[0]
    last = bits[1] - zero if high > 0 else zero - bits[1]
    if not last > first:
        return  # all values are the same, but for less than the rounding of |x| + 1
    scale = np.float32((BINS - 1) / (last - first))
    place, count = np.empty((height, width), np.int32), np.zeros(BINS, np.int64)
    row = np.empty(width, np.float32)
    for i in range(height):
        for j in range(width):
            row[j] = abs(values[i, j]) + np.float32(1)
        logarithm = row.view(np.int32)
        for j in range(width):
            squeezed = logarithm[j] - zero if values[i, j] > 0 else zero - logarithm[j]
            place[i, j] = np.int32(np.float32(squeezed - first) * scale)
        for j in range(width):
            count[place[i, j]] += 1
    table, above = np.zeros(BINS, np.float32), 0
    for k in range(BINS - 1, -1, -1):
        if count[k]:
            share = max(above + 0.5 * count[k], 0.5) * tries / (width * height)
            table[k] = min(-np.log(share), MOST)
            above += count[k]
    for i in range(height):
        for j in range(width):
            ranks[i, j] = max(ranks[i, j], table[place[i, j]])


@njit(cache=True, nogil=True, error_model="numpy", heavy=True)
def rank_spots(response, covered, size, ranks):
    """Normalize responses by their noise, and raise ranks to those of the largest response.

    Args:
        response: (sizes, H, W), valid as far as `size` tells; divided by the noise in place, 0 where covered.
        covered: (H, W) non-zero in excluded cells, or empty.
        size: (2,) width and height of the valid part.
        ranks: (H, W) zeros; filled.
    """
    width, height = size
    sample = np.empty(((height + EVERY - 1) // EVERY) * ((width + EVERY - 1) // EVERY), np.float32)
    for k in range(len(response)):
        values, number = response[k], 0
        for i in range(0, height, EVERY):
            for j in range(0, width, EVERY):
                sample[number] = abs(values[i, j])
                number += 1
        factor = np.float32(1 / max(1.4826 * median(sample, number), 1e-3))
        for i in range(height):
            for j in range(width):
                values[i, j] *= factor
        if covered.size:
            for i in range(height):
                for j in range(width):
                    if covered[i, j]:
                        values[i, j] = 0
        raise_ranks(values, size, len(response), ranks)


@njit(cache=True, nogil=True, error_model="numpy", heavy=True)
def average(frame, corner, factor, cells):
    """Fill cells (H, W) with the means of blocks of a frame; the first block starts at a column and row (2,)."""
    height, width = cells.shape
    left, top = corner
    sums = np.empty(width * factor, np.int32)
    scale = np.float32(1 / (factor * factor))
    for i in range(height):
        sums[:] = 0
        for k in range(factor):
            row = frame[top + i * factor + k, left : left + width * factor]
            for j in range(width * factor):
                sums[j] += row[j]
        for j in range(width):
            total = 0
            for k in range(factor):
                total += sums[j * factor + k]
            cells[i, j] = scale * total
