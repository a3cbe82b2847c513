"""One snapshot of a known rig and object: shuffled blobs, and which fiducial each of them is."""

from dataclasses import dataclass

import numpy as np
import torch

from imgcal.association.blobs import PaddedBlobs, gather
from imgcal.association.hypotheses import Poses
from imgcal.association.verification import Known, Scene
from imgcal.geometry import RigidTransform
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.types import CalibrationObject, CameraRig, Detections

DRIFT = RelativeDrift(0.02, 0.02)


@dataclass(frozen=True)
class Snapshot:
    detections: Detections
    truth: np.ndarray  # (M,) fiducial of each row
    rig: CameraRig  # that took it
    pose: RigidTransform  # rig_from_object

    def labels(self, blobs: PaddedBlobs, fiducials: int) -> np.ndarray:
        """The true blob of each fiducial (C, N)."""
        result = np.full((len(blobs.row), fiducials), -1)
        for camera, rows in enumerate(blobs.row):
            for blob, row in enumerate(rows):
                if row >= 0 and self.truth[row] >= 0:
                    result[camera, self.truth[row]] = blob
        return result

    def poses(self) -> Poses:
        return Poses(self.pose.rotation.numpy()[None], self.pose.translation.numpy()[None])


def detections_of(uv, camera, rig, sigma=0.1, radius=np.nan):
    count = len(uv)
    return Detections(
        np.asarray(uv, dtype=np.float64), np.full(count, sigma), np.asarray(camera, dtype=np.int64),
        np.zeros(count, np.int64), np.full(count, -1), np.full(count, radius), np.zeros(count, np.uint8),
        rig.camera_names, ("0",),
    )  # fmt: skip


def take(rig, obj, seed=0, *, drift=DRIFT, noise=0.1, false=0, missing=0) -> Snapshot:
    """A snapshot of a drifted rig (`drift` None: the factory's own); in each camera some fiducials are missing."""
    made = synthesize(rig, obj, 1, torch.Generator().manual_seed(seed), drift=drift)
    random = np.random.default_rng(seed)
    uv, camera, truth = [], [], []
    for c, (places, size) in enumerate(zip(made.projection.uv[0].numpy(), rig.image_size.numpy(), strict=True)):
        kept = random.permutation(len(places))[: len(places) - missing]
        blobs = places[kept] + noise * random.standard_normal((len(kept), 2))
        here = np.concatenate((blobs, random.random((false, 2)) * size))
        order = random.permutation(len(here))
        uv.append(here[order])
        truth.append(np.concatenate((kept, np.full(false, -1)))[order])
        camera.append(np.full(len(here), c))
    found = detections_of(np.concatenate(uv), np.concatenate(camera), rig, max(noise, 0.05))
    return Snapshot(found, np.concatenate(truth), made.rig[0], made.rig_from_object[0])


def scene_of(snapshot: Snapshot, rig: CameraRig, obj: CalibrationObject, std=None) -> Scene:
    """What verification is given; `std` is that of the drift if none is said."""
    return Scene(gather(snapshot.detections, rig), Known(obj, rig, DRIFT.std(rig) if std is None else std))


def make_object(points: np.ndarray) -> CalibrationObject:
    return CalibrationObject(torch.from_numpy(points), torch.ones(len(points), 3, dtype=torch.float64))


def degrees_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle of the rotation between rotations (*B, 3, 3)."""
    half = np.linalg.norm(np.asarray(first) - np.asarray(second), axis=(-2, -1)) / np.sqrt(8)
    return np.degrees(2 * np.arcsin(np.clip(half, 0, 1)))
