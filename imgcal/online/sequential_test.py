"""Tests that run beside the filter: each sees every snapshot and reports events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.monitoring import MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import RigState


def check_like(name: str, known: NDArray[Any], found: object) -> NDArray[Any]:
    """Return an array of a saved state if it has the shape and type of the `known` one.

    Raises:
        ValueError: it has not.
    """
    if not isinstance(found, np.ndarray) or (found.shape, found.dtype) != (known.shape, known.dtype):
        raise ValueError(f"{name}: expected {known.dtype} {known.shape}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: expected finite numbers")
    return found.copy()


class SequentialTest(Protocol):
    """Sees the snapshots one by one; `RigKeeper` calls it, and saves it with its own state."""

    name: str

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

    def saved(self) -> dict[str, Any]:
        """Return the state to save, as plain values."""
        ...

    def restored(self, values: dict[str, Any]) -> None:
        """Restore a state from `saved`.

        Raises:
            ValueError, KeyError, TypeError: the values are not such a state.
        """
        ...
