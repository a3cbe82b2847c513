"""`Detections`: unlabelled blobs of all cameras and snapshots, one row each; flags and kinds of blobs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray


class BlobFlag(IntFlag):
    """Reasons to distrust the centre of a blob."""

    NONE = 0
    BORDER = 1  # touches the image border: part of the blob is outside
    MERGED = 2  # two or more blobs in one
    SATURATED = 4  # clipped grey values; the centre is less certain, its sigma says by how much
    MASKED = 8  # reaches into a mask of known reflections
    OUTLIER = 16  # labelled, but not where the calibrated rig predicts this fiducial
    REFLECTION = 32  # not a marker, according to a learned measurer


UNUSABLE = BlobFlag.BORDER | BlobFlag.MERGED | BlobFlag.MASKED | BlobFlag.REFLECTION


class BlobKind(IntEnum):
    """What a blob shows, as classified by a learned measurer."""

    WHOLE = 0  # a whole marker, evenly bright
    PARTIAL = 1  # a marker that is half hidden, or unevenly bright
    MERGED = 2  # a marker and something else that touches it
    FALSE = 3  # not a marker


@dataclass(frozen=True)
class Detections:
    """Blobs of all cameras and snapshots as flat columns, one row per blob.

    Convention: pixel (0, 0) is the centre of the top-left pixel; u right, v down.

    Examples:
        >>> blobs = Detections(
        ...     uv=np.array([[100.0, 50.0], [400.0, 300.0]]), sigma=np.array([0.05, 0.05]), camera=np.array([0, 1]),
        ...     snapshot=np.array([0, 0]), fiducial=np.array([-1, -1]), radius=np.array([3.0, 3.0]),
        ...     flags=np.array([0, BlobFlag.BORDER], dtype=np.uint8),
        ...     camera_names=("left", "right"), snapshot_names=("0",),
        ... )
        >>> len(blobs), blobs.usable
        (2, array([ True, False]))
    """

    uv: NDArray[np.float64]  # (M, 2) pixels
    sigma: NDArray[np.float64]  # (M,) pixels, one standard deviation of each axis
    camera: NDArray[np.int64]  # (M,) index into camera_names
    snapshot: NDArray[np.int64]  # (M,) index into snapshot_names
    fiducial: NDArray[np.int64]  # (M,) row of the object file, -1 = unlabelled
    radius: NDArray[np.float64]  # (M,) pixels, radius of the disc of equal area; nan = unknown
    flags: NDArray[np.uint8]  # (M,) BlobFlag bits
    camera_names: tuple[str, ...]  # C
    snapshot_names: tuple[str, ...]  # S

    def __repr__(self) -> str:
        """Summarize the table: `Detections(523 blobs, 294 labelled, 10 cameras, 4 snapshots)`."""
        labelled = int((self.fiducial >= 0).sum())
        cameras, snapshots = len(self.camera_names), len(self.snapshot_names)
        return f"Detections({len(self)} blobs, {labelled} labelled, {cameras} cameras, {snapshots} snapshots)"

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Mark the blobs whose centres may be used: (M,) bool."""
        return (self.flags & int(UNUSABLE)) == 0

    @property
    def labelled(self) -> NDArray[np.bool_]:
        """Mark the blobs with a label: (M,) bool."""
        return self.fiducial >= 0

    def find_repeated_label(self) -> int | None:
        """Find the first row whose fiducial its camera already has in the same snapshot; None = there is none."""
        rows = np.flatnonzero(self.labelled)
        keys = np.stack([column[rows] for column in (self.snapshot, self.camera, self.fiducial)])
        order = np.lexsort(keys)  # stable: the first of equal rows stays first
        repeated = order[1:][(np.diff(keys[:, order]) == 0).all(axis=0)]
        return int(rows[repeated.min()]) if len(repeated) else None

    def count_by_camera(self, rows: NDArray[np.bool_] | slice = slice(None)) -> NDArray[np.int64]:
        """Count the blobs of each camera: (C,); only those that `rows` marks."""
        return np.bincount(self.camera[rows], minlength=len(self.camera_names))

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Detections:
        """Keep some of the M blobs, given as a mask (M,) or as indices; names of cameras and snapshots stay."""
        return replace(
            self,
            **{
                column: getattr(self, column)[rows]
                for column in ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
            },
        )

    def of_snapshots(self, first: int, last: int) -> Detections:
        """Keep snapshots `first` to `last` (excluded), renumbered from zero."""
        kept = self.select((self.snapshot >= first) & (self.snapshot < last))
        return replace(kept, snapshot=kept.snapshot - first, snapshot_names=self.snapshot_names[first:last])

    def choose_snapshots(self, snapshots: NDArray[np.int64]) -> Detections:
        """Keep some snapshots, given by their numbers in increasing order, renumbered from zero."""
        kept = self.select(np.isin(self.snapshot, snapshots))
        names = tuple(self.snapshot_names[snapshot] for snapshot in snapshots)
        return replace(kept, snapshot=np.searchsorted(snapshots, kept.snapshot), snapshot_names=names)

    @classmethod
    def join(cls, parts: Sequence[Detections]) -> Detections:
        """Join tables of the same cameras, the snapshots of each after those of the one before."""
        first = np.cumsum([0, *(len(part.snapshot_names) for part in parts)])
        names = ("uv", "sigma", "camera", "fiducial", "radius", "flags")
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return replace(
            parts[0],
            **columns,
            snapshot=np.concatenate([part.snapshot + start for part, start in zip(parts, first[:-1], strict=True)]),
            snapshot_names=tuple(name for part in parts for name in part.snapshot_names),
        )
