"""What watches a rig beside the filter: small tests that see every snapshot and say what became known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from imgcal.detection import Frame
from imgcal.monitoring import MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import RigState


class SequentialTest(Protocol):
    """Sees one snapshot after another; `RigKeeper` calls it, and saves it with the rest."""

    name: str

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """Say what became known.

        Args:
            state: after this snapshot, without events.
            frames: by camera; None = blobs came.
            absorbed: what the snapshot taught; None = nothing.
        """
        ...

    def saved(self) -> dict[str, Any]:
        """Give what must be kept, in plain values."""
        ...

    def restored(self, values: dict[str, Any]) -> None:
        """Take over what `saved` gave.

        Raises:
            ValueError, KeyError, TypeError: it is not that.
        """
        ...
