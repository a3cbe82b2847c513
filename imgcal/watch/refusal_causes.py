"""Explain why nothing can be learned, at first or any more: units, conventions, wrong images.

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
"""Numbers of successive refused snapshots with blobs after which a cause is looked for: the object may come late."""
KEPT = 30
"""Latest snapshots that are kept for this."""


class RefusalCauses:
    """Refused snapshots of a rig since something was learned last."""

    def __init__(self, rig: CameraRig, obj: CalibrationObject) -> None:
        """Begin without snapshots; `rig` is the factory calibration."""
        self._rig, self._obj = rig, obj
        self._kept: deque[Detections] = deque(maxlen=KEPT)
        self._latest: RigState | None = None
        self._count = 0
        self._asking: threading.Thread | None = None
        self._cause: str | None = None
        self._told = False
        self._streaks = 0

    def add(self, state: RigState | None) -> str | None:
        """Take the state after a snapshot; never waits: a thread looks for the cause, which takes seconds.

        Args:
            state: the latest state; one that was taken before does not count again.

        Returns:
            The cause of the refusals, once, when it has been found; None = unknown.
        """
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
            self._ask(tuple(self._kept), self._streaks)
        else:
            self._asking.join()
        return self._cause

    def _keep(self, state: RigState) -> None:
        if state.refused is None:
            if self._count:
                self._kept.clear()
                self._asking, self._cause, self._count, self._told = None, None, 0, False
                self._streaks += 1
            return
        if not len(choose_telling_snapshots(state.detections, self._rig.num_cameras)):
            return
        self._count += 1
        self._kept.append(state.detections)
        if self._count in ASKED_AFTER:
            self._asking = threading.Thread(target=self._ask, args=(tuple(self._kept), self._streaks), daemon=True)
            self._asking.start()

    def _ask(self, parts: Sequence[Detections], streak: int) -> None:
        """Look for the cause of a streak of refusals, and keep it unless the streak is over."""
        cause = self._name_cause(parts)
        if streak == self._streaks:
            self._cause = cause

    def _name_cause(self, parts: Sequence[Detections]) -> str | None:
        """Calibrate snapshots, and return the cause that the refusal names; None = it names none."""
        if not parts or self._obj.pose_rank < 6 or self._obj.parts:  # of others, images alone tell no convention
            return None
        seen = Detections.join(parts)
        chosen = choose_telling_snapshots(seen, self._rig.num_cameras)
        try:
            calibrate(seen.choose_snapshots(chosen), self._rig, self._obj)
        except InputError as error:  # such as normalized coordinates, which no snapshot alone shows
            return str(error)
        except RefusedError as error:
            if isinstance(error.__cause__, RefusedError):
                return error.reason
        return None
