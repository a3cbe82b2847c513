"""Known distances between lights: `known_distances`.

A stick, or one of several objects, is a set of lights whose distances are known. Each such fact is a row of the
equations: a sum of light positions, with coefficients whose sum is zero, has a known length. Two markers give their
distance. A marker on the line, in the plane, or in the space of others is an affine combination of these: the
difference from it has length zero, which is three numbers. So n markers in view give 3 n - 5 numbers on a line, and
3 n - 6 otherwise, all but those of a pose.

A marker slightly off a line or plane lies on a circle or between two mirror images. Lengths that say so have no
minimum that small steps could find if the circle is smaller than the error of a light's place. So such a marker has
lengths along the line or plane, and its offset is an error of unknown direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TERMS = 5
"""Most lights in a row: one, and four that span space."""
DISTANCE_SIGMA = 1e-5
"""Standard deviation of a known length, relative to the object's size: small beside the error of any light's place."""
LEAST_EXTENT = 1e-2
"""Least distance of a marker from the line or plane of others, relative to the object's size, for its side to count."""


@dataclass(frozen=True)
class KnownDistances:
    """R rows for each of S snapshots; unused ones have only zeros."""

    column: NDArray[np.int64]  # (S, R, TERMS) lights
    coefficient: Array  # (S, R, TERMS) 1/mm, of their positions
    length: Array  # (S, R) of the sum, in standard deviations; 0 = the sum vanishes
    numbers: int = 0  # known by all rows together

    @classmethod
    def empty(cls, snapshots: int) -> KnownDistances:
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
        return KnownDistances.empty(len(number))
    every = []
    for named, there in zip(number, used, strict=True):
        rows = list[ShapeRow]()
        for first, points in parts:
            column = np.flatnonzero(there & (named >= first) & (named < first + len(points)))
            sigma = DISTANCE_SIGMA * float(np.linalg.norm(np.ptp(points, axis=0)))
            shape = shape_rows(points[named[column] - first], sigma)
            rows += [replace(row, column=column[row.column]) for row in shape]
        every.append(rows)
    found = KnownDistances.empty(len(number))
    most = max(map(len, every))
    column = np.zeros((len(number), most, TERMS), dtype=np.int64)
    coefficient, length = np.zeros((len(number), most, TERMS)), np.zeros((len(number), most))
    for s, rows in enumerate(every):
        for r, row in enumerate(rows):
            terms = slice(len(row.column))
            column[s, r, terms], coefficient[s, r, terms], length[s, r] = row.column, row.coefficient, row.length
    numbers = sum(row.numbers for rows in every for row in rows)
    return KnownDistances(column, coefficient, length, numbers) if most else found


@dataclass(frozen=True)
class ShapeRow:
    """A fact about the shape of some points: a sum of theirs has a known length."""

    column: NDArray[np.int64]  # (T,) points in the sum
    coefficient: Array  # (T,) 1/mm
    length: float  # of the sum, in standard deviations
    numbers: int  # that the row fixes


def shape_rows(points: Array, sigma: float) -> list[ShapeRow]:
    """Describe the shape of some points (n, 3); `sigma`: of known lengths, mm.

    Examples:
        >>> rows = shape_rows(np.array([[0.0, 0, 0], [200.0, 0, 0], [500.0, 0, 0]]), 1.0)
        >>> [(row.column.tolist(), row.coefficient.round(6).tolist(), row.length) for row in rows]
        [([0, 2], [1.0, -1.0], 500.0), ([1, 0, 2], [-1.0, 0.6, 0.4], 0.0)]
    """
    if len(points) < 2:
        return []
    frame = _frame(points)

    def distance(one: int, other: int) -> ShapeRow:
        length = float(np.linalg.norm(points[one] - points[other])) / sigma
        return ShapeRow(np.array((one, other)), np.array((1.0, -1.0)) / sigma, length, 1)

    rows = [distance(one, other) for one, other in combinations(frame, 2)]
    edges = (points[frame[1:]] - points[frame[0]]).T
    for other in sorted(set(range(len(points))) - set(frame)):
        there = points[other] - points[frame[0]]
        share = np.linalg.lstsq(edges, there, rcond=None)[0]
        height, sides = float(np.linalg.norm(there - edges @ share)), 4 - len(frame)
        fixed, error = 3, sigma
        if sides > 0 and height > sigma:  # its offset is an error, which leaves its place on the line or plane
            far = np.linalg.norm(points[frame] - points[other], axis=1).argsort()[1:]
            rows += [distance(other, frame[at]) for at in far.tolist()]
            fixed, error = sides, max(height / sides**0.5, sigma)
        coefficient = np.array([-1.0, 1 - share.sum(), *share]) / error
        rows.append(ShapeRow(np.array([other, *frame]), coefficient, 0.0, fixed))
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
