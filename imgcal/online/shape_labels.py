"""Find known objects among the lights of a snapshot by the distances between them.

The rig may still be far off, so each distance has its own uncertainty. A set of lights is an object if all their
distances are right, now and in the previous snapshot: lights that pass each other keep no distance. Where the lights
could be the object in two ways, none of them is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.geometry import pose_rank

Array = NDArray[np.float64]

GATE = 4.0
"""Maximum error of a distance, in standard deviations."""
LENGTH_ERROR = 1e-3
"""Relative error of an object's distances: they cannot be measured better."""
LEAST_MARKERS = {5: 3, 6: 4}
"""Markers that an object needs, by the rank of its pose; all if it has fewer."""
FLAT = 1.0
"""mm: extent across a plane below which an object equals its mirror image."""


@dataclass(frozen=True)
class _Match:
    """Markers of an object, and the lights that they may be."""

    marker: NDArray[np.int64]
    light: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.marker)


@dataclass(frozen=True)
class LightDistances:
    """Where the L lights of a snapshot are, and how well their distances are known."""

    place: Array  # (L, 3) mm
    earlier: Array  # (L, 3) mm in the previous snapshot; nan = not seen
    error: Array  # (L, L) mm, standard deviation of each distance

    def select(self, rows: NDArray[np.int64]) -> LightDistances:
        """Keep some lights."""
        return LightDistances(self.place[rows], self.earlier[rows], self.error[np.ix_(rows, rows)])


def find_shapes(parts: Sequence[tuple[int, Array]], lights: LightDistances) -> NDArray[np.int64]:
    """Number the lights of a snapshot that are markers of known objects.

    Args:
        parts: number of the first marker, and markers (n, 3) mm, of each object.
        lights: of the snapshot.

    Returns:
        The number of each light: (L,); -1 = unknown.

    Examples:
        >>> stick = np.array([[0.0, 0, 0], [500.0, 0, 0]])
        >>> before = np.array([[0.0, 0, 900], [90.0, 0, 700], [0.0, 500, 900]])
        >>> find_shapes([(0, stick)], LightDistances(before + 9.0, before, np.full((3, 3), 0.2))).tolist()
        [0, -1, 1]
    """
    number = np.full(len(lights.place), -1, dtype=np.int64)
    copies: dict[bytes, list[tuple[int, Array]]] = {}
    for first, points in parts:
        copies.setdefault(points.tobytes(), []).append((first, points))
    missing = list[Array]()
    for alike in sorted(copies.values(), key=lambda one: -len(one[0][1])):  # the most evident first
        free, points = np.flatnonzero(number < 0), alike[0][1]
        left = lights.select(free)
        found = [match for match in _matches(points, left) if not _may_belong(match, left, missing)]
        found = _choose_matches(found, points, len(alike))
        if len(found) < len(alike):
            missing.append(points)
        for (first, _), match in zip(alike, found, strict=False):
            number[free[match.light]] = first + match.marker
    return number


def _matches(points: Array, lights: LightDistances) -> list[_Match]:
    """Sets of lights that have the distances of an object's markers, the largest first."""
    rank = pose_rank(torch.from_numpy(points))
    marker, light = (part.ravel() for part in np.indices((len(points), len(lights.place))))
    length = _distances(points)[marker[:, None], marker]
    near = (marker[:, None] != marker) & (light[:, None] != light)
    reach = _reach(length, lights.error[light[:, None], light])
    for place in (lights.place, lights.earlier):
        near &= np.abs(_distances(place)[light[:, None], light] - length) < reach  # false for nan
    found = [_Match(marker[members], light[members]) for members in _cliques(near)]
    least = min(len(points), LEAST_MARKERS[rank])
    found = [one for one in found if len(one) >= least and (rank == 5 or not _is_mirrored(one, points, lights.place))]
    return sorted(found, key=len, reverse=True)


def _cliques(near: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Groups of nodes that are all neighbours of each other (K, K): at least one group for each pair of neighbours."""
    left, found = near.copy(), list[NDArray[np.int64]]()
    while left.any():
        pair = np.unravel_index(int(left.argmax()), left.shape)
        members = [int(node) for node in pair]
        could = near[members[0]] & near[members[1]]
        while could.any():
            nodes = np.flatnonzero(could)
            best = int(nodes[near[np.ix_(nodes, nodes)].sum(1).argmax()])
            members.append(best)
            could &= near[best]
        found.append(np.array(members))
        left[np.ix_(members, members)] = False
    return found


def _choose_matches(found: Sequence[_Match], points: Array, copies: int) -> list[_Match]:
    """Choose as many matches as there are copies of the object; those with a rival are left out."""
    chosen, doubtful = list[_Match](), set[int]()
    for match in found:  # the largest first
        rivals = [at for at, other in enumerate(chosen) if np.isin(match.light, other.light).any()]
        for at in rivals:
            if len(match) == len(chosen[at]) and not _is_same(match, chosen[at], points):
                doubtful.add(at)
        if not rivals:
            chosen.append(match)
    sizes = [len(match) for match in chosen]
    if len(chosen) > copies and sizes[copies] == sizes[copies - 1]:
        return []
    return [match for at, match in enumerate(chosen[:copies]) if at not in doubtful]


def _is_same(one: _Match, other: _Match, points: Array) -> bool:
    """Tell whether two matches of as many lights say the same about their distances."""
    if set(one.light) != set(other.light):
        return False
    first, second = (_distances(points[match.marker[match.light.argsort()]]) for match in (one, other))
    return bool((np.abs(first - second) <= LENGTH_ERROR * first).all())


def _may_belong(match: _Match, lights: LightDistances, missing: Sequence[Array]) -> bool:
    """Tell whether two lights may be markers of an object that was not found."""
    if len(match) > 2:
        return False
    first, second = match.light
    apart = float(np.linalg.norm(lights.place[first] - lights.place[second]))
    lengths = [_distances(points)[np.triu_indices(len(points), 1)] for points in missing]
    return any(bool((np.abs(length - apart) < _reach(length, lights.error[first, second])).any()) for length in lengths)


def _is_mirrored(match: _Match, points: Array, place: Array) -> bool:
    """Tell whether the lights are the mirror image of the markers; flat objects are never."""
    there, marker = place[match.light], points[match.marker]
    if pose_rank(torch.from_numpy(marker)) < 6 or bool(np.linalg.matrix_rank(marker - marker.mean(0), FLAT) < 3):
        return False
    return bool(np.linalg.det((there - there.mean(0)).T @ (marker - marker.mean(0))) < 0)


def _distances(points: Array) -> Array:
    """Distances between points (n, 3): (n, n)."""
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=-1))


def _reach(length: Array, error: Array) -> Array:
    """Maximum error of distances of known length."""
    return GATE * np.hypot(error, LENGTH_ERROR * length)
