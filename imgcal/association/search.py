"""Search for an unknown pose: single cameras make hypotheses, and the whole rig votes on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from imgcal.association.ambiguities import conflicts, lattice_shifts
from imgcal.association.hypotheses import (
    FiducialTriples,
    Poses,
    blob_triples,
    edge_triples,
    fiducial_triples,
    has_many_triples,
    likely_blobs,
    single_camera_poses,
)
from imgcal.association.planar import planar_poses
from imgcal.association.verification import Fits, Scene, refine, start
from imgcal.association.voting import Votes, match, predict_ideal, vote
from imgcal.types import CalibrationObject

TRIPLES = 10  # blob triples per round, over all cameras
KEPT = 8  # poses kept per triple
PLANAR_EFFORT = 50_000  # hypotheses that take as long as a camera's poses of a planar object
VOTES_A_HYPOTHESIS = 500  # comparisons of a fiducial with a blob that take as long as a hypothesis
EDGES_TRIED = 2  # cameras in which neighbours on the hull are taken for an edge of the object
MANY = 40  # fiducials of a planar object above which there are too many triples
MOST_STEPS = 6  # of a lattice, by which a camera's image is moved
VERIFIED = 2  # number of best different labellings to fit per round
MOST_REPEATS = 3 * TRIPLES  # successive blob triples, all drawn before, after which further ones would be the same
DECISIVE = 0.7  # labelled share of what could be seen that no wrong labelling of a whole rig reaches
DECISIVE_CAMERAS = 3  # in which it must have labels


@dataclass(frozen=True)
class _Ballot:
    """Poses, and how the rig votes on them."""

    poses: Poses
    predicted: NDArray[np.float64]  # (K, C, N, 2) px
    votes: Votes

    def __add__(self, other: _Ballot) -> _Ballot:
        votes = Votes(
            np.concatenate((self.votes.count, other.votes.count)), np.concatenate((self.votes.shift, other.votes.shift))
        )
        return _Ballot(self.poses + other.poses, np.concatenate((self.predicted, other.predicted)), votes)


@dataclass
class Search:
    """Hypotheses of poses from single cameras, on which the whole rig votes."""

    scene: Scene
    cameras: Sequence[int]  # those with enough blobs
    bounds: tuple[float, float]  # see `_bounds`
    alone: bool = True  # no other object is in view: a labelling of nearly all blobs ends a round
    hypotheses: int = 0  # number so far; for planar objects, the equivalent in time
    planar: dict[int, list[Poses]] = field(default_factory=dict)  # by camera: they are the same in every round
    likely: dict[tuple[int, bool], NDArray[np.int64]] = field(default_factory=dict)  # by arguments of `likely_blobs`
    triples: FiducialTriples | None = None  # to match blobs with, once they are needed
    drawn: set[tuple[int, ...]] = field(default_factory=set)  # cameras, each with a triple of blobs in ascending order
    repeats: int = 0  # triples drawn since the last new one

    @property
    def exhausted(self) -> bool:
        """Tell whether further rounds would repeat earlier ones: few blobs form few triples."""
        return self.repeats >= MOST_REPEATS

    def run_round(self, hypotheses: int, generator: np.random.Generator) -> Fits | None:
        """Make hypotheses, let the rig vote within the bounds, and fit the best ones; None = no result.

        The first camera's hypotheses often suffice: a labelling of nearly all blobs ends the round.
        """
        scene, gate = self.scene, self.bounds[1]
        ballots: list[_Ballot] = []
        points = scene.known.points
        for poses in self._poses(hypotheses, generator):
            self.hypotheses += len(poses) * scene.blobs.uv[..., 0].size * len(points) // VOTES_A_HYPOTHESIS
            if len(poses) == 0:
                continue
            predicted = predict_ideal(scene.rig, points, poses)
            ballots.append(_Ballot(poses, predicted, vote(scene.blobs, predicted, self.bounds[0], gate)))
            if self.alone and (fits := self._fit_decisive(ballots[-1])) is not None:
                return fits
        if not ballots:
            return None
        ballot = reduce(add, ballots)
        best = np.argsort(-ballot.votes.count.sum(1), kind="stable")[: 4 * VERIFIED]
        best, labels = distinct(scene.obj, best, self._match(ballot, best))
        return refine(scene, start(scene, ballot.poses.select(best), labels))

    def _poses(self, hypotheses: int, generator: np.random.Generator) -> Iterator[Poses]:
        """Make poses from one camera after the other, then from all others: the quickest to make come first."""
        obj = self.scene.obj
        if obj.planar and obj.num_fiducials > MANY:
            for camera in generator.permutation(self.cameras)[:2].tolist():
                self.hypotheses += PLANAR_EFFORT
                for poses in self._planar_poses(camera):
                    yield from _best_first(poses)
            return
        edges = edge_triples(obj, generator) if self.triples is None else None
        if edges is not None:
            for camera in generator.permutation(self.cameras)[:EDGES_TRIED]:
                yield from _best_first(self._single_camera_poses(camera[None], 1, edges, generator))
        if self.triples is None:
            self.triples = fiducial_triples(obj, generator)
        cameras = generator.permutation(self.cameras)
        number = int(np.clip(hypotheses // len(self.triples.triples), 1, TRIPLES))
        cameras = cameras[:number]
        each = -(-number // len(cameras))
        for part in (cameras[:1], cameras[1:]):
            if len(part):
                yield self._single_camera_poses(part, each, self.triples, generator)

    def _single_camera_poses(
        self, cameras: NDArray[np.int64], each: int, triples: FiducialTriples, generator: np.random.Generator
    ) -> Poses:
        """Make poses from `each` triples of blobs in each camera; edges need neighbours on the hull of the image."""
        scene, edges = self.scene, triples is not self.triples
        drawn = [
            blob_triples(scene.blobs.ideal[c], self._likely_blobs(c, edges), each, generator, neighbours=edges)
            for c in cameras.tolist()
        ]
        camera = np.repeat(cameras, each)
        for row in np.column_stack((camera, np.sort(np.concatenate(drawn)))).tolist():
            self.repeats = self.repeats + 1 if tuple(row) in self.drawn else 0
            self.drawn.add(tuple(row))
        self.hypotheses += len(camera) * len(triples.triples)
        return single_camera_poses(scene.blobs, scene.rig, camera, np.concatenate(drawn), triples, self.bounds[0], KEPT)

    def _fit_decisive(self, ballot: _Ballot) -> Fits | None:
        """Fit the pose with the most votes if it explains nearly all blobs; None = it does not, before or after."""
        scene, votes = self.scene, ballot.votes.count.sum(1)
        best = np.flatnonzero(votes == votes.max())[: 4 * VERIFIED]
        best, labels = distinct(scene.obj, best, self._match(ballot, best), most=1)
        if not self._is_decisive(labels):
            return None
        fits = refine(scene, start(scene, ballot.poses.select(best), labels))
        return fits if self._is_decisive(fits.labels) else None

    def _is_decisive(self, labels: NDArray[np.int64]) -> bool:
        """Tell whether a labelling (1, C, N) explains so much, in every camera with enough blobs, that no other can."""
        labelled = (labels[0] >= 0).sum(-1)
        most = np.minimum(self.scene.blobs.count, self.scene.obj.num_fiducials).sum()
        everywhere = bool(labelled[list(self.cameras)].all())
        return everywhere and (labelled > 0).sum() >= DECISIVE_CAMERAS and labelled.sum() >= DECISIVE * most

    def _match(self, ballot: _Ballot, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        shift = ballot.votes.shift[rows]
        return match_on_lattice(self.scene, ballot.predicted[rows], shift, 1.25 * self.bounds[0])

    def _likely_blobs(self, camera: int, edges: bool) -> NDArray[np.int64]:
        key = camera, edges or has_many_triples(self.scene.obj)
        if key not in self.likely:
            self.likely[key] = likely_blobs(self.scene.blobs, *key)
        return self.likely[key]

    def _planar_poses(self, camera: int) -> Iterator[Poses]:
        if camera in self.planar:
            yield from self.planar[camera]
            return
        found: list[Poses] = []
        for poses in planar_poses(self.scene.blobs, self.scene.rig, camera, self.scene.obj):
            found.append(poses)
            yield poses
        self.planar[camera] = found


def _best_first(poses: Poses) -> Iterator[Poses]:
    """Give the first of some poses alone: for a large object, the rig's votes take longer than to make poses."""
    yield poses.select(np.arange(min(len(poses), 1)))
    yield poses.select(np.arange(1, len(poses)))


