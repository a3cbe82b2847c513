"""Candidate poses of collinear markers: two blobs of one camera matched to two of another, at the right distance.

No single camera knows the pose of a line. Two cameras know it roughly: an inaccurate factory calibration moves both
ends of a stick alike, and hardly changes its length. The whole rig votes on these poses as for any other object.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from imgcal.association.blobs import pattern_prior
from imgcal.association.hypotheses import Poses
from imgcal.association.search import distinct
from imgcal.association.verification import Fits, Scene, refine, start
from imgcal.association.voting import match, predict_ideal, vote

Array = NDArray[np.float64]

REACH = 4.0
"""Maximum distance of rays that meet, and error of a stick's length, in standard deviations of the cameras."""
LEAST_LENGTH_ERROR = 0.03
"""Relative: errors of rays that differ between the two ends."""
MOST_POSES = 20_000
"""Maximum number of poses for the vote."""
MOST_VOTED = 200
"""Number of the best of these to label."""
FITTED = 6
"""Number of different labellings to fit: the best one and its rivals."""
BEND = 0.02
"""Radians, error of poses from two cameras, even for perfect ones."""


@dataclass(frozen=True)
class _Eyes:
    """Rays to blobs, and their errors."""

    rays: Array  # (C, M, 3) unit directions in the rig's frame
    position: Array  # (C, 3) mm
    error: Array  # (C,) rad
    count: NDArray[np.int64]  # (C,) blobs


def fit_sticks(scene: Scene, seed: int) -> Fits | None:
    """Fit the labellings of a snapshot that look most like collinear markers; None = no two blobs do.

    Args:
        scene: the snapshot, with an object of collinear fiducials.
        seed: of the random choice if there are too many candidates.
    """
    eyes, distance = _eyes(scene)
    poses, away = _candidates(scene, eyes, distance, np.random.default_rng(seed))
    if not len(poses):
        return None
    pattern = pattern_prior(scene.std, scene.rig, away)
    focal, points = float(scene.rig.focal_length.mean()), scene.obj.points.double().numpy()
    tolerance = max(3.0, float(np.hypot(2.5 * pattern.shape, BEND)) * focal * scene.obj.size / away)
    gate = max(10.0, REACH * 2**0.5 * float(pattern.shift.max()))
    predicted = predict_ideal(scene.rig, points, poses)
    votes = vote(scene.blobs, predicted, tolerance, gate)
    # One blob near a marker's image is no evidence: the whole image may be shifted there.
    score = np.maximum(votes.count - 1, 0).sum(1)
    best = np.argsort(-score, kind="stable")[:MOST_VOTED]
    labels = match(scene.blobs, predicted[best], votes.shift[best], 1.25 * tolerance)
    labels = np.where((votes.count[best] >= 2)[..., None], labels, -1)
    seen = ((labels >= 0).sum(-1) >= 2).sum(-1) >= 2
    best, labels = best[seen], labels[seen]
    if not len(best):
        return None
    best, labels = distinct(scene.obj, best, labels, FITTED)
    return refine(scene, start(scene, poses.select(best), labels))


def _eyes(scene: Scene) -> tuple[_Eyes, float]:
    rig, blobs = scene.rig, scene.blobs
    position = rig.positions.double().numpy()
    distance = rig.working_distance or float(np.linalg.norm(position - position.mean(0), axis=1).mean()) or 1000.0
    focal = rig.focal_length.double().numpy()
    xy = blobs.ideal.astype(np.float64) / focal[:, None]
    rays = np.concatenate((xy, np.ones((*xy.shape[:2], 1))), -1) @ rig.cam_from_rig.rotation.double().numpy()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    shift = pattern_prior(scene.std, rig, float(distance)).shift
    return _Eyes(rays, position, shift / focal.mean(1), blobs.count), float(distance)


def _candidates(scene: Scene, eyes: _Eyes, distance: float, generator: np.random.Generator) -> tuple[Poses, float]:
    """Poses from all pairs of cameras, and their usual distance from the cameras: mm."""
    points = scene.obj.points.double().numpy()
    pairs = [pair for pair in combinations(range(len(eyes.position)), 2) if eyes.count[list(pair)].min() >= 2]
    symmetric = len(scene.obj.symmetries) > 1
    found: list[tuple[Array, Array, int, int]] = []
    for first, second in pairs:
        at, blobs, slack = _meetings(eyes, first, second)
        if len(at) < 2:
            continue
        apart = np.linalg.norm(at[:, None] - at, axis=-1)
        different = (blobs[:, None] != blobs).all(-1)
        for m, n in combinations(range(len(points)), 2):
            length = float(np.linalg.norm(points[m] - points[n]))
            a, b = np.nonzero(different & (np.abs(apart - length) < slack * length))
            if symmetric and len(points) == 2:
                a, b = a[a < b], b[a < b]
            found += [(at[a], at[b], m, n)] if len(a) else []
    if not found:
        return Poses(np.empty((0, 3, 3)), np.empty((0, 3))), distance
    parts = [_poses(points[[m, n]], a, b) for a, b, m, n in found]
    poses = Poses(np.concatenate([p.rotation for p in parts]), np.concatenate([p.translation for p in parts]))
    if len(poses) > MOST_POSES:
        poses = poses.select(np.sort(generator.permutation(len(poses))[:MOST_POSES]))
    centre = np.median(poses.rotation @ points.mean(0) + poses.translation, axis=0)
    return poses, float(np.linalg.norm(eyes.position - centre, axis=1).mean())


def _meetings(eyes: _Eyes, first: int, second: int) -> tuple[Array, NDArray[np.int64], float]:
    """Points where rays of two cameras nearly meet: (P, 3), the blobs (P, 2), and the relative error of a length."""
    d1, d2 = eyes.rays[first, : eyes.count[first], None], eyes.rays[second, None, : eyes.count[second]]
    base = eyes.position[second] - eyes.position[first]
    cosine = (d1 * d2).sum(-1)
    sine = np.maximum(1 - cosine**2, 1e-12)
    along1 = ((d1 @ base) - (d2 @ base) * cosine) / sine
    along2 = ((d1 @ base) * cosine - (d2 @ base)) / sine
    one = eyes.position[first] + along1[..., None] * d1
    other = eyes.position[second] + along2[..., None] * d2
    reach = REACH * np.hypot(along1 * eyes.error[first], along2 * eyes.error[second])
    good = (along1 > 0) & (along2 > 0) & (sine > 1e-3) & (np.linalg.norm(one - other, axis=-1) < reach)
    i, k = np.nonzero(good)
    if not len(i):
        return np.empty((0, 3)), np.empty((0, 2), dtype=np.int64), 0.0
    steep = float(np.median(sine[good])) ** 0.5
    error = float(np.hypot(eyes.error[first], eyes.error[second])) / steep
    return 0.5 * (one + other)[good], np.stack((i, k), 1), max(LEAST_LENGTH_ERROR, REACH * error)


def _poses(points: Array, a: Array, b: Array) -> Poses:
    """Poses that take two points (2, 3) of a line to pairs of positions (P, 3) by the smallest rotation."""
    along = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
    there = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    middle = along + there
    opposite = np.linalg.norm(middle, axis=1) < 1e-6
    middle[opposite] = np.cross(along, np.eye(3)[int(np.abs(along).argmin())])
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    rotation = 2 * middle[:, :, None] * middle[:, None, :] - np.eye(3)  # half a turn that takes one to the other
    return Poses(rotation, 0.5 * (a + b) - rotation @ points.mean(0))
