"""The recorded wand: ten real cameras that did not move, 4,800 frames at full rate.

The recording stays in the folder `IMGCAL_CAPTURES`; the project contains no part of it.
"""

from __future__ import annotations

import math
import os
import pickle
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import imgcal
from imgcal.association import accepted_observations
from imgcal.errors import InputError
from imgcal.estimation import estimate
from imgcal.geometry import RigidTransform, rotation_from_vector, undistort
from imgcal.pipeline import RigScore, rms_length
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations
from scripts.output import WORK, make_folder

FOLDER = "wand-ten-cameras-stream"
RATE = 60.0  # frames/s
SEEN = 4  # least number of blobs for a camera to see the wand
CALIBRATED = range(0, 2400, 8)  # frames
FOLLOWED = range(2400, 4800)  # frames
SCORED = range(2400, 4800, 7)  # frames
LEAST_CAMERAS = 3  # least number of cameras that see the wand in a scored frame
ROUNDS = 4  # rounds of outlier removal
LEAST_POINTS = 6  # in a snapshot, to fit its pose
CACHE = WORK / "wand_recording.pkl"


@dataclass(frozen=True)
class Recording:
    """Blobs of all frames."""

    detections: Detections
    frames: NDArray[np.int64]  # (S,) number of each snapshot; frames without any blob are missing
    factory: CameraRig
    obj: CalibrationObject  # nominal

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Blobs of each frame and camera: (4800, C)."""
        counts = np.zeros((FOLLOWED.stop, self.factory.num_cameras), dtype=np.int64)
        np.add.at(counts, (self.frames[self.detections.snapshot], self.detections.camera), 1)
        return counts

    @cached_property
    def _rows(self) -> NDArray[np.int64]:
        """First row of each frame's blobs, with rows in the order of frames: (4801,)."""
        number = self.frames[self.detections.snapshot]
        if (np.diff(number) < 0).any():
            raise InputError(f"{FOLDER}: found frames out of order, expected ascending numbers")
        return np.searchsorted(number, np.arange(FOLLOWED.stop + 1))

    def frame(self, number: int) -> Detections:
        """Blobs of one frame, possibly none."""
        rows = np.arange(self._rows[number], self._rows[number + 1])
        blobs = self.detections.select(rows)
        return replace(blobs, snapshot=np.zeros(len(rows), dtype=np.int64), snapshot_names=(f"{number:05d}",))

    def chosen(self, frames: range) -> Detections:
        """Blobs of some frames, as one capture."""
        kept = np.flatnonzero(np.isin(self.frames, frames))
        row = np.full(len(self.frames), -1)
        row[kept] = np.arange(len(kept))
        blobs = self.detections.select(row[self.detections.snapshot] >= 0)
        names = tuple(self.detections.snapshot_names[k] for k in kept)
        return replace(blobs, snapshot=row[blobs.snapshot], snapshot_names=names)


@dataclass(frozen=True)
class Calibrated:
    """Calibration from the first half, and labels of frames in the second half, on which rigs are scored."""

    calibration: imgcal.Calibration
    observations: Observations  # (S, C, N)
    poses: RigidTransform  # (S,)

    def score(self, rig: CameraRig) -> tuple[float, float]:
        """RMS and median error (px) of the whole wand, with poses fitted to a fixed rig.

        Outliers are removed as in `imgcal.score`. Labels and object come from the calibration, for every rig.
        """
        obj, seen = self.calibration.object, self.observations.seen
        even = replace(self.observations, sigma=torch.full_like(self.observations.sigma, 0.3))
        fixed = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
        poses = self.poses
        for _ in range(ROUNDS):
            poses = estimate(even, rig, obj, poses, prior_std=fixed).rig_from_object
            points = poses.apply(obj.points)
            residual = rig.expand(len(points)).project_values(points, obj.radius).uv - self.observations.uv
            scored = RigScore(self.calibration.labelled, torch.where(seen[..., None], residual, 0.0), seen)
            kept = seen & ~scored.outliers
            if bool((kept == even.seen).all()) or bool((kept.flatten(1).sum(1) < LEAST_POINTS).any()):
                break
            even = replace(even, seen=kept)
        return rms_length(scored.residual, kept) or math.nan, float(scored.distances.median())


