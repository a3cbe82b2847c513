"""Candidate poses of collinear markers: two blobs of one camera matched to two of another, at the right distance.

No single camera knows the pose of a line. Two cameras know it roughly: an inaccurate factory calibration moves both
ends of a stick alike, and hardly changes its length. The whole rig votes on these poses as for any other object.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from imgcal.association.hypotheses import Poses
from imgcal.association.search import distinct
from imgcal.association.verification import Fits, Scene, refine, start
from imgcal.association.voting import match, predict_ideal, vote
from imgcal.medians import median

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
MOST_COMPARED = 1_000_000
"""Pairs of meetings to compare at once."""
BEND = 0.02
"""Radians, error of poses from two cameras, even for perfect ones."""


@dataclass(frozen=True)
class _Eyes:
    """Rays to blobs, and their errors."""

    rays: Array  # (C, M, 3) unit directions in the rig's frame
    position: Array  # (C, 3) mm
    error: Array  # (C,) rad
    count: NDArray[np.int64]  # (C,) blobs


@dataclass(frozen=True)
class _Meetings:
    """Points where rays of two cameras nearly meet, one pair of cameras after the other."""

    place: Array  # (P, 3) mm
    pair: NDArray[np.int64]  # (P,) number of the pair of cameras, ascending
    blobs: NDArray[np.int64]  # (P, 2) blob of either camera
    slack: Array  # (P,) relative error of a length between points of this pair

    def select(self, rows: NDArray[np.int64]) -> _Meetings:
        """Keep the given rows."""
        return _Meetings(*(getattr(self, field.name)[rows] for field in fields(self)))


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
    pattern = scene.known.spread.at(away)
    focal, points = scene.known.focal_length, scene.known.points
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
    shift = scene.known.spread.at(float(distance)).shift
    return _Eyes(rays, position, shift / focal.mean(1), blobs.count), float(distance)


def _candidates(scene: Scene, eyes: _Eyes, distance: float, generator: np.random.Generator) -> tuple[Poses, float]:
    """Poses from all pairs of cameras, and their usual distance from the cameras: mm."""
    points = scene.known.points
    alike = len(scene.obj.symmetries) > 1 and len(points) == 2
    poses, meetings = Poses(np.empty((0, 3, 3)), np.empty((0, 3))), _meetings(eyes)
    portion = np.cumsum(np.bincount(meetings.pair) ** 2)[meetings.pair] // MOST_COMPARED
    for rows in np.split(np.arange(len(portion)), np.flatnonzero(np.diff(portion)) + 1):
        poses += _poses_at(points, meetings.select(rows), alike)
    if not len(poses):
        return poses, distance
    if len(poses) > MOST_POSES:
        poses = poses.select(np.sort(generator.permutation(len(poses))[:MOST_POSES]))
    centre = np.median(poses.rotation @ points.mean(0) + poses.translation, axis=0)
    return poses, float(np.linalg.norm(eyes.position - centre, axis=1).mean())


def _meetings(eyes: _Eyes) -> _Meetings:
    """Find where rays of any two cameras nearly meet."""
    cameras, most = eyes.rays.shape[:2]
    valid = (np.arange(most) < eyes.count[:, None]) & (eyes.count[:, None] >= 2)
    none = np.empty(0, dtype=np.int64)
    found = [_Meetings(np.empty((0, 3)), none, np.empty((0, 2), dtype=np.int64), np.empty(0))]
    for first in range(cameras - 1):
        later = slice(first + 1, None)
        d1, d2 = eyes.rays[first][:, None], eyes.rays[later, None]  # (M, 1, 3), (K, 1, M, 3)
        base = (eyes.position[later] - eyes.position[first])[:, None, None]
        cosine, base1, base2 = (d1 * d2).sum(-1), (d1 * base).sum(-1), (d2 * base).sum(-1)
        sine = np.maximum(1 - cosine**2, 1e-12)
        along1, along2 = (base1 - base2 * cosine) / sine, (base1 * cosine - base2) / sine
        one = eyes.position[first] + along1[..., None] * d1
        other = eyes.position[later, None, None] + along2[..., None] * d2
        errors = eyes.error[later]
        reach = REACH * np.hypot(along1 * eyes.error[first], along2 * errors[:, None, None])
        good = valid[first][:, None] & valid[later, None] & (along1 > 0) & (along2 > 0) & (sine > 1e-3)
        good &= np.linalg.norm(one - other, axis=-1) < reach
        steep = np.array([median(values[rows]) for values, rows in zip(sine, good, strict=True)]) ** 0.5
        slack = np.maximum(LEAST_LENGTH_ERROR, REACH * np.hypot(eyes.error[first], errors) / steep)
        k, i, j = np.nonzero(good)
        found.append(_Meetings(0.5 * (one + other)[good], first * cameras + k, np.stack((i, j), 1), slack[k]))
    return _Meetings(*(np.concatenate([getattr(part, f.name) for part in found]) for f in fields(_Meetings)))


def _poses_at(points: Array, meetings: _Meetings, alike: bool) -> Poses:
    """Poses of a line that take two of its points to two meetings of the same cameras, at the right distance."""
    _, first, count = np.unique(meetings.pair, return_index=True, return_counts=True)
    first, count = np.repeat(first, count), np.repeat(count, count)  # of each meeting's pair of cameras
    a = np.repeat(np.arange(len(count)), count)
    b = np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count) + first[a]
    different = (meetings.blobs[a] != meetings.blobs[b]).all(-1) & ((a < b) | (not alike))
    a, b = a[different], b[different]
    apart = np.linalg.norm(meetings.place[a] - meetings.place[b], axis=-1)
    order, poses = [np.empty(0, dtype=np.int64)], Poses(np.empty((0, 3, 3)), np.empty((0, 3)))
    for pair in combinations(range(len(points)), 2):
        ends = points[list(pair)]
        length = float(np.linalg.norm(ends[1] - ends[0]))
        fits = np.abs(apart - length) < meetings.slack[a] * length
        poses += _poses(ends, meetings.place[a[fits]], meetings.place[b[fits]])
        order.append(meetings.pair[a[fits]])
    return poses.select(np.argsort(np.concatenate(order), kind="stable"))


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
