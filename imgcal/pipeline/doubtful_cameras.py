"""Cameras that stop fitting at the end of a capture, bumped or mislabelled: too few snapshots are left to tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imgcal.pipeline.label_counts import LabelCounts

LEAST_BLOBS = 3
"""Minimum number of blobs in the wrong place for an image not to fit."""
LEAST_SHARE = 0.5
"""Minimum share of the fiducials in view that these must be: clutter beside a hidden object is less."""


@dataclass(frozen=True)
class DoubtfulCamera:
    """A camera that no longer fits the rest of the rig in the last snapshots in which it sees the object."""

    camera: str
    snapshots: tuple[str, ...]  # names, in chronological order

    def as_values(self) -> dict[str, str | list[str]]:
        """Values for scripts."""
        return {"camera": self.camera, "snapshots": list(self.snapshots)}

    def __str__(self) -> str:
        """Describe it in words."""
        return (
            f"camera {self.camera} stopped fitting at snapshot {self.snapshots[0]}: bumped, or mislabelled; the "
            "calibration holds before it"
        )


def doubtful_at_end(
    counts: LabelCounts, camera_names: tuple[str, ...], snapshot_names: tuple[str, ...]
) -> tuple[DoubtfulCamera, ...]:
    """Find cameras none of whose labels fit in the last snapshots in which they see the object, while others' do.

    Args:
        counts: of all snapshots and cameras.
        camera_names: C.
        snapshot_names: S, in chronological order.
    """
    off = np.maximum(counts.unexplained, counts.outliers)
    others = (counts.kept >= LEAST_BLOBS).sum(1, keepdims=True) > 0
    differs = (counts.kept == 0) & (off >= np.maximum(LEAST_BLOBS, LEAST_SHARE * counts.expected)) & others
    agrees = counts.kept > 0
    found = []
    for camera, name in enumerate(camera_names):
        last = np.flatnonzero(agrees[:, camera])
        rows = np.flatnonzero(differs[:, camera])
        rows = rows[rows > last[-1]] if len(last) else rows[:0]
        if len(rows):
            found.append(DoubtfulCamera(name, tuple(snapshot_names[s] for s in rows)))
    return tuple(found)
