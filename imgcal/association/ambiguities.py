"""Rival labellings: those of an object moved onto itself, wholly or in part."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from imgcal.association.hypotheses import Poses
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.types import CalibrationObject

LEAST_OVERLAP = 0.6  # minimum share of fiducials that fall onto others for a shift to be confusing
TOLERANCE_STEP = 0.05  # of the logarithm: a tolerance is rounded up, so that few different ones occur in a capture
MOST_SHIFTS = 8  # the smallest ones, and others as small; larger ones are combinations of them
SAME_LENGTH = 1 + 1e-6  # maximum ratio of equal lengths
FIRST_DIFFERENCES = 32  # per fiducial, in the first search for shifts
GROWTH = 4  # factor in each further one
NEAR = 0.05  # distance that a bent rig may hide, relative to the object's size
BASES = 6  # fiducials whose pairs are turned onto others: two of them are nearly always among those that fall onto some
SAME_TURN = 0.1  # rad, angle between rotations that are one
MOST_TURNED = 128  # fiducials; with more, there are too many pairs


@dataclass(frozen=True)
class Ambiguity:
    """A rigid motion that takes most fiducials near others; fiducial i falls onto `permutation[i]`, -1 = none."""

    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,) mm
    permutation: NDArray[np.int64]  # (N,)


def lattice_shifts(obj: CalibrationObject) -> list[Ambiguity]:
    """Find the translations, smallest first, that take most fiducials onto others: the steps of a lattice.

    Examples:
        >>> import imgcal
        >>> len(lattice_shifts(imgcal.load_object("asymmetric8"))), bool(lattice_shifts(imgcal.load_object("cube27")))
        (0, True)
    """
    return list(_lattice_shifts(obj.points.double().cpu().numpy().tobytes(), 0.01 * obj.size))


@lru_cache(maxsize=16)
def _lattice_shifts(coordinates: bytes, tolerance: float) -> tuple[Ambiguity, ...]:
    """Find the shifts once per object: there are many snapshots, but few objects."""
    points, reach = np.frombuffer(coordinates).reshape(-1, 3), 2 * tolerance
    differences = (points[None] - points[:, None]).reshape(-1, 3)
    length = np.linalg.norm(differences, axis=1)
    ascending = np.argsort(length, kind="stable")
    # A large lattice has its smallest shifts among the smallest differences: the others need no search.
    count, shifts = FIRST_DIFFERENCES * len(points), np.empty((0, 3))
    while len(shifts) <= MOST_SHIFTS and count < GROWTH * len(differences):
        few = ascending[:count]
        longest = np.inf if count >= len(differences) else length[few[-1]] - reach
        shifts = _frequent(differences[few], LEAST_OVERLAP * len(points), reach, longest)
        count *= GROWTH
    if len(shifts) > MOST_SHIFTS:
        shifts = shifts[np.linalg.norm(shifts, axis=1) <= SAME_LENGTH * np.linalg.norm(shifts[MOST_SHIFTS - 1])]
    return tuple(Ambiguity(np.eye(3), shift, _map_onto(points, points + shift, reach)) for shift in shifts)


def _frequent(differences: NDArray[np.float64], least: float, reach: float, longest: float) -> NDArray[np.float64]:
    """Find vectors (K, 3), shortest first, within `reach` of at least `least` of the differences (M, 3).

    They are longer than `reach` and shorter than `longest`.
    """
    tree, length = cKDTree(differences), np.linalg.norm(differences, axis=1)
    count = tree.query_ball_point(differences, reach, return_length=True)
    left = np.flatnonzero((count >= least) & (length > reach) & (length < longest))
    left = left[np.argsort(-count[left], kind="stable")]
    found = []
    while len(left):
        middle = differences[left[0]]
        found.append(differences[tree.query_ball_point(middle, reach)].mean(0))
        left = left[np.linalg.norm(differences[left] - middle, axis=1) > 2 * reach]
    shifts = np.reshape(found, (-1, 3))
    return shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")]


def near_symmetries(obj: CalibrationObject, tolerance: float) -> list[Ambiguity]:
    """Find the rotations that take every fiducial to within `tolerance` (mm) of another, but are not symmetries.

    Sizes of fiducials are ignored here: only the blobs can show that they break a symmetry.
    """
    exact = {motion.permutation.tobytes() for motion in obj.symmetries}
    wider = math.exp(math.ceil(math.log(tolerance) / TOLERANCE_STEP) * TOLERANCE_STEP)
    turns = _near_symmetries(obj.points.double().cpu().numpy().tobytes(), min(wider, 0.2 * obj.size))
    return [turn for turn in turns if turn.permutation.tobytes() not in exact]


@lru_cache(maxsize=64)
def _near_symmetries(coordinates: bytes, tolerance: float) -> tuple[Ambiguity, ...]:
    """Find the rotations once per object and tolerance."""
    points = torch.frombuffer(bytearray(coordinates), dtype=torch.float64).reshape(-1, 3)
    turns = CalibrationObject(points, torch.zeros_like(points)).near_symmetries(tolerance)
    return tuple(Ambiguity(turn.rotation, turn.translation, turn.permutation) for turn in turns)


def partial_turns(obj: CalibrationObject) -> list[Ambiguity]:
    """Find the rotations about the centroid, best first, that take most fiducials near others, but are not symmetries.

    A rig within its prior can bend so that an object turned like this seems to explain most blobs. `permutation` has no
    -1: the other fiducials fall far from those it names.
    """
    if obj.pose_rank < 6 or obj.num_fiducials > MOST_TURNED:
        return []
    exact = np.stack([motion.rotation for motion in obj.symmetries]).tobytes()
    return list(_partial_turns(obj.points.double().cpu().numpy().tobytes(), exact, NEAR * obj.size))


@lru_cache(maxsize=16)
def _partial_turns(coordinates: bytes, symmetries: bytes, tolerance: float) -> tuple[Ambiguity, ...]:
    """Find the rotations once per object: those of some pairs of fiducials onto all others that are as far apart."""
    points, exact = np.frombuffer(coordinates).reshape(-1, 3), np.frombuffer(symmetries).reshape(-1, 3, 3)
    centroid = points.mean(0)
    points = points - centroid
    tree, least = cKDTree(points), LEAST_OVERLAP * len(points)
    found: list[tuple[int, NDArray[np.float64], NDArray[np.int64]]] = []
    for pair in combinations(_spread_points(points, BASES), 2):
        rotations = _turns_of_pair(points, *pair, tolerance)
        distance, near = tree.query(points @ rotations.swapaxes(1, 2), distance_upper_bound=2 * tolerance)
        for k in np.flatnonzero(np.isfinite(distance).sum(1) >= least):
            if any(_angles(turn, rotations[k]) < SAME_TURN for _, turn, _ in found):
                continue
            onto, fell = near[k], near[k] < len(points)
            for _ in range(2):
                u, _, vh = np.linalg.svd(points[onto[fell]].T @ points[fell])
                rotation = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
                onto = tree.query(points @ rotation.T, distance_upper_bound=tolerance)[1]
                fell = onto < len(points)
            if fell.sum() >= least and all(_angles(turn, rotation) > SAME_TURN for _, turn, _ in found):
                # The others get a place as well: their blobs are fiducials, too.
                everywhere = linear_sum_assignment(cdist(points @ rotation.T, points) ** 2)[1]
                found.append((int(fell.sum()), rotation, everywhere))
    found.sort(key=lambda each: -each[0])
    found = [each for each in found if _angles(exact, each[1]).min() > SAME_TURN]
    return tuple(Ambiguity(turn, centroid - turn @ centroid, near) for _, turn, near in found)


def _spread_points(points: NDArray[np.float64], count: int) -> list[int]:
    """Choose points far from the centroid (at the origin) and from each other."""
    distance = np.linalg.norm(points, axis=1)
    chosen: list[int] = []
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def _turns_of_pair(points: NDArray[np.float64], first: int, second: int, tolerance: float) -> NDArray[np.float64]:
    """Rotations (R, 3, 3) about the origin that take two points near others."""
    length = np.linalg.norm(points, axis=1)
    i, j = np.nonzero(np.abs(cdist(points, points) - np.linalg.norm(points[first] - points[second])) <= 2 * tolerance)
    alike = (np.abs(length[i] - length[first]) <= tolerance) & (np.abs(length[j] - length[second]) <= tolerance)
    source, target = points[[first, second]], np.stack((points[i[alike]], points[j[alike]]), axis=1)
    u, _, vh = np.linalg.svd(target.swapaxes(1, 2) @ source)
    u[..., 2] *= np.linalg.det(u @ vh)[:, None]
    return np.asarray(u @ vh)


def _angles(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (*B,) rad between rotations (*B, 3, 3) and one (3, 3)."""
    return geodesic_angle(torch.tensor(first), torch.tensor(second)).numpy()


