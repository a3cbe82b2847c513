"""A typical self-written data association: P3P in each camera, Hungarian assignment, a gate.

P3P comes from PoseLib, the assignment from SciPy, lens and pose fit from OpenCV. Intrinsics are the factory values.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from scripts.benchmarks.peer import peer

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
CONFIDENCE = 0.99


@dataclass(frozen=True)
class Settings:
    """Tuned on other snapshots than the benchmark's: 5 % factory error, 6 visible and 2 false blobs per camera."""

    coarse: float = 20.0  # px, to rank poses from three points
    gate: float = 8.0  # px, after the pose is fitted to all its blobs
    least: int = 5  # blobs that a camera's pose must explain
    most_triples: int = 60  # of blobs
    polished: int = 3  # best poses per camera that are fitted
    kept: int = 5  # poses per camera that take part in the vote
    near_deg: float = 15.0  # degrees between poses on which two cameras agree
    near_mm: float = 80.0
    known_gate: float = 90.0  # px, to the projection with a known pose and the factory rig


@dataclass(frozen=True)
class Pinhole:
    """One factory camera."""

    matrix: Array  # (3, 3)
    distortion: Array  # (5,)
    rotation: Array  # (3, 3) cam_from_rig
    translation: Array  # (3,)


@dataclass(frozen=True)
class Answer:
    """One pose of the object in one camera."""

    labels: Labels  # (M,) fiducial of each blob, -1 = none
    rotation: Array  # (3, 3) cam_from_object
    translation: Array  # (3,)
    error: float  # px, RMS

    @property
    def inliers(self) -> int:
        return int((self.labels >= 0).sum())


def one_camera(
    uv: Array, points: Array, camera: Pinhole, generator: np.random.Generator, settings: Settings = Settings()
) -> list[Answer]:
    """Find poses of the object from the blobs (M, 2) of one camera, sorted by the number of explained blobs.

    Tries random triples of blobs with all triples of fiducials (N, 3) until, as in RANSAC, a triple of true markers has
    been drawn with a probability of 99 % according to the best pose so far.
    """
    xy, focal = _ideal(uv, camera), float(camera.matrix[[0, 1], [0, 1]].mean())
    fiducials = list(points[list(permutations(range(len(points)), 3))])
    found: list[Answer] = []
    triples = generator.permutation(np.array(list(combinations(range(len(uv)), 3))).reshape(-1, 3))
    needed: float = settings.most_triples
    for tried, triple in enumerate(triples[: settings.most_triples]):
        if tried >= needed:
            break
        rotation, translation = _p3p(xy[triple], fiducials)
        score = _explained(xy, points, rotation, translation, settings.coarse / focal)
        for k in np.argsort(-score, kind="stable")[: settings.polished]:
            at = _project(points, camera, rotation[k], translation[k])
            labels = _assigned(np.linalg.norm(at[:, None] - uv, axis=-1), settings.coarse)
            answer = _polished(uv, points, camera, labels, settings)
            if answer is not None and not any(np.array_equal(answer.labels, other.labels) for other in found):
                found.append(answer)
        found = sorted(found, key=lambda one: (-one.inliers, one.error))[: settings.kept]
        if found:
            lucky = min((found[0].inliers / len(uv)) ** 3, 1 - 1e-9)
            needed = np.log(1 - CONFIDENCE) / np.log(1 - lucky)
    return found


def each_camera(answers: list[list[Answer]], blobs: list[int], settings: Settings = Settings()) -> list[Labels]:
    """Take each camera's best pose if it explains enough blobs."""
    return [
        found[0].labels if found and found[0].inliers >= settings.least else np.full(count, -1)
        for found, count in zip(answers, blobs, strict=True)
    ]


def by_vote(
    answers: list[list[Answer]],
    blobs: list[int],
    cameras: list[Pinhole],
    symmetries: list[tuple[Array, Labels]],
    settings: Settings = Settings(),
) -> list[Labels]:
    """Take the pose that the most blobs of all cameras agree on, and for each camera its nearest pose.

    Args:
        answers: poses of each camera.
        blobs: number of blobs in each camera.
        cameras: the factory rig.
        symmetries: rotations (3, 3) about the origin of the object that map it onto itself, and where each fiducial
            goes (N,); at least the identity.
        settings: thresholds.

    Returns:
        Labels of each camera's blobs; no labels unless half of the cameras agree.
    """
    none = [np.full(count, -1) for count in blobs]
    every = [(c, answer) for c, found in enumerate(answers) for answer in found]
    if not every:
        return none
    rotation = np.stack([cameras[c].rotation.T @ answer.rotation for c, answer in every])
    centre = np.stack([cameras[c].rotation.T @ (answer.translation - cameras[c].translation) for c, answer in every])
    turns = np.stack([turn for turn, _ in symmetries])
    # trace[i, j, s]: between answer i and answer j after the object's own turn s.
    trace = np.einsum("iab,jac,scb->ijs", rotation, rotation, turns, optimize=True)
    best = trace.argmax(2)
    near = np.arccos(np.clip((trace.max(2) - 1) / 2, -1, 1)) < np.radians(settings.near_deg)
    near &= np.linalg.norm(centre[:, None] - centre, axis=-1) < settings.near_mm
    owner, inliers = np.array([c for c, _ in every]), np.array([answer.inliers for _, answer in every])
    support = [sum(np.max(inliers[row & (owner == c)], initial=0) for c in range(len(cameras))) for row in near]
    winner = int(np.argmax(support))
    if len(set(owner[near[winner]])) < len(cameras) / 2:
        return none
    for c in range(len(cameras)):
        chosen = [j for j in np.flatnonzero(near[winner]) if owner[j] == c]
        if chosen:  # answers are in order
            # The winning symmetry rotates the object first, so map each label to the fiducial that is rotated onto it.
            renamed = np.append(np.argsort(symmetries[best[winner, chosen[0]]][1]), -1)
            none[c] = renamed[every[chosen[0]][1].labels]
    return none


