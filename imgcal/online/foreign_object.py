"""Detect a different object: as many blobs as fiducials, but its pattern is not found in any snapshot for seconds.

Labels that fit in no camera are another matter: that is the object, and most cameras have moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from imgcal.detection import Frame
from imgcal.monitoring import MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import RigState

SECONDS, SNAPSHOTS = 3.0, 30
"""Seconds and snapshots for which labelling must fail: a half-hidden object fails for moments only."""
KNOWN, BY_CHANCE = 0.75, 3
"""Share of the object's fiducials, over the cameras that see something like it, that must be labelled to recognize it.
A snapshot with fewer labels may have them by chance, and cancels this number of refused ones."""
SHARE, CAMERAS = 0.6, 2
"""Number of blobs, as a share of the object's fiducials, for a camera to see something like it, and of such cameras."""
NOT_FOUND = "identity"
"""How the reason for a refusal begins if the object's pattern was not found."""


class ForeignObject:
    """Reports once that the cameras no longer see the object; again only after the object has been seen."""

    name = "foreign object"
    STATE: ClassVar = {"known": ("_known", bool), "since": ("_since", float | None), "times": ("_times", int)}

    def __init__(self) -> None:
        """Start before the object has been seen."""
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
        if state.refused is None or not state.refused.startswith(NOT_FOUND):
            labelled = np.bincount(blobs.camera[blobs.fiducial >= 0], minlength=len(like_it))
            if state.refused is None and labelled[like_it].sum() >= KNOWN * fiducials * like_it.sum():
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