def relabel(
    pose: RigidTransform, labels: NDArray[np.int64], motions: list[Ambiguity]
) -> tuple[Poses, NDArray[np.int64]]:
    """Label the blobs as if the object had made the inverse of each motion.

    Args:
        pose: rig_from_object of a labelling.
        labels: (C, N) blob of each fiducial.
        motions: K motions.

    Returns:
        K poses and labellings (K, C, N) under which the blobs stay in place.
    """
    rotation, translation = pose.rotation.numpy(), pose.translation.numpy()
    turns = np.stack([rotation @ motion.rotation.T for motion in motions])
    shifts = np.stack([translation - turn @ motion.translation for turn, motion in zip(turns, motions, strict=True)])
    changed = np.full((len(motions), *labels.shape), -1, dtype=np.int64)
    for k, motion in enumerate(motions):
        falls = motion.permutation >= 0
        changed[k][:, motion.permutation[falls]] = labels[:, falls]
    return Poses(turns, shifts), changed


def displacement(uv: NDArray[np.float64], motion: Ambiguity) -> NDArray[np.float64]:
    """Median distance (C,) px that a motion moves fiducials in the images (C, N, 2)."""
    falls = motion.permutation >= 0
    return np.median(np.linalg.norm(uv[:, motion.permutation[falls]] - uv[:, falls], axis=-1), axis=1)


