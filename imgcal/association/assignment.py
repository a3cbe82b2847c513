"""One-to-one pairing of fiducials with blobs."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from imgcal.medians import median
from renderers.compiling import njit


@njit(cache=True)
def mutual_nearest(places, blobs, reach, labels):
    """Pair places with blobs that are mutually nearest.

    Args:
        places: (N, 2) pixels.
        blobs: (M, 2) pixels, from left to right.
        reach: pixels; only closer pairs are made.
        labels: (N,), filled with the blob of each place, -1 = none.
    """
    back, nearest = np.empty(len(blobs), np.int64), np.empty(len(blobs))
    for m in range(len(blobs)):
        back[m], nearest[m] = -1, np.inf
    for n in range(len(places)):
        labels[n], least = -1, np.inf
        for m in range(first_beyond(blobs, places[n, 0] - reach), len(blobs)):
            u, v = blobs[m, 0] - places[n, 0], blobs[m, 1] - places[n, 1]
            if u > reach:
                break
            squared = u * u + v * v
            if squared < least:
                labels[n], least = m, squared
            if squared < nearest[m]:
                back[m], nearest[m] = n, squared
    for n in range(len(places)):
        m = labels[n]
        if m >= 0 and (back[m] != n or nearest[m] >= reach * reach):
            labels[n] = -1


@njit(cache=True)
def first_beyond(blobs, u):
    """Index of the first of M blobs (M, 2), given from left to right, that is not left of `u`; M = all are."""
    low, high = 0, len(blobs)
    while low < high:
        middle = (low + high) // 2
        if blobs[middle, 0] < u:
            low = middle + 1
        else:
            high = middle
    return low


def spacing(places: NDArray[np.float64]) -> float:
    """Median distance (px) from a fiducial's image to the nearest other one in its camera; places (C, N, 2)."""
    return median(distances_to_nearest(np.ascontiguousarray(places)))


@njit(cache=True)
def distances_to_nearest(places):
    """Distance (px) from each place (C, N, 2) to the nearest other one in the same camera: (C, N)."""
    gaps = np.empty(places.shape[:2])
    gaps[:] = np.inf
    for c in range(len(places)):
        for i in range(places.shape[1]):
            for j in range(i):
                u, v = places[c, i, 0] - places[c, j, 0], places[c, i, 1] - places[c, j, 1]
                squared = u * u + v * v
                gaps[c, i], gaps[c, j] = min(gaps[c, i], squared), min(gaps[c, j], squared)
    return np.sqrt(gaps)


def assign(cost: NDArray[np.floating], gate: float) -> NDArray[np.int64]:
    """Pair fiducials and blobs at the lowest total cost; leaving a fiducial out costs `gate`.

    Args:
        cost: (*B, N, M).
        gate: cost of no pair.

    Returns:
        (*B, N) blob of each fiducial, -1 = none.
    """
    batch, (fiducials, blobs) = cost.shape[:-2], cost.shape[-2:]
    flat = cost.reshape(-1, fiducials, blobs)
    labels = np.full(flat.shape[:2], -1, dtype=np.int64)
    # If all cheapest blobs differ, they are the optimum. Only the rest needs the full search.
    for b in np.flatnonzero(_assign_cheapest(flat, gate, labels)):
        possible = flat[b] < gate
        rows, columns = np.flatnonzero(possible.any(1)), np.flatnonzero(possible.any(0))
        part = np.minimum(flat[b][np.ix_(rows, columns)], gate)
        i, j = linear_sum_assignment(part)
        made = part[i, j] < gate
        labels[b] = -1
        labels[b, rows[i[made]]] = columns[j[made]]
    return labels.reshape(*batch, fiducials)


@njit(cache=True)
def _assign_cheapest(cost, gate, labels):
    """Give each fiducial its cheapest blob, and return where two would share one: (B,)."""
    contested, taken = np.empty(len(cost), np.bool_), np.empty(cost.shape[2], np.bool_)
    for b in range(len(cost)):
        contested[b], taken[:] = False, False
        for n in range(cost.shape[1]):
            least = gate
            for m in range(cost.shape[2]):
                if cost[b, n, m] < least:
                    least, labels[b, n] = cost[b, n, m], m
            if labels[b, n] >= 0:
                contested[b] |= taken[labels[b, n]]
                taken[labels[b, n]] = True
    return contested
