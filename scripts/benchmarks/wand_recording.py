"""The recorded wand: ten real cameras that did not move, 4,800 frames at full rate.

The recording stays in the folder `IMGCAL_CAPTURES`; the project contains no part of it.
"""

from __future__ import annotations

import math
import os
import pickle
from contextlib import suppress
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
CALIBRATED = range(0, 2400, 8)  # frames, in the usual arrangement
FRAMES = 4800  # in the recording
CALIBRATED_EVERY, SCORED_EVERY = 8, 7  # frames
LEAST_CAMERAS = 3  # least number of cameras that see the wand in a scored frame
ROUNDS = 4  # rounds of outlier removal
LEAST_POINTS = 6  # in a snapshot, to fit its pose
CACHE = WORK / "wand_recording.pkl"


@dataclass(frozen=True)
class Arrangement:
    """Which frames are calibrated, which are followed, and which cameras belong to the rig.

    Frames are written as in `0:1200,2400:3600`. A range that falls, `4800:2400`, is played backwards.
    """

    calibrate: str = "0:2400"  #: frames to calibrate from, of which every eighth is taken
    follow: str = "2400:4800"  #: frames to follow
    only: tuple[str, ...] = ()  #: cameras of the rig; default: all

    @property
    def calibrated(self) -> NDArray[np.int64]:
        """Frames to calibrate from."""
        return np.sort(np.concatenate([part[::CALIBRATED_EVERY] for part in _ranges(self.calibrate)]))

    @property
    def backwards(self) -> bool:
        """Tell whether the followed frames are played backwards."""
        return _ranges(self.follow)[0].step < 0

    @cached_property
    def followed(self) -> list[int]:
        """Followed frames in the order of play, numbered so that they ascend: from the end if played backwards."""
        backwards = self.backwards
        return sorted(FRAMES - 1 - n if backwards else n for part in _ranges(self.follow) for n in part)


def _ranges(text: str) -> list[range]:
    """Read ranges of frames.

    Raises:
        InputError: not such ranges, or both rising and falling ones.
    """
    try:
        ends = [tuple(int(end) for end in part.split(":")) for part in text.split(",")]
        found = [range(a, b) if a < b else range(a - 1, b - 1, -1) for a, b in ends]
    except ValueError:
        found = []
    inside = all(len(part) and min(part) >= 0 and max(part) < FRAMES for part in found)
    if not inside or len({part.step for part in found}) != 1:
        raise InputError(f"frames: found {text!r}, expected ranges within 0:{FRAMES} such as 0:1200,2400:3600")
    return found


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
        counts = np.zeros((FRAMES, self.factory.num_cameras), dtype=np.int64)
        np.add.at(counts, (self.frames[self.detections.snapshot], self.detections.camera), 1)
        return counts

    @cached_property
    def _rows(self) -> NDArray[np.int64]:
        """First row of each frame's blobs, with rows in the order of frames: (4801,)."""
        number = self.frames[self.detections.snapshot]
        if (np.diff(number) < 0).any():
            raise InputError(f"{FOLDER}: found frames out of order, expected ascending numbers")
        return np.searchsorted(number, np.arange(FRAMES + 1))

    def frame(self, number: int) -> Detections:
        """Blobs of one frame, possibly none."""
        rows = np.arange(self._rows[number], self._rows[number + 1])
        blobs = self.detections.select(rows)
        return replace(blobs, snapshot=np.zeros(len(rows), dtype=np.int64), snapshot_names=(f"{number:05d}",))

    def backwards(self) -> Recording:
        """The same frames in the opposite order, with numbers that ascend."""
        count, given = len(self.frames), self.detections
        rows = np.argsort(count - 1 - given.snapshot, kind="stable")
        frames = FRAMES - 1 - self.frames[::-1]
        blobs = given.select(rows)
        names = tuple(f"{number:05d}" for number in frames)
        return replace(
            self, detections=replace(blobs, snapshot=count - 1 - blobs.snapshot, snapshot_names=names), frames=frames
        )

    def chosen(self, frames: range | NDArray[np.int64] | list[int]) -> Detections:
        """Blobs of some frames, as one capture."""
        return self.detections.choose_snapshots(np.flatnonzero(np.isin(self.frames, frames)))


@dataclass(frozen=True)
class Calibrated:
    """Calibration from some frames, and labels of frames among those that are followed, on which rigs are scored."""

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


@lru_cache(maxsize=2)
def recording(arrangement: Arrangement = Arrangement()) -> Recording:
    """Read the recording as its cameras saw it, backwards if it is played so."""
    factory, obj = imgcal.load_rig(folder() / "factory.yaml"), imgcal.load_object(folder() / "object.csv")
    detections = imgcal.load_detections(folder() / "detections.csv.gz", factory, obj.num_fiducials)
    if arrangement.only:
        unknown = set(arrangement.only) - set(factory.camera_names)
        if unknown:
            raise InputError(f"only: found {min(unknown)}, expected some of {', '.join(factory.camera_names)}")
        index = [factory.camera_names.index(name) for name in arrangement.only]
        kept = detections.select(np.isin(detections.camera, index))
        new = np.full(factory.num_cameras, -1)
        new[index] = np.arange(len(index))
        detections = replace(kept, camera=new[kept.camera], camera_names=arrangement.only)
        factory = factory.select(index)
    frames = np.array([int(name) for name in detections.snapshot_names])
    given = Recording(detections, frames, factory, obj)
    return given.backwards() if arrangement.backwards else given


@lru_cache(maxsize=1)
def calibrated(anew: bool = False, arrangement: Arrangement = Arrangement()) -> Calibrated:
    """Calibrate from every eighth of the frames to calibrate, or use the cached result unless `anew`."""
    cache = CACHE
    if arrangement != Arrangement():
        parts = (arrangement.calibrate, arrangement.follow, *arrangement.only)
        cache = CACHE.with_name(f"{CACHE.stem} {' '.join(parts)}.pkl")
    if not anew and cache.is_file():
        with cache.open("rb") as file, suppress(AttributeError, ImportError):  # a class has moved since
            found: Calibrated = pickle.load(file)  # written below, by this program
            return found
    given = recording(arrangement)
    numbers = arrangement.calibrated
    numbers = np.sort(FRAMES - 1 - numbers) if arrangement.backwards else numbers
    calibration = imgcal.calibrate(given.chosen(numbers), given.factory, given.obj)
    seeing = (given.counts >= SEEN).sum(1) >= LEAST_CAMERAS
    scored = given.chosen(arrangement.followed[::SCORED_EVERY])
    kept = np.array([seeing[int(name)] for name in scored.snapshot_names])
    row = np.cumsum(kept) - 1
    blobs = scored.select(kept[scored.snapshot])
    names = tuple(name for name, keep in zip(scored.snapshot_names, kept, strict=True) if keep)
    blobs = replace(blobs, snapshot=row[blobs.snapshot], snapshot_names=names)
    labelled = imgcal.score(blobs, calibration.rig, calibration.object.as_exact()).labelled
    observations, poses = accepted_observations(labelled, calibration.rig, calibration.object.as_exact())
    if poses is None:
        raise InputError(f"{FOLDER}: found scored frames without a pose")
    result = Calibrated(calibration, observations, poses)
    make_folder(cache.parent)
    with cache.open("wb") as file:
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
