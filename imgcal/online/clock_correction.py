"""Cameras that expose later than the others: their blobs, put where they would have been in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.geometry import RigidTransform
from imgcal.monitoring import ObjectMotion, RigBelief, project_fiducials
from imgcal.types import Detections

INEXACT, UNSTEADY = 0.1, 30.0
"""Share of the way that a camera is behind, and pixels for each second of its lateness, by which its blobs count as off
then. Where it sees the object is extrapolated, and what that is off by is alike for all blobs of a snapshot."""
LONGEST = 0.2
"""Seconds since the last snapshot but one up to which it is known how the object moves."""
POSES = 16
"""Latest snapshots that say that."""


def clock_shifts(
    blobs: Detections,
    late: NDArray[np.float64],
    belief: RigBelief,
    poses: Sequence[tuple[float, RigidTransform]],
    time: float,
) -> NDArray[np.float64]:
    """Find by how much blobs of late cameras are off where they would have been in time.

    Args:
        blobs: of one snapshot.
        late: (C,) s by which cameras expose later.
        belief: the rig and the object.
        poses: times (s) and rig_from_object (1,) of snapshots before, and of this one, if it is known.
        time: s, of this one.

    Returns:
        What is to be added to each, (M, 2) pixels; nan where nobody knows how the object moves: such a camera can teach
        nothing then.
    """
    shift = np.zeros((len(blobs), 2))
    cameras = np.flatnonzero(late)
    if not len(cameras):
        return shift
    known = len(poses) > 1 and time - poses[-2][0] <= LONGEST
    if not known:
        shift[np.isin(blobs.camera, cameras)] = np.nan
        return shift
    seconds = torch.tensor([when - time for when, _ in poses], dtype=torch.float64)
    motion = ObjectMotion.of(RigidTransform.cat([pose for _, pose in poses]), seconds)
    for camera in cameras.tolist():
        mine = np.flatnonzero(blobs.camera == camera)
        now, then = project_fiducials(belief, motion.interpolate(torch.tensor([0.0, late[camera]])), camera).numpy()
        nearest = np.linalg.norm(blobs.uv[mine, None] - then, axis=-1).argmin(1)
        shift[mine] = (now - then)[np.where(blobs.fiducial[mine] >= 0, blobs.fiducial[mine], nearest)]
    return shift


def shift_blobs(blobs: Detections, shift: NDArray[np.float64], late: NDArray[np.float64]) -> Detections:
    """Put blobs where they would have been in time, less surely: see `clock_shifts`."""
    off = np.hypot(INEXACT * np.linalg.norm(shift, axis=1), UNSTEADY * np.abs(late[blobs.camera]))
    return replace(blobs, uv=blobs.uv + shift, sigma=np.hypot(blobs.sigma, off))
