"""Relative poses of cameras from the poses in which each sees one object: pairs, then a tree of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from imgcal.geometry import RigidTransform

Floats = NDArray[np.float64]

TRIPLES = 150
"""Triples of snapshots whose object positions give candidates for a relative pose."""
DIRECT = 150
"""Snapshots whose poses in both cameras give a candidate directly."""
GENEROUS = 3.0
"""Multiple of the distances' robust spread within which a snapshot agrees."""
LEAST_SPREAD = 1e-4
"""Smallest spread of the distances, relative to the distance from the camera: below, depths count as exact."""
LEAST_AGREEING = 0.4
"""Smallest share of a pair's snapshots that must agree on its relative pose."""
ROUNDS = 4


@dataclass(frozen=True)
class Pair:
    """Relative pose of two cameras."""

    first: int
    second: int
    second_from_first: tuple[Floats, Floats]  # rotation (3, 3), translation (3,) mm
    agreeing: int  # snapshots
    spread: float  # of their distances, relative to the object's distance from the cameras


def relate(
    cam_from_object: RigidTransform, known: NDArray[np.bool_], points: Floats, generator: np.random.Generator
) -> list[Pair]:
    """Estimate the relative pose of every pair of cameras that see the object together.

    Poses may be wrong in some snapshots, flipped, or all too far away because of a wrong focal length. So the object's
    positions count, and its rotations only where there are fewer than three positions.

    Args:
        cam_from_object: (S, C).
        known: (S, C) where the pose is known.
        points: (N, 3) mm of the object.
        generator: source of randomness.
    """
    rotation, translation = cam_from_object.rotation.numpy(), cam_from_object.translation.numpy()
    placed = np.einsum("scij,nj->scni", rotation, points) + translation[:, :, None]  # (S, C, N, 3)
    found = []
    for first in range(known.shape[1]):
        for second in range(first + 1, known.shape[1]):
            common = np.flatnonzero(known[:, first] & known[:, second])
            if len(common):
                pair = _pair(first, second, placed[common, first], placed[common, second], generator)
                found += [] if pair is None else [pair]
    return found


def tree(pairs: Sequence[Pair], cameras: int) -> tuple[list[list[int]], list[tuple[Floats, Floats]]]:
    """Chain pairs into one frame, from the camera nearest to all others, along paths of least uncertainty.

    Returns:
        Groups of connected cameras, the largest first; and the pose of each camera of the first group: rotation and
        translation of cam_from_root. The others get the identity.
    """
    cost, between = np.zeros((cameras, cameras)), {}
    for pair in pairs:
        rotation, translation = pair.second_from_first
        cost[pair.first, pair.second] = pair.spread**2 / pair.agreeing
        between[pair.first, pair.second] = rotation, translation
        between[pair.second, pair.first] = rotation.T, -rotation.T @ translation
    graph = csr_array(cost)
    count, group = connected_components(graph, directed=False)
    groups = sorted(([int(c) for c in np.flatnonzero(group == g)] for g in range(count)), key=len, reverse=True)
    largest = groups[0]
    distance, before = dijkstra(graph, directed=False, return_predecessors=True)
    root = largest[int(distance[np.ix_(largest, largest)].sum(1).argmin())]
    chained = {root: (np.eye(3), np.zeros(3))}
    for camera in sorted(largest, key=lambda camera: distance[root, camera]):
        if camera != root:
            parent = int(before[root, camera])
            chained[camera] = _compose(between[parent, camera], chained[parent])
    return groups, [chained.get(camera, (np.eye(3), np.zeros(3))) for camera in range(cameras)]


def rigid_motion(source: Floats, destination: Floats) -> tuple[Floats, Floats]:
    """Least-squares rotations (*B, 3, 3) and translations (*B, 3) that align points (*B, M, 3) with others.

    Source: Kabsch 1976.

    Examples:
        >>> rotation, translation = rigid_motion(np.eye(3), np.eye(3) + [1.0, 2.0, 3.0])
        >>> bool(np.allclose(rotation, np.eye(3)) and np.allclose(translation, [1, 2, 3]))
        True
    """
    middle, target = source.mean(-2, keepdims=True), destination.mean(-2, keepdims=True)
    u, _, vh = np.linalg.svd(np.swapaxes(destination - target, -1, -2) @ (source - middle))
    sign = np.ones(u.shape[:-1])
    sign[..., 2] = np.linalg.det(u @ vh)
    rotation = (u * sign[..., None, :]) @ vh
    return rotation, (target - middle @ np.swapaxes(rotation, -1, -2))[..., 0, :]


def _pair(first: int, second: int, a: Floats, b: Floats, generator: np.random.Generator) -> Pair | None:
    """Relate two cameras that see the object's points at a and b: (K, N, 3) mm each."""
    rotation, translation = _guesses(a, b, generator)
    places, there = a.mean(1), b.mean(1)
    depth = (np.linalg.norm(places, axis=-1) + np.linalg.norm(there, axis=-1)) / 2
    off = np.linalg.norm(places @ np.swapaxes(rotation, -1, -2) + translation[:, None] - there, axis=-1) / depth
    if len(a) < 3:  # fewer than three positions do not determine the relative rotation
        moved = np.einsum("hij,knj->hkni", rotation, a) + translation[:, None, None]
        off = np.linalg.norm(moved - b, axis=-1).mean(-1) / depth
    best = int(np.median(off, axis=1).argmin())
    turn, shift, distance = rotation[best], translation[best], off[best]
    agrees = np.ones(len(a), dtype=bool)
    for _ in range(ROUNDS):
        spread = max(1.4826 * float(np.median(distance)), LEAST_SPREAD)
        agrees = distance <= GENEROUS * spread
        chosen, target = (a[agrees].reshape(-1, 3), b[agrees].reshape(-1, 3))
        turn, shift = rigid_motion(chosen, target)
        distance = np.linalg.norm(places @ turn.T + shift - there, axis=-1) / depth
    agreeing = int(agrees.sum())
    if agreeing < LEAST_AGREEING * len(a):
        return None
    return Pair(first, second, (turn, shift), agreeing, spread)


def _guesses(a: Floats, b: Floats, generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Candidate relative poses from some snapshots: rotations (H, 3, 3) and translations (H, 3)."""
    count = len(a)
    some = generator.permutation(count)[:DIRECT]
    direct = rigid_motion(a[some], b[some])
    if count < 3:
        return direct
    triples = np.argsort(generator.random((TRIPLES, count)), axis=1)[:, :3]
    apart = rigid_motion(a.mean(1)[triples], b.mean(1)[triples])
    return np.concatenate((direct[0], apart[0])), np.concatenate((direct[1], apart[1]))


def _compose(outer: tuple[Floats, Floats], inner: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    return outer[0] @ inner[0], outer[0] @ inner[1] + outer[1]


def as_transforms(chained: Sequence[tuple[Floats, Floats]]) -> RigidTransform:
    """Convert pairs of arrays to transforms (C,)."""
    return RigidTransform(
        torch.from_numpy(np.stack([rotation for rotation, _ in chained])),
        torch.from_numpy(np.stack([translation for _, translation in chained])),
    )