def conflicts(obj: CalibrationObject, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.float64]:
    """Share of commonly labelled blobs that labellings name differently, up to the object's symmetry.

    Labellings without a common blob conflict completely.

    Args:
        obj: the calibration object.
        first: (C, N) blob of each fiducial, -1 = none.
        second: (..., C, N) likewise.

    Returns:
        Shares (...), from 0 to 1.
    """
    common = np.maximum(common_blobs(first, second).sum(-1), 1)
    return 1 - np.max([agreed.sum(-1) for agreed in _count_agreements(obj, first, second)], axis=0) / common


def differ(obj: CalibrationObject, first: NDArray[np.int64], second: NDArray[np.int64]) -> bool:
    """Tell whether two labellings (C, N) are different solutions, up to symmetry, rather than one with odd labels.

    They are if a third of all common blobs, or of one camera's (at least three), are named differently.
    """
    common = common_blobs(first, second)
    if not common.any():
        return True
    return all(
        3 * (common - agreed).sum() > common.sum() or bool(((common - agreed) >= np.maximum(3, common / 3)).any())
        for agreed in _count_agreements(obj, first, second)
    )


def _count_agreements(
    obj: CalibrationObject, first: NDArray[np.int64], second: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Number of blobs that labellings (C, N) and (..., C, N) name alike, for each camera (..., C) and symmetry."""
    return [((first >= 0) & (first == second[..., motion.permutation])).sum(-1) for motion in obj.symmetries]


def _map_onto(points: NDArray[np.float64], images: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    distance, index = cKDTree(points).query(images)
    return np.where(distance <= tolerance, index, -1)


def common_blobs(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of blobs that labellings (C, N) and (..., C, N) both name, for each camera: (..., C)."""
    named = np.zeros((len(first), max(first.max(), second.max(initial=-1)) + 2), dtype=bool)
    named[np.arange(len(first))[:, None], first] = True
    named[:, -1] = False  # where label -1 lands
    return named[np.arange(len(first))[:, None], second].sum(-1)
