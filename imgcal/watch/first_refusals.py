"""Explain why nothing can be learned from the first snapshots: units, conventions, wrong images.

A single snapshot shows that it does not fit, not why. Several are calibrated, and the refusal of that names the cause.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from imgcal.errors import RefusedError
from imgcal.online import RigState
from imgcal.pipeline import calibrate, choose_telling_snapshots
from imgcal.types import CalibrationObject, CameraRig, Detections

ASKED_AFTER = (30, 300)
"""Numbers of refused snapshots with blobs after which a cause is looked for: the object may come late."""
LEAST_BLOBS, LEAST_CAMERAS = 3, 2
"""Blobs of a camera, and such cameras, of a snapshot that counts."""
KEPT = 30
"""Latest snapshots that are kept for this."""


class FirstRefusals:
    """Refused snapshots of a rig of which nothing has been learned yet."""

    def __init__(self, rig: CameraRig, obj: CalibrationObject) -> None:
        """Begin without snapshots; `rig` is the factory calibration."""
        self._rig, self._obj = rig, obj
        self._kept: deque[Detections] = deque(maxlen=KEPT)
        self._latest: RigState | None = None
        self._count = 0

    def add(self, state: RigState | None, learned: int) -> str | None:
        """Take the state after a snapshot.

        Args:
            state: the latest state; one that was taken before does not count again.
            learned: number of snapshots that have been learned from.

        Returns:
            The cause of the refusals, once it is found; None = unknown.
        """
        if state is None or state is self._latest or learned:
            return None
        self._latest, blobs = state, state.detections
        per_camera = np.bincount(blobs.camera[blobs.usable], minlength=len(blobs.camera_names))
        if state.refused is None or (per_camera >= LEAST_BLOBS).sum() < LEAST_CAMERAS:
            return None
        self._count += 1
        self._kept.append(blobs)
        return self.find_cause() if self._count in ASKED_AFTER else None

    def find_cause(self) -> str | None:
        """Calibrate what was kept; return the cause that the refusal names, None if it names none."""
        if not self._kept or self._obj.pose_rank < 6 or self._obj.parts:  # of others, images alone tell no convention
            return None
        seen = Detections.join(tuple(self._kept))
        chosen = choose_telling_snapshots(seen, self._rig.num_cameras)
        try:
            calibrate(seen.choose_snapshots(chosen), self._rig, self._obj)
        except RefusedError as error:
            return error.reason if isinstance(error.__cause__, RefusedError) else None
        return None
