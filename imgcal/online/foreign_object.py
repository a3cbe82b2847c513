"""Is that another object? As many blobs as fiducials, and for seconds nobody can tell which is which."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from imgcal.detection import Frame
from imgcal.monitoring import MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import RigState

SECONDS, SNAPSHOTS = 3.0, 30
"""How long, and how often, a snapshot must be refused: an object half hidden is refused for moments."""
KNOWN, BY_CHANCE = 0.75, 3
"""Share of the fiducials of the cameras that see something like it from which it is the object that is seen; a snapshot
that was learnt with fewer labels may have them by chance, and takes back so many that were refused."""
SHARE, CAMERAS = 0.6, 2
"""Blobs, in parts of the object's fiducials, from which a camera sees something like it, and cameras that must."""


class ForeignObject:
    """Tells once when what is seen is no longer the object; again after the object has been seen."""

    name = "foreign object"

    def __init__(self) -> None:
        """Begin before the object has been seen."""
        self._known = False  # the object has been seen since the last alarm
        self._since: float | None = None  # s, of the first refused snapshot
        self._times = 0

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """See `SequentialTest`."""
        blobs, fiducials = state.detections, len(state.belief.points_object)
        count = np.bincount(blobs.camera[blobs.usable], minlength=len(blobs.camera_names))
        like_it = count >= SHARE * fiducials
        if state.refused is None:
            labelled = np.bincount(blobs.camera[blobs.fiducial >= 0], minlength=len(like_it))
            if labelled[like_it].sum() >= KNOWN * fiducials * like_it.sum():
                self._known, self._times = True, 0
            self._times = max(self._times - BY_CHANCE, 0)
            self._since = self._since if self._times else None
            return ()
        if like_it.sum() < CAMERAS:
            self._since, self._times = None, 0
            return ()
        self._since = state.time if self._since is None else min(self._since, state.time)  # clocks may be set back
        self._times += 1
        if not self._known or self._times < SNAPSHOTS or state.time - self._since < SECONDS:
            return ()
        self._known = False
        message = "what the cameras see is not the object, or it is bent beyond recognition"
        return (Event(state.time, state.snapshot, "object_exchanged", None, self._since, message=message),)

    def saved(self) -> dict[str, Any]:
        """See `SequentialTest`."""
        return {"known": self._known}

    def restored(self, values: dict[str, Any]) -> None:
        """See `SequentialTest`."""
        self._known = bool(values["known"])
