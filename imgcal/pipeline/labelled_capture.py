"""Labelled snapshots as estimates need them: dense arrays, and an initial pose for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imgcal.association import Associations, accepted_observations, drop_merged, drop_snapshots
from imgcal.estimation import UNPOSED, UndeterminedPosesError, initial_pose, require_poses
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, Observations


@dataclass(frozen=True)
class LabelledCapture:
    """Labelled snapshots, S of which are used and determine the object's pose."""

    labelled: Associations
    observations: Observations  # (S, C, N)
    poses: RigidTransform  # (S,) rig_from_object, the first guess

    def drop_snapshots(
        self, rows: Sequence[int], rig: CameraRig, obj: CalibrationObject, reason: str = UNPOSED
    ) -> LabelledCapture:
        """Refuse some of the used snapshots, by their index among these."""
        return arrange_labels(drop_snapshots(self.labelled, rows, reason), rig, obj)

    def relabel(
        self, rows: NDArray[np.int64], fiducial: NDArray[np.int64], rig: CameraRig, obj: CalibrationObject
    ) -> LabelledCapture:
        """Replace each fiducial by `fiducial` (N,) of it in some of the used snapshots, by their index among these."""
        numbers = np.array(self.labelled.used)[rows]
        detections, snapshots = self.labelled.detections, list(self.labelled.snapshots)
        there = np.isin(detections.snapshot, numbers) & (detections.fiducial >= 0)
        labels = np.where(there, fiducial[detections.fiducial], detections.fiducial)
        for number in self.labelled.used:  # poses are found anew
            snapshots[number] = replace(snapshots[number], rig_from_object=None)
        table = replace(detections, fiducial=labels)
        return arrange_labels(replace(self.labelled, detections=table, snapshots=tuple(snapshots)), rig, obj)


def arrange_labels(labelled: Associations, rig: CameraRig, obj: CalibrationObject) -> LabelledCapture:
    """Remove merged blobs, and snapshots whose labels do not determine the pose; find missing poses.

    Raises:
        RefusedError: no snapshot is left.
    """
    observations, poses = accepted_observations(labelled, rig, obj)
    try:
        require_poses(observations.seen.numpy(), obj.points, obj.part_of if obj.parts else None)
    except UndeterminedPosesError as error:
        return arrange_labels(drop_snapshots(labelled, error.rows, error.reason), rig, obj)
    if poses is None:
        poses, snapshots = initial_pose(observations, rig, obj), list(labelled.snapshots)
        for row, snapshot in enumerate(labelled.used):
            snapshots[snapshot] = replace(snapshots[snapshot], rig_from_object=poses[row])
        labelled = replace(labelled, snapshots=tuple(snapshots))
    left = drop_merged(labelled, poses, rig, obj)
    return LabelledCapture(labelled, observations, poses) if left is labelled else arrange_labels(left, rig, obj)
