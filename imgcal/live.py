"""Recalibration while a rig runs: frames of one snapshot after another, a calibration for each."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.detection import Blobs, DetectionOptions, detect_snapshot
from imgcal.detection.options import Frame
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import estimate
from imgcal.identity.assignment import distances_to_nearest, mutual_nearest
from imgcal.identity.rivals import lattice_shifts
from imgcal.labelling import Follower, Labelled, PipelineOptions, SnapshotIdentity, to_observations
from imgcal.objects import CalibrationObject
from imgcal.observations import Detections
from imgcal.pipeline import Calibration, fit_labelled
from imgcal.rig import CameraRig
from imgcal.sources import checked_detections, checked_frames
from imgcal.transforms import RigidTransform

MOST_FOLLOWED = 64
"""Fiducials of a lattice up to which a snapshot may be labelled by the last prediction alone; a larger one could have
slipped by a pitch unnoticed."""
TOO_NEAR = 0.6
"""Distance (px) between two predictions below which nearness does not tell which is which."""
MOST_APART = 5.0
"""Times the median distance that a blob may be from its fiducial, once the pose has been fitted with the last rig."""
LEAST_FOLLOWED = 0.9
"""Share of the last snapshot's labels that must be found again, and fit."""


class Recalibrator:
    """Keeps what the next snapshot needs: the last pose, what the rig has shown itself to be, a pool of threads.

    Memory does not grow with the number of snapshots. A context manager: leaving it ends the threads.
    """

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        options: PipelineOptions = PipelineOptions(),
        *,
        detection: DetectionOptions = DetectionOptions(),
        window: int = 1,
    ) -> None:
        """Start from a factory calibration.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object.
            options: how sure each result must be.
            detection: how blobs are found.
            window: number of latest snapshots that a calibration is made from; more know the rig better and follow it
                more slowly.
        """
        if window < 1:
            raise InputError(f"window: found {window}, expected at least 1 snapshot")
        self.rig, self.obj, self.options, self.detection = rig, obj, options, detection
        self._follower = Follower(rig, obj, options)
        self._recent: deque[tuple[Detections, SnapshotIdentity]] = deque(maxlen=window)
        self._latest: Calibration | None = None
        self._count = 0
        self._slips = obj.fiducials > MOST_FOLLOWED and bool(lattice_shifts(obj))
        self._pool = ThreadPoolExecutor(min(rig.cameras, os.cpu_count() or 1))

    def __enter__(self) -> Recalibrator:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the threads."""
        self._pool.shutdown()

    def update(self, source: Mapping[str, Frame | None] | Detections) -> Calibration:
        """Recalibrate from a new snapshot.

        Args:
            source: frames by camera, (H, W), None = no frame; or blobs that were found elsewhere, labelled or not.

        Raises:
            RefusedError: this snapshot cannot decide; the next one is tried afresh.
            InputError: a frame is no grey image, or is of a camera that the rig does not have; blobs of more than one
                snapshot.
        """
        name = f"{self._count:05d}"
        self._count += 1
        detections = self._blobs(source, name)
        usable = detections.select(detections.usable)
        coded = usable.fiducial.copy() if (usable.fiducial >= 0).any() else None
        followed = self._follow(usable, name) if coded is None else None
        if followed is not None:
            return followed
        self._latest = None
        snapshot, labels = self._follower.decide(usable, name, coded)
        if snapshot.status == "refused":
            raise RefusedError(f"identity: {snapshot.reason}")
        usable = replace(usable, fiducial=labels)
        return self._keep(usable, snapshot, self._fit(usable, snapshot))

    def _blobs(self, source: Mapping[str, Frame | None] | Detections, name: str) -> Detections:
        if isinstance(source, Detections):
            if len(source.snapshot_names) != 1:
                raise InputError(f"detections: found {len(source.snapshot_names)} snapshots, expected one")
            if len(np.unique(source.snapshot)) <= 1:  # its number in a longer table does not matter
                source = replace(source, snapshot=np.zeros_like(source.snapshot))
            return replace(checked_detections(source, self.rig, self.obj), snapshot_names=(name,))
        given = checked_frames(source, self.rig)
        frames: dict[str, Frame | None] = {}
        for camera in self.rig.camera_names:
            frame = given.get(camera)
            if isinstance(frame, Sequence):
                raise InputError(f"camera {camera}: found {len(frame)} frames, expected one of this moment, or None")
            frames[camera] = frame
        return _table(detect_snapshot(frames, self.detection, pool=self._pool), name, self.rig)

    def _follow(self, blobs: Detections, name: str) -> Calibration | None:
        """Label blobs by the last result's prediction, where the object has moved little; None = not to be trusted.

        What is accepted here has been fitted: as many labels as before, hardly any of them an outlier.
        """
        latest = self._latest
        if latest is None or self._slips:
            return None
        points = latest.rig_from_object[-1].apply(self.obj.points)
        predicted = latest.rig.project(points, self.obj.radius).uv.numpy()  # (C, N, 2)
        blobs, pose = self._without_strays(replace(blobs, fiducial=_nearest(blobs, predicted)), latest)
        before = int(latest.observations.seen[-1].sum())
        if (blobs.fiducial >= 0).sum() < LEAST_FOLLOWED * before:
            return None
        snapshot = SnapshotIdentity(name, "by_tracking", "near the last prediction", 1, pose)
        try:
            result = self._fit(blobs, snapshot, latest)
        except RefusedError:
            return None
        if int(result.observations.seen[-1].sum()) < LEAST_FOLLOWED * before:
            return None
        status, alternatives = self._follower.follow(result.rig_from_object[-1])
        return self._keep(blobs, replace(snapshot, status=status, alternatives=alternatives), result)

    def _without_strays(self, blobs: Detections, latest: Calibration) -> tuple[Detections, RigidTransform]:
        """Fit the pose with the last rig, and drop labels that are off: two markers in one, a reflection beside one."""
        seen = to_observations(blobs, self.rig, self.obj)
        even = replace(seen, sigma=torch.full_like(seen.sigma, self.options.identity_error))
        held, robust = torch.zeros_like(latest.problem.spread[0]), replace(self.options.estimation, loss="cauchy")
        fit = estimate(even, latest.rig, self.obj, latest.rig_from_object[-1:], spread=held, options=robust)
        distance = fit.residual[0].norm(dim=-1)  # (C, N)
        usual = distance[seen.seen[0]].median() if bool(seen.seen.any()) else torch.inf
        stray = (distance > self.options.identity_error + MOST_APART * usual).numpy()
        fiducial = np.where(stray[blobs.camera, blobs.fiducial], -1, blobs.fiducial)
        return replace(blobs, fiducial=fiducial), fit.rig_from_object[0]

    def _fit(self, blobs: Detections, snapshot: SnapshotIdentity, latest: Calibration | None = None) -> Calibration:
        """Fit the latest snapshots and a new one, which is not kept yet: it may be what spoils the fit."""
        window = self._recent.maxlen or 1
        recent = [*self._recent, (blobs, snapshot)][-window:]
        result = fit_labelled(_joined(recent, self.rig), self.rig, self.obj, self.options, latest=latest)
        if (now := result.labelled.snapshots[-1]).status == "refused":
            raise RefusedError(f"estimation: {now.reason}")
        return result

    def _keep(self, blobs: Detections, snapshot: SnapshotIdentity, result: Calibration) -> Calibration:
        self._recent.append((blobs, snapshot))
        self._latest = result
        return result


def _joined(recent: list[tuple[Detections, SnapshotIdentity]], rig: CameraRig) -> Labelled:
    """Put labelled snapshots into one table."""
    tables, snapshots = zip(*recent, strict=True)
    columns = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ("uv", "sigma", "camera", "fiducial", "radius", "flags")
    }
    number = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    names = tuple(snapshot.name for snapshot in snapshots)
    joined = Detections(**columns, snapshot=number, camera_names=rig.camera_names, snapshot_names=names)
    return Labelled(joined, snapshots)


def _nearest(blobs: Detections, predicted: NDArray[np.float64]) -> NDArray[np.int64]:
    """Fiducial (M,) whose prediction (C, N, 2) is nearest to each blob, -1 where that is not mutual or not near enough.

    Near is a quarter of the distance between predictions: a pattern that has moved less keeps its labels. Fiducials
    whose predictions all but coincide get none.
    """
    labels = np.full(len(blobs), -1, dtype=np.int64)
    gaps = distances_to_nearest(predicted)
    reach = 0.25 * float(np.median(gaps))
    order = np.argsort(blobs.camera, kind="stable")
    ends = np.searchsorted(blobs.camera[order], np.arange(len(predicted) + 1))
    for places, crowded, begin, end in zip(predicted, gaps < TOO_NEAR, ends[:-1], ends[1:], strict=True):
        rows, found = order[begin:end], np.empty(len(places), dtype=np.int64)
        mutual_nearest(places, blobs.uv[rows], reach, found)
        named = np.flatnonzero((found >= 0) & ~crowded)
        labels[rows[found[named]]] = named
    return labels


def _table(blobs: Blobs, name: str, rig: CameraRig) -> Detections:
    count = len(blobs.uv)
    return Detections(
        uv=blobs.uv,
        sigma=blobs.sigma,
        camera=blobs.camera,
        snapshot=np.zeros(count, dtype=np.int64),
        fiducial=np.full(count, -1, dtype=np.int64),
        radius=blobs.radius,
        flags=blobs.flags,
        camera_names=rig.camera_names,
        snapshot_names=(name,),
    )