def match_on_lattice(
    scene: Scene, predicted: NDArray[np.float64], shift: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """Do the work of `match`, and move each camera's image by steps of the object's lattice while that pairs more."""
    labels = match(scene.blobs, predicted, shift, tolerance)
    falls = [(motion.permutation, motion.permutation >= 0) for motion in lattice_shifts(scene.obj)]
    if not falls:
        return labels
    cameras = np.arange(labels.shape[1])
    for k, (uv, place) in enumerate(zip(predicted, shift, strict=True)):
        moves = [np.median(uv[:, onto[fall]] - uv[:, fall], axis=1) for onto, fall in falls]
        steps = np.stack((np.zeros_like(place), *moves))  # (T, C, 2)
        for _ in range(MOST_STEPS):
            tried = match(scene.blobs, uv[None].repeat(len(steps), 0), place + steps, tolerance)
            best = (tried >= 0).sum(-1).argmax(0)
            labels[k], place = tried[best, cameras], place + steps[best, cameras]
            if not best.any():
                break
    return labels


def distinct(
    obj: CalibrationObject, rows: NDArray[np.int64], labels: NDArray[np.int64], most: int = VERIFIED
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keep at most `most` of the fullest labellings (K, C, N) that differ in most labels."""
    left = np.argsort(-(labels >= 0).sum((1, 2)), kind="stable")
    kept: list[int] = []
    while len(left) and len(kept) < most:
        kept.append(int(left[0]))
        left = left[1:]
        left = left[conflicts(obj, labels[kept[-1]], labels[left]) > 0.5]
    return rows[kept], labels[kept]
