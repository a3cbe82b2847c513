"""Search for an unknown pose: single cameras make hypotheses, and the whole rig votes on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from imgcal.association.ambiguities import conflicts
from imgcal.association.hypotheses import FiducialTriples, Poses, blob_triples, single_camera_poses
from imgcal.association.planar import planar_poses
from imgcal.association.verification import Fits, Scene, refine, start
from imgcal.association.voting import match, predict_ideal, vote
from imgcal.types import CalibrationObject

TRIPLES = 10  # blob triples per round, over all cameras
KEPT = 8  # poses kept per triple
PLANAR_EFFORT = 50_000  # hypotheses that take as long as a camera's poses of a planar object
VOTES_A_HYPOTHESIS = 500  # comparisons of a fiducial with a blob that take as long as a hypothesis
MANY = 40  # fiducials of a planar object above which there are too many triples
VERIFIED = 2  # number of best different labellings to fit per round


@dataclass
class Search:
    """Hypotheses of poses from single cameras, on which the whole rig votes."""

    scene: Scene
    likely: Mapping[int, NDArray[np.int64]]  # blobs to draw from, for each useful camera
    triples: FiducialTriples
    bounds: tuple[float, float]  # see `_bounds`
    hypotheses: int = 0  # number so far; for planar objects, the equivalent in time
    planar: dict[int, Poses] = field(default_factory=dict)  # by camera: they are the same in every round

    def run_round(self, hypotheses: int, generator: np.random.Generator) -> Fits | None:
        """Make hypotheses, let the rig vote within the bounds, and fit the best ones; None = no result."""
        scene, (tolerance, gate) = self.scene, self.bounds
        cameras = np.array(list(self.likely))
        if scene.obj.planar and scene.obj.num_fiducials > MANY:
            chosen = generator.permutation(cameras)[:2]
            poses = reduce(add, (self._planar_poses(camera) for camera in chosen.tolist()))
            self.hypotheses += PLANAR_EFFORT * len(chosen)
        else:
            number = int(np.clip(hypotheses // len(self.triples.triples), 1, TRIPLES))
            cameras = generator.permutation(cameras)[:number]
            each = -(-number // len(cameras))
            drawn = [blob_triples(scene.blobs.ideal[c], self.likely[c], each, generator) for c in cameras.tolist()]
            camera = np.repeat(cameras, each)
            poses = single_camera_poses(
                scene.blobs, scene.rig, camera, np.concatenate(drawn), self.triples, tolerance, KEPT
            )
            self.hypotheses += len(camera) * len(self.triples.triples)
        self.hypotheses += len(poses) * scene.blobs.uv[..., 0].size * scene.obj.num_fiducials // VOTES_A_HYPOTHESIS
        if len(poses) == 0:
            return None
        predicted = predict_ideal(scene.rig, self.triples.points, poses)
        votes = vote(scene.blobs, predicted, tolerance, gate)
        best = np.argsort(-votes.count.sum(1), kind="stable")[: 4 * VERIFIED]
        labels = match(scene.blobs, predicted[best], votes.shift[best], 1.25 * tolerance)
        best, labels = distinct(scene.obj, best, labels)
        return refine(scene, start(scene, poses.select(best), labels))

    def _planar_poses(self, camera: int) -> Poses:
        if camera not in self.planar:
            self.planar[camera] = planar_poses(self.scene.blobs, self.scene.rig, camera, self.scene.obj)
        return self.planar[camera]


def distinct(
    obj: CalibrationObject, rows: NDArray[np.int64], labels: NDArray[np.int64], most: int = VERIFIED
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keep at most `most` of the fullest labellings (K, C, N) that differ in most labels."""
    order = np.argsort(-(labels >= 0).sum((1, 2)), kind="stable")
    kept: list[int] = []
    for k in order:
        if all(conflicts(obj, labels[other], labels[k]) > 0.5 for other in kept):
            kept.append(int(k))
        if len(kept) == most:
            break
    return rows[kept], labels[kept]