def folder() -> Path:
    """Folder of the recording.

    Raises:
        InputError: `IMGCAL_CAPTURES` is not set, or does not contain it.
    """
    captures = os.environ.get("IMGCAL_CAPTURES")
    if not captures or not (Path(captures) / FOLDER).is_dir():
        raise InputError(f"IMGCAL_CAPTURES: found {captures!r}, expected the folder of the captures with {FOLDER}")
    return Path(captures) / FOLDER


@lru_cache(maxsize=1)
def recording() -> Recording:
    """Read the recording."""
    factory, obj = imgcal.load_rig(folder() / "factory.yaml"), imgcal.load_object(folder() / "object.csv")
    detections = imgcal.load_detections(folder() / "detections.csv.gz", factory, obj.num_fiducials)
    return Recording(detections, np.array([int(name) for name in detections.snapshot_names]), factory, obj)


@lru_cache(maxsize=1)
def calibrated(anew: bool = False) -> Calibrated:
    """Calibrate from every eighth frame of the first half, or use the cached result unless `anew`."""
    if not anew and CACHE.is_file():
        with CACHE.open("rb") as file:
            found: Calibrated = pickle.load(file)  # written below, by this program
        return found
    given = recording()
    calibration = imgcal.calibrate(given.chosen(CALIBRATED), given.factory, given.obj)
    seeing = (given.counts >= SEEN).sum(1) >= LEAST_CAMERAS
    scored = given.chosen(SCORED)
    kept = np.array([seeing[int(name)] for name in scored.snapshot_names])
    row = np.cumsum(kept) - 1
    blobs = scored.select(kept[scored.snapshot])
    names = tuple(name for name, keep in zip(scored.snapshot_names, kept, strict=True) if keep)
    blobs = replace(blobs, snapshot=row[blobs.snapshot], snapshot_names=names)
    labelled = imgcal.score(blobs, calibration.rig, calibration.object).labelled
    observations, poses = accepted_observations(labelled, calibration.rig, calibration.object)
    if poses is None:
        raise InputError(f"{FOLDER}: found scored frames without a pose")
    result = Calibrated(calibration, observations, poses)
    make_folder(CACHE.parent)
    with CACHE.open("wb") as file:
        pickle.dump(result, file)
    return result


def turned(blobs: Detections, rig: CameraRig, camera: int, degrees: float) -> Detections:
    """Move the blobs of a camera as if it had rotated about an axis perpendicular to its optical axis.

    Args:
        blobs: of one snapshot.
        rig: its lens and focal length are taken as true.
        camera: index of the camera.
        degrees: angle; each camera has another axis.
    """
    rows = np.flatnonzero(blobs.camera == camera)
    if not len(rows):
        return blobs
    way = 2.4 * camera  # rad, the golden angle
    vector = torch.tensor([math.cos(way), math.sin(way), 0.0], dtype=torch.float64) * math.radians(degrees)
    alone = rig.select([camera])
    xy = (torch.from_numpy(blobs.uv[rows]) - alone.principal_point) / alone.focal_length
    straight, good = undistort(xy[None], alone.distortion, alone.lens_model)
    rays = torch.cat((straight[0], torch.ones(len(rows), 1, dtype=torch.float64)), 1) @ rotation_from_vector(vector).T
    still = replace(alone, cam_from_rig=RigidTransform.identity(dtype=torch.float64).reshape(1))
    image = still.project(1000.0 * rays)
    kept = np.ones(len(blobs), dtype=bool)
    kept[rows] = (good[0] & image.visible[0]).numpy()
    uv = blobs.uv.copy()
    uv[rows] = image.uv[0].numpy()
    return replace(blobs, uv=uv).select(kept)