def known_pose(
    uv: Array, points: Array, camera: Pinhole, pose: tuple[Array, Array], settings: Settings = Settings()
) -> Labels:
    """Assign blobs to the projections of a pose (rotation, translation of rig_from_object), fit, assign again."""
    rotation, translation = camera.rotation @ pose[0], camera.rotation @ pose[1] + camera.translation
    projected = _project(points, camera, rotation, translation)
    labels = _assigned(np.linalg.norm(projected[:, None] - uv, axis=-1), settings.known_gate)
    answer = _polished(uv, points, camera, labels, settings)
    return answer.labels if answer is not None and answer.inliers >= settings.least else np.full(len(uv), -1)


def _ideal(uv: Array, camera: Pinhole) -> Array:
    return np.asarray(cv2.undistortPoints(uv[:, None], camera.matrix, camera.distortion)[:, 0], dtype=float)


def _p3p(xy: Array, fiducials: list[Array]) -> tuple[Array, Array]:
    """Find all poses (K, 3, 3), (K, 3) that project triples of fiducials (3, 3) to three blobs (3, 2)."""
    solver: Any = peer("poselib")
    rays = np.c_[xy, np.ones(3)]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    poses = [pose for triple in fiducials for pose in solver.p3p(rays, triple)]
    rotation, translation = [pose.R for pose in poses], [pose.t for pose in poses]
    return np.array(rotation).reshape(-1, 3, 3), np.array(translation).reshape(-1, 3)


def _explained(xy: Array, points: Array, rotation: Array, translation: Array, reach: float) -> Array:
    """Score K poses by the sum over fiducials of their proximity to a blob at depth 1: (K,)."""
    x, y, z = ((rotation[:, i] @ points.T + translation[:, i, None]).astype(np.float32) for i in range(3))
    z = np.where(z > 0, z, np.float32(1e-9))
    x, y = x / z, y / z
    least = np.full_like(x, reach * reach)
    for u, v in xy.astype(np.float32):
        np.minimum(least, (x - u) ** 2 + (y - v) ** 2, out=least)
    return (1 - least / np.float32(reach * reach)).sum(1)


def _assigned(distance: Array, gate: float) -> Labels:
    """Assign fiducials to blobs (N, M) by the Hungarian method, within the gate."""
    cost = np.minimum(distance, gate) ** 2
    fiducial, blob = linear_sum_assignment(cost)
    labels = np.full(distance.shape[1], -1)
    good = cost[fiducial, blob] < gate**2
    labels[blob[good]] = fiducial[good]
    return labels


def _polished(uv: Array, points: Array, camera: Pinhole, labels: Labels, settings: Settings) -> Answer | None:
    """Fit the pose to all labelled blobs and assign again, twice."""
    rotation = translation = None
    for _ in range(2):
        named = np.flatnonzero(labels >= 0)
        if len(named) < 4:
            return None
        good, vector, shift = cv2.solvePnP(
            points[labels[named]], uv[named], camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_SQPNP
        )
        if not good or not np.isfinite(vector).all():
            return None
        vector, shift = cv2.solvePnPRefineLM(
            points[labels[named]], uv[named], camera.matrix, camera.distortion, vector, shift
        )
        rotation, translation = np.asarray(cv2.Rodrigues(vector)[0], dtype=float), np.asarray(shift[:, 0], dtype=float)
        distance = np.linalg.norm(_project(points, camera, rotation, translation)[:, None] - uv, axis=-1)
        labels = _assigned(distance, settings.gate)
    named = np.flatnonzero(labels >= 0)
    if rotation is None or translation is None or len(named) < 4:
        return None
    return Answer(labels, rotation, translation, float(np.sqrt((distance[labels[named], named] ** 2).mean())))


def _project(points: Array, camera: Pinhole, rotation: Array, translation: Array) -> Array:
    vector = cv2.Rodrigues(rotation)[0]
    uv = cv2.projectPoints(points, vector, translation, camera.matrix, camera.distortion)[0]
    return np.asarray(uv[:, 0], dtype=float)
