"""Detect an object that differs from its file: keep labels that fit in no camera until this can be tested.

A fiducial that is bent by a millimetre lies a few pixels off in every camera. Its labels look like strays, and would be
dropped for ever. An object of another size fits nowhere, and all its snapshots would be refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imgcal.geometry import RigidTransform
from imgcal.messages import plus_minus
from imgcal.monitoring import SHAPE, ObjectChange
from imgcal.online.events import Event
from imgcal.online.label_consistency import Checked
from imgcal.types import Detections

LATEST = 8
"""Successive snapshots with a fiducial, or the object, in an impossible place; they are tested together."""
LEAST_CAMERAS = 2
"""Number of cameras that must see a fiducial in the wrong place."""


@dataclass(frozen=True)
class UnfittedSnapshot:
    """A snapshot with labels that do not fit."""

    blobs: Detections
    rig_from_object: RigidTransform  # (1,)
    seconds: float  # since the previous snapshot
    time: float  # s since the epoch


@dataclass
class ObjectChecks:
    """Tracks every fiducial, and the object as a whole."""

    fiducials: int
    learnt: list[UnfittedSnapshot] = field(default_factory=list)  # latest absorbed snapshots
    refused: list[UnfittedSnapshot] = field(default_factory=list)  # successive snapshots that fit in no camera
    odd: dict[int, int] = field(default_factory=dict)  # fiducial -> successive snapshots in the wrong place
    vain: int = 0  # snapshots to wait after a test without result

    def observe(self, checked: Checked, blobs: Detections, seconds: float, time: float) -> bool:
        """Take an absorbed snapshot; return whether to test the object now.

        Args:
            checked: which labels fit.
            blobs: with the labels that were used.
            seconds: since the previous absorbed snapshot.
            time: s since the epoch.
        """
        self.refused = []
        elsewhere, fits = self._count(checked.given, checked.blobs)
        seen = elsewhere + fits >= LEAST_CAMERAS
        odd = (elsewhere >= LEAST_CAMERAS) & (elsewhere > 2 * fits)
        for fiducial in np.flatnonzero(seen & ~odd).tolist():
            self.odd.pop(fiducial, None)
        for fiducial in np.flatnonzero(odd).tolist():
            self.odd[fiducial] = self.odd.get(fiducial, 0) + 1
        kept = np.where(np.isin(checked.given.fiducial, list(self.odd)), checked.given.fiducial, blobs.fiducial)
        shown = Detections(**{**vars(blobs), "fiducial": kept})
        self.learnt = [*self.learnt, UnfittedSnapshot(shown, checked.rig_from_object, seconds, time)][-LATEST:]
        self.vain = max(self.vain - 1, 0)
        return len(self.learnt) == LATEST and max(self.odd.values(), default=0) >= LATEST and not self.vain

    def observe_refused(self, checked: Checked, learnt: float, time: float) -> None:
        """Take a snapshot that fits in no camera; `learnt`: time (s) of the last absorbed one."""
        seconds = max(time - (self.refused[-1].time if self.refused else learnt), 0.0)
        self.refused = [*self.refused, UnfittedSnapshot(checked.given, checked.rig_from_object, seconds, time)][
            -LATEST:
        ]
        self.vain = max(self.vain - 1, 0)

    @property
    def due(self) -> bool:
        """Tell whether to test the snapshots that fit in no camera."""
        return len(self.refused) == LATEST and not self.vain

    def record_test(self, found: bool) -> None:
        """Restart if the object was found to have changed; otherwise wait for the next test."""
        if found:
            self.learnt, self.odd = [], {}
        self.refused, self.vain = [], 0 if found else 8 * LATEST

    def _count(self, given: Detections, left: Detections) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Number of cameras that see each fiducial in the wrong place, and in the right place: (N,) each."""
        named, lost = given.fiducial >= 0, left.fiducial < 0
        elsewhere = np.bincount(given.fiducial[named & lost], minlength=self.fiducials)
        fits = np.bincount(given.fiducial[named & ~lost], minlength=self.fiducials)
        return elsewhere, fits


def object_event(change: ObjectChange, since: float, time: float, snapshot: int) -> Event:
    """Report that the object has changed.

    Args:
        change: the change found.
        since: s since the epoch.
        time: s since the epoch, now.
        snapshot: number of the update.
    """
    if change.fiducial is None:
        how = "larger" if change.size > 0 else "smaller"
        message = f"the object is {100 * abs(change.size):.3g} % {how} than its file says: it is a different object"
        values = (100 * change.size, 100 * change.sigma)
        return Event(time, snapshot, "object_exchanged", None, since, None, *values, None, change.odds, message)
    if change.fiducial == SHAPE:
        off = f"its fiducials are off by {change.size:.3g} mm (RMS)"
        message = f"the object differs from its file: {off}; it was made less accurately, or is a different object"
        size = (change.size, change.sigma)
        return Event(time, snapshot, "object_exchanged", None, since, None, *size, "mm", change.odds, message)
    message = f"fiducial {change.fiducial} of the object is {plus_minus(change.size, change.sigma)} mm from its place"
    size = (change.size, change.sigma)
    return Event(time, snapshot, "object_bent", None, since, None, *size, "mm", change.odds, message)
