"""Correct the blobs of cameras that expose late: move them to where they would have been in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.geometry import RigidTransform
from imgcal.medians import median
from imgcal.monitoring import ObjectMotion, RigBelief, project_fiducials
from imgcal.types import Detections

INEXACT, UNSTEADY = 0.1, 30.0
"""Error of a corrected blob: a share of the distance moved, and pixels per second of delay. The place is extrapolated,
and the extrapolation error is the same for all blobs of a snapshot."""
INTERVALS, GAPS = 2.5, (0.2, 0.45)
"""Maximum time since the last snapshot but one for which the object's motion is known: two usual intervals with some
room, within these bounds (s). Three poses are needed: a delay's error is several times as large with the velocity
between two. The upper bound lets pass 5 Hz, the lowest rate at which slips are found."""
POSES = 16
"""Number of latest snapshots that give the motion."""


def clock_shifts(
    blobs: Detections,
    late: NDArray[np.float64],
    belief: RigBelief,
    poses: Sequence[tuple[float, RigidTransform]],
    time: float,
) -> NDArray[np.float64]:
    """Find the shift of each blob of a late camera to where it would have been in time.

    Args:
        blobs: of one snapshot.
        late: (C,) s of delay of the cameras' exposures.
        belief: the rig and the object.
        poses: times (s) and rig_from_object (1,) of earlier snapshots, and of this one if known.
        time: s, of this snapshot.

    Returns:
        Shift to add to each blob, (M, 2) pixels; nan if the object's motion is unknown: such a camera teaches nothing
        then.
    """
    shift = np.zeros((len(blobs), 2))
    cameras = np.flatnonzero(late)
    if not len(cameras):
        return shift
    times = np.array([when for when, _ in poses])
    least, most = GAPS
    gap = least if len(times) < 2 else min(max(INTERVALS * median(np.diff(times)), least), most)
    if len(times) < 2 or time - times[-2] > gap:
        shift[np.isin(blobs.camera, cameras)] = np.nan
        return shift
    motion = ObjectMotion.of(RigidTransform.cat([pose for _, pose in poses]), torch.from_numpy(times - time), gap)
    for camera in cameras.tolist():
        mine = np.flatnonzero(blobs.camera == camera)
        now, then = project_fiducials(belief, motion.interpolate(torch.tensor([0.0, late[camera]])), camera).numpy()
        nearest = np.linalg.norm(blobs.uv[mine, None] - then, axis=-1).argmin(1)
        shift[mine] = (now - then)[np.where(blobs.fiducial[mine] >= 0, blobs.fiducial[mine], nearest)]
    return shift


def shift_blobs(blobs: Detections, shift: NDArray[np.float64], late: NDArray[np.float64]) -> Detections:
    """Move blobs to where they would have been in time, with more noise: see `clock_shifts`."""
    off = np.hypot(INEXACT * np.linalg.norm(shift, axis=1), UNSTEADY * np.abs(late[blobs.camera]))
    return replace(blobs, uv=blobs.uv + shift, sigma=np.hypot(blobs.sigma, off))
