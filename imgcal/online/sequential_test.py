"""Tests that run beside the filter: each sees every snapshot and reports events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Protocol

from imgcal.detection import Frame
from imgcal.monitoring import MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import RigState


class SequentialTest(Protocol):
    """Sees the snapshots one by one; `RigKeeper` calls it, and saves it with its own state."""

    name: str
    STATE: ClassVar[Any]
    """What is saved: key in the file -> attribute and type, as in `{"times": ("_times", int)}`."""

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """Return new events.

        Args:
            state: after this snapshot, without events.
            frames: by camera; None = the source is blobs.
            absorbed: the update by the snapshot; None = it taught nothing.
        """
        ...
