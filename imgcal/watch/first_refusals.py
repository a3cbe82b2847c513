"""Explain why nothing can be learned from the first snapshots: units, conventions, wrong images.

A single snapshot shows that it does not fit, not why. Several are calibrated, and the refusal of that names the cause.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from imgcal.errors import InputError, RefusedError
from imgcal.online import RigState
from imgcal.pipeline import calibrate, choose_telling_snapshots
from imgcal.types import CalibrationObject, CameraRig, Detections

ASKED_AFTER = (30, 300)
"""Numbers of refused snapshots with blobs after which a cause is looked for: the object may come late."""
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
        self._asking: threading.Thread | None = None
        self._cause: str | None = None
        self._told = False

    def add(self, state: RigState | None, learned: bool) -> str | None:
        """Take the state after a snapshot; never waits: a thread looks for the cause, which takes seconds.

        Args:
            state: the latest state; one that was taken before does not count again.
            learned: whether any snapshot has been learned from, in an earlier run included.

        Returns:
            The cause of the refusals, once, when it has been found; None = unknown.
        """
        if learned:
            return None
        if state is not None and state is not self._latest:
            self._latest = state
            self._keep(state)
        if self._cause is None or self._told:
            return None
        self._told = True
        return self._cause

    def find_cause(self) -> str | None:
        """Wait for the cause of what was kept; None = the images name none."""
        if self._asking is None:
            self._ask(tuple(self._kept))
        else:
            self._asking.join()
        return self._cause

    def _keep(self, state: RigState) -> None:
        if state.refused is None or not len(choose_telling_snapshots(state.detections, self._rig.num_cameras)):
            return
        self._count += 1
        self._kept.append(state.detections)
        if self._count in ASKED_AFTER:
            self._asking = threading.Thread(target=self._ask, args=(tuple(self._kept),), daemon=True)
            self._asking.start()

    def _ask(self, parts: Sequence[Detections]) -> None:
        """Calibrate snapshots, and keep the cause that the refusal names."""
        if not parts or self._obj.pose_rank < 6 or self._obj.parts:  # of others, images alone tell no convention
            return
        seen = Detections.join(parts)
        chosen = choose_telling_snapshots(seen, self._rig.num_cameras)
        try:
            calibrate(seen.choose_snapshots(chosen), self._rig, self._obj)
        except InputError as error:  # such as normalized coordinates, which no snapshot alone shows
            self._cause = str(error)
        except RefusedError as error:
            if isinstance(error.__cause__, RefusedError):
                self._cause = error.reason
