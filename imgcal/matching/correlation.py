"""Correlation of a point pattern with the maps of all cameras, each shifted to where it fits best."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.geometry import RigidTransform
from imgcal.matching.maps import Maps
from imgcal.types import CalibrationObject, CameraRig
from renderers.compiling import njit

HIDDEN = 0.3
"""Probability that a fiducial in view is not visible."""
EVEN = 0.25
"""Exponent of the distribution of ranks at markers; 1 would be the uniform one of the rest of the frame."""
BLIND = 0.1
"""Probability that a camera does not see the object at all."""


@dataclass(frozen=True)
class Scores:
    """Agreement of poses with the maps."""

    log_odds: NDArray[np.float64]  # (K, C) against no object
    shift: NDArray[np.float64]  # (K, C, 2) pixels, map minus prediction

    @property
    def total(self) -> NDArray[np.float64]:
        """Sum over all cameras: (K,)."""
        return self.log_odds.sum(1)

    def select(self, rows: NDArray[np.int64]) -> Scores:
        """Select poses."""
        return Scores(self.log_odds[rows], self.shift[rows])

    def __add__(self, other: Scores) -> Scores:
        return Scores(np.concatenate((self.log_odds, other.log_odds)), np.concatenate((self.shift, other.shift)))


def gains(maps: Maps) -> NDArray[np.float32]:
    """Log odds of each cell: surprise at a marker against the rest of the frame: (C, H, W)."""
    # Ranks of the frame are uniform in [0, 1]; those at markers have the density EVEN * rank^(EVEN - 1).
    log_odds = np.log(HIDDEN + (1 - HIDDEN) * EVEN * np.exp((1 - EVEN) * maps.surprise))
    return log_odds.astype(np.float32)


def gain_at(maps: Maps, gain: NDArray[np.float32], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum the log odds (C, H, W) of the cells at places (C, N, 2) pixels that are in the image: (C,)."""
    cells = np.floor(maps.cells(uv)).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < maps.size[:, None])).all(-1))
    cells = np.where(inside[..., None], cells, 0)
    return np.where(inside, gain[np.arange(len(cells))[:, None], cells[..., 1], cells[..., 0]], 0.0).sum(1)


def correlate(
    maps: Maps,
    gain: NDArray[np.float32],
    rig: CameraRig,
    obj: CalibrationObject,
    poses: RigidTransform,
    reach: NDArray[np.float64],
) -> Scores:
    """Score poses (K,), with each camera's map shifted by up to `reach` (C,) pixels."""
    points = poses.apply(obj.points.to(rig.focal_length))
    projection = rig.expand(len(points)).project_values(points, obj.radius)
    # Cells far outside of the image do not count; near its edge, the shift decides.
    cells = np.ascontiguousarray(maps.cells(projection.uv.numpy()))
    front = np.ascontiguousarray(projection.depth.numpy() > 1)
    score, shift = np.zeros(cells.shape[:2]), np.zeros((*cells.shape[:2], 2))
    steps = np.ceil(reach / maps.factor).astype(np.int64)
    most = int(steps.max(initial=0))
    window = np.zeros((2 * most + 1, 2 * most + 1), np.float32)
    _correlate(cells, front, gain, maps.size, steps, window, score, shift)
    return Scores(np.log(BLIND + (1 - BLIND) * np.exp(score)), shift * maps.factor)


@njit(cache=True, fastmath=True, error_model="numpy", heavy=True)
def _correlate(cells, front, gain, size, steps, window, score, shift):
    highest = np.empty(len(window), np.float32)
    for k in range(len(cells)):
        for c in range(cells.shape[1]):
            step, width, height = steps[c], size[c, 0], size[c, 1]
            side = 2 * step + 1
            for i in range(side):
                for j in range(side):
                    window[i, j] = 0
            for n in range(cells.shape[2]):
                if not front[k, c, n]:
                    continue
                left, top = int(np.floor(cells[k, c, n, 0])) - step, int(np.floor(cells[k, c, n, 1])) - step
                first, last = max(0, -left), min(side, width - left)
                for i in range(max(0, -top), min(side, height - top)):
                    # Separate slices: indices that are sums would need a sign check each.
                    total, more = window[i, first:last], gain[c, top + i, left + first : left + last]
                    for j in range(last - first):
                        total[j] += more[j]
            for i in range(side):
                row, high = window[i], window[i, 0]
                for j in range(side):
                    high = max(high, row[j])
                highest[i] = high
            at_i, at_j, most, odds = 0, 0, highest[0], 0.0
            for i in range(side):
                if highest[i] > most:
                    most, at_i = highest[i], i
            while window[at_i, at_j] < most:
                at_j += 1
            for i in range(side):
                if highest[i] > most - 12:
                    for j in range(side):
                        if window[i, j] > most - 12:
                            odds += np.exp(window[i, j] - most)
            # The shift is unknown, so average over all shifts.
            score[k, c] = most + np.log(odds / (side * side))
            shift[k, c, 0], shift[k, c, 1] = at_j - step, at_i - step
