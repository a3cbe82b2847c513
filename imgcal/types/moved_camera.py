"""`MovedCamera`: a camera that moved while the rig was in use, however this was detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from imgcal.errors import RefusedError
from imgcal.messages import plus_minus
from imgcal.types.detections import Detections
from imgcal.types.rig import SHOWN_UNITS

Kind = Literal["rotation", "position", "focal_length", "unknown"]

MOST_TOLD = 4  # moves in one message


@dataclass(frozen=True)
class MovedCamera:
    """One camera, the first snapshot after its move, and the size of the move."""

    camera: str
    snapshot: str | None  # name of the first snapshot after the move; None = it moved before the capture
    kind: Kind  # best explanation of the change; unknown = none of its later blobs could be labelled
    size: float | None = None  # in `unit`; None = not known
    sigma: float | None = None  # one standard deviation of the size

    @property
    def unit(self) -> str:
        """Unit of the size."""
        return SHOWN_UNITS[self.kind][0] if self.kind in SHOWN_UNITS else ""

    def as_values(self) -> dict[str, str | float | None]:
        """Values in the form that scripts read."""
        return {
            "camera": self.camera,
            "snapshot": self.snapshot,
            "kind": self.kind,
            "size": self.size,
            "sigma": self.sigma,
            "unit": self.unit,
        }

    def __str__(self) -> str:
        """Describe the move in words."""
        moment = "the capture" if self.snapshot is None else f"snapshot {self.snapshot}"
        where = f"camera {self.camera} moved before {moment}"
        if self.size is None or self.sigma is None:
            return where
        return f"{where} ({self.kind.replace('_', ' ')} {plus_minus(self.size, self.sigma)} {self.unit})"


class MovedError(RefusedError):
    """Raise when cameras moved during a capture: no single rig is right for all of it."""

    def __init__(
        self, moved: Sequence[MovedCamera], since: int, total: int, explained: bool = True,
        labelled: Detections | None = None,
    ) -> None:  # fmt: skip
        """Name the cameras and say what can be done instead.

        Args:
            moved: in order of time.
            since: snapshots after the last move.
            total: snapshots.
            explained: the snapshots before the last move and those since then each fit a static rig; False = their
                disagreement may have another cause.
            labelled: all blobs, with their labels.
        """
        self.moved, self.since, self.explained, self.labelled = tuple(moved), since, explained, labelled
        shown = "; ".join(map(str, moved[:MOST_TOLD])) + ("; ..." if len(moved) > MOST_TOLD else "")
        if not explained:
            super().__init__(
                f"{shown}: no rig is right for all {total} snapshots, and a motion alone does not explain them: that "
                "camera's labels, frames or view may be wrong on one side of that moment",
                python="look at its frames before and after; rig.select leaves the camera out",
                command="look at its frames before and after; --without leaves the camera out",
            )
            return
        super().__init__(
            f"{shown}: no rig is right for all {total} snapshots",
            python=f"PipelineOptions(after_last_move=True) calibrates from the {since} since then",
            command=f"--after-last-move calibrates from the {since} since then",
        )
