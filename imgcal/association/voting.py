"""The whole rig votes: count the blobs that a pose explains if each camera's image may be shifted as a whole.

Drift of a few percent moves a camera's pattern by tens of pixels but deforms it only by a few. The shift is therefore
free within the prior's bounds, and nothing else is.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.association.assignment import first_beyond, mutual_nearest
from imgcal.association.blobs import PaddedBlobs
from imgcal.association.hypotheses import Poses
from imgcal.types import CameraRig
from renderers.compiling import njit

MOST_BINS = 200  # across a camera's range of shifts; the tolerance grows if it needs more


@dataclass(frozen=True)
class Votes:
    """Number of explained fiducials of K poses, and the shift of each camera's image."""

    count: NDArray[np.int64]  # (K, C)
    shift: NDArray[np.float64]  # (K, C, 2) pixels, blob minus prediction


def predict_ideal(rig: CameraRig, points: NDArray[np.float64], poses: Poses) -> NDArray[np.float64]:
    """Project fiducials (N, 3) without distortion, from the principal point: (K, C, N, 2) px, -1e7 behind a camera."""
    transform = rig.cam_from_rig
    focal = rig.focal_length.numpy().mean(-1)
    uv = np.full((len(poses.rotation), rig.num_cameras, len(points), 2), -1e7)
    given = (
        transform.rotation.numpy(),
        transform.translation.numpy(),
        focal,
        points,
        poses.rotation,
        poses.translation,
    )
    _predict(*map(np.ascontiguousarray, given), uv)  # type: ignore[call-arg]
    return uv


@njit(cache=True)
def _predict(rotation, translation, focal, points, turn, offset, uv):
    for k in range(len(turn)):
        turned = turn[k]
        for n in range(len(points)):
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            x = turned[0, 0] * px + turned[0, 1] * py + turned[0, 2] * pz + offset[k, 0]
            y = turned[1, 0] * px + turned[1, 1] * py + turned[1, 2] * pz + offset[k, 1]
            z = turned[2, 0] * px + turned[2, 1] * py + turned[2, 2] * pz + offset[k, 2]
            for c in range(len(rotation)):
                r, t = rotation[c], translation[c]
                depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
                if depth > 1:
                    uv[k, c, n, 0] = focal[c] * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) / depth
                    uv[k, c, n, 1] = focal[c] * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) / depth


def vote(blobs: PaddedBlobs, predicted: NDArray[np.float64], tolerance: float, gate: float) -> Votes:
    """Find each camera's most frequent shift.

    Args:
        blobs: the snapshot.
        predicted: (K, C, N, 2) from `predict_ideal`.
        tolerance: pixels, error of a fiducial within the pattern.
        gate: pixels, maximum shift.

    Returns:
        The votes; counts are limited to N.
    """
    width = max(tolerance, 2 * gate / MOST_BINS)
    count = np.zeros(predicted.shape[:2], dtype=np.int64)
    shift = np.zeros((*predicted.shape[:2], 2))
    bins = math.ceil(2 * gate / width)
    # Every vote counts in two by two overlapping windows, so that no border splits a peak.
    windows = np.zeros((bins + 1, bins + 1), dtype=np.int32)
    _vote(predicted, blobs.ideal, blobs.count, width, gate, windows, count, shift)
    return Votes(count, shift)


@njit(cache=True)
def _vote(predicted, ideal, number, width, gate, windows, count, shift):
    for k in range(len(predicted)):
        _vote_one(predicted[k], ideal, number, width, gate, windows, count[k], shift[k])


