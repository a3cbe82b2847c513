"""Known distances between lights: `known_distances`.

A stick, or one of several objects, is a set of lights whose distances are known. Each such fact is a row of the
equations: a sum of light positions, with coefficients whose sum is zero, has a known length. Two markers give their
distance. A marker on the line, in the plane, or in the space of others is an affine combination of these: the
difference from it has length zero, which is three numbers. So n markers in view give 3 n - 5 numbers on a line, and
3 n - 6 otherwise, all but those of a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TERMS = 5
"""Most lights in a row: one, and four that span space."""
DISTANCE_SIGMA = 1e-5
"""Standard deviation of a known length, relative to the object's size: small beside the error of any light's place."""
LEAST_EXTENT = 1e-3
"""Least distance of a marker from the line or plane of others, relative to the object's size; nearer ones lie in it."""


@dataclass(frozen=True)
class KnownDistances:
    """R rows for each of S snapshots; unused ones have only zeros."""

    column: NDArray[np.int64]  # (S, R, TERMS) lights
    coefficient: Array  # (S, R, TERMS) 1/mm, of their positions
    length: Array  # (S, R) of the sum, in standard deviations; 0 = the sum vanishes
    numbers: int = 0  # known by all rows together

    @classmethod
    def none(cls, snapshots: int) -> KnownDistances:
        """No row for any snapshot."""
        nothing = np.zeros((snapshots, 0, TERMS))
        return cls(nothing.astype(np.int64), nothing, np.zeros((snapshots, 0)))

    @property
    def arrays(self) -> tuple[NDArray[np.int64], Array, Array]:
        """For compiled loops."""
        return self.column, self.coefficient, self.length


def known_distances(
    parts: Sequence[tuple[int, Array]], number: NDArray[np.int64], used: NDArray[np.bool_]
) -> KnownDistances:
    """List what is known of the distances between the lights of some snapshots.

    Args:
        parts: first number, and markers (n, 3) mm, of each known object.
        number: (S, M) number of the light in each column.
        used: (S, M) whether the column has a light.
    """
    if not parts:
        return KnownDistances.none(len(number))
    every = []
    for named, there in zip(number, used, strict=True):
        rows = list[tuple[NDArray[np.int64], Array, float]]()
        for first, points in parts:
            column = np.flatnonzero(there & (named >= first) & (named < first + len(points)))
            unit = DISTANCE_SIGMA * float(np.linalg.norm(np.ptp(points, axis=0)))
            seen = points[named[column] - first]
            rows += [(column[which], by / unit, length / unit) for which, by, length in shape_rows(seen)]
        every.append(rows)
    found = KnownDistances.none(len(number))
    most = max(map(len, every))
    column = np.zeros((len(number), most, TERMS), dtype=np.int64)
    coefficient, length = np.zeros((len(number), most, TERMS)), np.zeros((len(number), most))
    numbers = 0
    for s, rows in enumerate(every):
        for r, (which, by, apart) in enumerate(rows):
            column[s, r, : len(which)], coefficient[s, r, : len(which)], length[s, r] = which, by, apart
            numbers += 1 if apart > 0 else 3
    return KnownDistances(column, coefficient, length, numbers) if most else found


def shape_rows(points: Array) -> list[tuple[NDArray[np.int64], Array, float]]:
    """Describe the shape of some points (n, 3) by rows: indices, coefficients, and the length of the sum.

    Examples:
        >>> rows = shape_rows(np.array([[0.0, 0, 0], [200.0, 0, 0], [500.0, 0, 0]]))
        >>> [(which.tolist(), by.round(6).tolist(), length) for which, by, length in rows]
        [([0, 2], [1.0, -1.0], 500.0), ([1, 0, 2], [-1.0, 0.6, 0.4], 0.0)]
    """
    if len(points) < 2:
        return []
    frame = _frame(points)
    rows = [
        (np.array(pair), np.array((1.0, -1.0)), float(np.linalg.norm(points[pair[0]] - points[pair[1]])))
        for pair in combinations(frame, 2)
    ]
    span = np.concatenate((points[frame].T, np.ones((1, len(frame)))))
    for other in sorted(set(range(len(points))) - set(frame)):
        share = np.linalg.lstsq(span, np.append(points[other], 1.0), rcond=None)[0]
        rows.append((np.array([other, *frame]), np.array([-1.0, *share]), 0.0))
    return rows


def _frame(points: Array) -> list[int]:
    """Two to four points, far from each other, that span the line, plane or space of all."""
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    first, second = np.unravel_index(int(apart.argmax()), apart.shape)
    frame, size = [int(first), int(second)], float(apart.max())
    while len(frame) < min(4, len(points)):
        away = points - points[frame[0]]
        basis = np.linalg.qr(away[frame[1:]].T)[0]
        height = np.linalg.norm(away - away @ basis @ basis.T, axis=1)
        if height.max() < LEAST_EXTENT * size:
            break
        frame.append(int(height.argmax()))
    return frame
