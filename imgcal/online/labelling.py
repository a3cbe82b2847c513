"""Prepare a running rig's snapshots for estimation: find blobs in frames, and label blobs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import PipelineOptions, Proposer, Sight, SnapshotIdentity, Tracker, lattice_shifts
from imgcal.detection import DetectionOptions, Frame, detect_snapshot, to_detections
from imgcal.errors import InputError, RefusedError
from imgcal.geometry import RigidTransform
from imgcal.pipeline import DetectorName, check_detections, check_frames, choose_proposer
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior

MOST_FOLLOWED = 64
"""Maximum number of a lattice's fiducials for labels from the last prediction alone: a larger lattice could have
slipped by a pitch unnoticed."""
LEAST_FOLLOWED = 0.9
"""Share of the last snapshot's labels that must be found again and fit."""

NEAR_PREDICTION = "near the last prediction"


class Labelling:
    """Finds blobs, and labels snapshots that the last prediction does not label. Owns a pool of threads.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 1, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> labelling = Labelling(factory, obj, PipelineOptions(), DetectionOptions(), "classical")
        >>> blobs = labelling.blobs(true_detections(truth), "first")
        >>> labelled, snapshot = labelling.decide(blobs, "first", blobs.fiducial, None, None)
        >>> snapshot.status
        'coded'
        >>> labelling.close()
    """

    STATE: ClassVar = {
        "follows": ("follows", bool),
        "refused": ("_refused", int),
        "pose": ("_tracker.pose", RigidTransform | None),
        "alternatives": ("_tracker.alternatives", int),
        "in_vain": ("_tracker.in_vain", int),
        "looks_in_vain": ("_tracker.looks_in_vain", int),
    }

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        options: PipelineOptions,
        detection: DetectionOptions,
        detector: DetectorName | Proposer,
    ) -> None:
        """Start with the factory calibration; arguments as of `RigKeeper`."""
        self.rig, self.obj, self.options, self.detection = rig, obj, options, detection
        self.follows = False  # the last snapshot predicts the object's pose
        self.slips = obj.num_fiducials > MOST_FOLLOWED and bool(lattice_shifts(obj))
        self._tracker = Tracker(rig, obj, options, remembered=0)
        self._refused = 0
        self._proposer: Proposer | None = None
        self._where_blobs_fail = True
        if detector != "classical":
            self._proposer, self._where_blobs_fail = choose_proposer(detector)
        self._pool = ThreadPoolExecutor(min(rig.num_cameras, os.cpu_count() or 1))

    def close(self) -> None:
        """Stop the threads."""
        self._pool.shutdown()

    def blobs(self, source: Mapping[str, Frame | None] | Detections, name: str) -> Detections:
        """Find the blobs of a snapshot, and give it a name.

        Args:
            source: frames by camera, (H, W), None = no frame; or blobs found elsewhere, labelled or not.
            name: of the snapshot.

        Raises:
            InputError: see `RigKeeper.update`.
        """
        if isinstance(source, Detections):
            if len(source.snapshot_names) != 1:
                raise InputError(f"detections: found {len(source.snapshot_names)} snapshots, expected one")
            if len(np.unique(source.snapshot)) <= 1:  # its number in a longer table does not matter
                source = replace(source, snapshot=np.zeros_like(source.snapshot))
            return replace(check_detections(source, self.rig, self.obj), snapshot_names=(name,))
        given = check_frames(source, self.rig)
        frames: dict[str, Frame | None] = {}
        for camera in self.rig.camera_names:
            frame = given.get(camera)
            if isinstance(frame, Sequence):
                raise InputError(f"camera {camera}: found {len(frame)} frames, expected a single frame or None")
            frames[camera] = frame
        blobs = detect_snapshot(frames, self.detection, pool=self._pool, board=self.obj.board)
        return to_detections([blobs], self.rig.camera_names, (name,))

    def decide(
        self,
        usable: Detections,
        name: str,
        coded: NDArray[np.int64] | None,
        frames: Mapping[str, Frame | None] | None,
        known: tuple[CameraRig, Tensor] | None,
    ) -> tuple[Detections, SnapshotIdentity]:
        """Label a snapshot independently of the previous one, using the known rig.

        Args:
            usable: its blobs.
            name: its name.
            coded: (M,) labels that came with the blobs; None = there are none.
            frames: frames that the blobs were found in, for a proposer; None = there are none.
            known: the rig and its uncertainty (C, K); None = as in the factory calibration.

        Raises:
            RefusedError: the blobs cannot be labelled.
        """
        self.follows = False
        prior, tracker = (self.rig.prior or RigPrior()).std(self.rig), self._tracker
        tracker.rig, tracker.prior_std = known or (self.rig, prior)
        if self._proposer is not None and frames is not None and not self._where_blobs_fail:
            return self._label_from_frames(self._proposer, usable, name, frames)
        snapshot, labels = tracker.decide(usable, name) if coded is None else tracker.accept(name, coded)
        if snapshot.status == "refused" and self._proposer is not None and frames is not None:
            return self._label_from_frames(self._proposer, usable, name, frames)
        again = known is not None and self._refused & (self._refused - 1) == 0
        if snapshot.status == "refused" and coded is None and again:
            # The rig may have changed. Another try is slow, so make one after 1, 2, 4, 8, ... successive refusals.
            tracker.rig, tracker.prior_std = self.rig, prior
            snapshot, labels = tracker.decide(usable, name)
        if snapshot.status == "refused":
            self._refused += 1
            raise RefusedError(f"identity: {snapshot.reason}")
        self._refused = 0
        return replace(usable, fiducial=labels), snapshot

    def _label_from_frames(
        self, proposer: Proposer, blobs: Detections, name: str, frames: Mapping[str, Frame | None]
    ) -> tuple[Detections, SnapshotIdentity]:
        """Label a snapshot by a proposer's view of its frames."""
        sight = Sight(proposer, lambda _: frames, self._where_blobs_fail, self.detection)
        snapshot, labels, found = self._tracker.look(sight, 0, blobs, name)
        if snapshot.status == "refused":
            self._refused += 1
            raise RefusedError(f"identity: {snapshot.reason}")
        self._refused = 0
        return replace(found, fiducial=labels), snapshot

    def follow(self, pose: RigidTransform) -> None:
        """Take the object's pose in the latest snapshot as a prediction for the next one."""
        self._tracker.follow(pose)
        self.follows = True