@njit(cache=True)
def _vote_one(predicted, ideal, number, width, gate, windows, count, shift):
    """Find the fullest window of each camera, the first of equals row by row; `windows` are zero before and after."""
    fiducials = predicted.shape[1]
    for c in range(len(predicted)):
        most, best_i, best_j = 0, 0, 0
        if 4 * fiducials * number[c] > windows.size:
            most, best_i, best_j = _fullest_window_of_many(windows, predicted[c], ideal[c], number[c], width, gate)
            count[c] = min(most, fiducials)
            shift[c, 0], shift[c, 1] = best_i * width - gate, best_j * width - gate
            continue
        for n in range(fiducials):
            for m in range(number[c]):
                u, v = ideal[c, m, 0] - predicted[c, n, 0] + gate, ideal[c, m, 1] - predicted[c, n, 1] + gate
                if u >= 0 and v >= 0 and u < 2 * gate and v < 2 * gate:
                    i, j = int(u / width), int(v / width)
                    for a in range(i, i + 2):
                        for b in range(j, j + 2):
                            votes = windows[a, b] + 1
                            windows[a, b] = votes
                            if votes > most or (votes == most and (a < best_i or (a == best_i and b < best_j))):
                                most, best_i, best_j = votes, a, b
        count[c] = min(most, fiducials)
        shift[c, 0], shift[c, 1] = best_i * width - gate, best_j * width - gate
        for n in range(fiducials):
            for m in range(number[c]):
                u, v = ideal[c, m, 0] - predicted[c, n, 0] + gate, ideal[c, m, 1] - predicted[c, n, 1] + gate
                if u >= 0 and v >= 0 and u < 2 * gate and v < 2 * gate:
                    i, j = int(u / width), int(v / width)
                    windows[i, j] = windows[i + 1, j] = windows[i, j + 1] = windows[i + 1, j + 1] = 0


@njit(cache=True)
def _fullest_window_of_many(windows, predicted, ideal, number, width, gate):
    """Do the same for one camera with more votes than windows: count each vote once, and then add the neighbours.

    Returns:
        Votes of the fullest window, its row and its column.
    """
    for n in range(len(predicted)):
        for m in range(number):
            u, v = ideal[m, 0] - predicted[n, 0] + gate, ideal[m, 1] - predicted[n, 1] + gate
            if u >= 0 and v >= 0 and u < 2 * gate and v < 2 * gate:
                windows[int(u / width), int(v / width)] += 1
    most, best_i, best_j = 0, 0, 0
    for i in range(len(windows) - 1, -1, -1):
        for j in range(windows.shape[1] - 1, -1, -1):
            votes = windows[i, j]
            if i > 0:
                votes += windows[i - 1, j]
            if j > 0:
                votes += windows[i, j - 1]
            if i > 0 and j > 0:
                votes += windows[i - 1, j - 1]
            windows[i, j] = 0
            if votes >= most:
                most, best_i, best_j = votes, i, j
    return most, best_i, best_j


def match(
    blobs: PaddedBlobs, predicted: NDArray[np.float64], shift: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """Pair fiducials with blobs under given shifts, and refine these.

    Args:
        blobs: the snapshot.
        predicted: (K, C, N, 2).
        shift: (K, C, 2).
        tolerance: pixels.

    Returns:
        (K, C, N) blob of each fiducial, -1 = none.
    """
    labels = np.empty(predicted.shape[:3], dtype=np.int64)
    shifts = np.asarray(shift, dtype=np.float64)
    _match(predicted, *blobs.left_to_right, blobs.count, shifts, tolerance, labels)
    return labels


@njit(cache=True)
def _match(predicted, ideal, order, number, shifts, tolerance, labels):
    for k in range(len(predicted)):
        for c in range(len(number)):
            blobs, places, shift = ideal[c, : number[c]], predicted[k, c].copy(), shifts[k, c].copy()
            for reach in (1.5, 1.2):
                shift += _mean_residual(predicted[k, c], blobs, shift, reach * tolerance)
            places += shift
            mutual_nearest(places, blobs, tolerance, labels[k, c])
            for n in range(len(places)):
                if labels[k, c, n] >= 0:
                    labels[k, c, n] = order[c, labels[k, c, n]]


@njit(cache=True)
def _mean_residual(places, blobs, shift, reach):
    """Mean residual to the nearest blobs, given from left to right, weighted by nearness: (2,)."""
    total, step, reach_squared = 0.0, np.zeros(2), reach**2
    for n in range(len(places)):
        least, nearest_u, nearest_v = reach_squared, 0.0, 0.0
        for m in range(first_beyond(blobs, places[n, 0] + shift[0] - reach), len(blobs)):
            u, v = blobs[m, 0] - places[n, 0] - shift[0], blobs[m, 1] - places[n, 1] - shift[1]
            if u > reach:
                break
            squared = u * u + v * v
            if squared < least:
                least, nearest_u, nearest_v = squared, u, v
        weight = 1 - least / reach_squared
        total += weight
        step[0] += weight * nearest_u
        step[1] += weight * nearest_v
    return step / max(total, 1e-6)
