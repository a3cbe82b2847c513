"""Labelled snapshots as estimates need them: dense arrays, and an initial pose for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imgcal.association import Associations, accepted_observations, drop_merged, drop_snapshots
from imgcal.estimation import UNPOSED, UndeterminedPosesError, initial_pose, require_poses
from imgcal.geometry import RigidTransform
from imgcal.pipeline.rests import average_rests, weaken_rests
from imgcal.types import CalibrationObject, CameraRig, Observations


@dataclass(frozen=True)
class LabelledCapture:
    """Labelled snapshots, S of which are used and determine the object's pose."""

    labelled: Associations
    observations: Observations  # (S, C, N), each rest of the object averaged
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
        numbers = np.flatnonzero(np.isin(self.labelled.used_rows, rows))
        detections, snapshots = self.labelled.detections, list(self.labelled.snapshots)
        there = np.isin(detections.snapshot, numbers) & (detections.fiducial >= 0)
        labels = np.where(there, fiducial[detections.fiducial], detections.fiducial)
        for number in np.flatnonzero(self.labelled.used_rows >= 0).tolist():  # poses are found anew
            snapshots[number] = replace(snapshots[number], rig_from_object=None)
        table = replace(detections, fiducial=labels)
        return arrange_labels(replace(self.labelled, detections=table, snapshots=tuple(snapshots)), rig, obj)


def arrange_labels(labelled: Associations, rig: CameraRig, obj: CalibrationObject) -> LabelledCapture:
    """Remove merged blobs, and snapshots whose labels do not determine the pose; find missing poses; average rests.

    Raises:
        RefusedError: no snapshot is left.
    """
    each = _arrange_each(replace(labelled, rests_with={}) if labelled.rests_with else labelled, rig, obj)
    labelled, observations, rows = average_rests(each.labelled, each.observations)
    return each if labelled is each.labelled else LabelledCapture(labelled, observations, each.poses[rows])


def arrange_frames(labelled: Associations, rig: CameraRig, obj: CalibrationObject) -> LabelledCapture:
    """Do what `arrange_labels` does, but keep the snapshots of a rest, with a larger sigma; see `weaken_rests`."""
    each = _arrange_each(replace(labelled, rests_with={}) if labelled.rests_with else labelled, rig, obj)
    return replace(each, observations=weaken_rests(each.labelled, each.observations))


def _arrange_each(labelled: Associations, rig: CameraRig, obj: CalibrationObject) -> LabelledCapture:
    """Do the work of `arrange_labels` with every snapshot for itself."""
    observations, poses = accepted_observations(labelled, rig, obj)
    try:
        require_poses(observations.seen.numpy(), obj.points, obj.part_of if obj.parts else None)
    except UndeterminedPosesError as error:
        return _arrange_each(drop_snapshots(labelled, error.rows, error.reason), rig, obj)
    if poses is None:
        poses, snapshots = initial_pose(observations, rig, obj), list(labelled.snapshots)
        for row, snapshot in enumerate(labelled.used):
            snapshots[snapshot] = replace(snapshots[snapshot], rig_from_object=poses[row])
        labelled = replace(labelled, snapshots=tuple(snapshots))
    left = drop_merged(labelled, poses, rig, obj)
    return LabelledCapture(labelled, observations, poses) if left is labelled else _arrange_each(left, rig, obj)
