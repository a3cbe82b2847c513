"""Exact copies of earlier images and blobs, from a stalled grabber or rows written twice: each counts once.

Noise differs from image to image, so a copy adds no evidence. If copies counted as independent, the result would seem
more certain than it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.association import Associations, Sight
from imgcal.detection import Frame
from imgcal.errors import RefusedError
from imgcal.messages import name_cameras, plural
from imgcal.types import Detections

LEAST_BLOBS = 2
"""Minimum number of copied blobs: a single blob, such as a reflection, may recur at the same place."""
MOST_SHARED = 0.5
"""Maximum share of a camera's images that another camera may show bit for bit."""


@dataclass(frozen=True)
class Repeats:
    """Copies that were left out."""

    rows: int = 0  # blobs listed twice in one image
    copies: tuple[tuple[int, str], ...] = ()  # images with the blobs of an earlier one: number of the snapshot, camera
    snapshots: tuple[tuple[str, str], ...] = ()  # snapshots of copies only: their names, and those of the originals

    @property
    def images(self) -> int:
        """Number of copied images."""
        return len(self.copies)

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        return {"rows": self.rows, "images": self.images, "snapshots": dict(self.snapshots), "note": str(self)}

    def __str__(self) -> str:
        """Summary for people; empty if there are none."""
        parts = []
        if self.images:
            whole = f", {plural(len(self.snapshots), 'whole snapshot')} among them" if self.snapshots else ""
            has = "has" if self.images == 1 else "have"
            parts.append(
                f"{plural(self.images, 'image')} {has} exactly the blobs of an earlier image of the same camera{whole}"
            )
        if self.rows:
            parts.append(f"{plural(self.rows, 'blob')} {'is' if self.rows == 1 else 'are'} listed twice")
        return f"{' and '.join(parts)}: these copies are left out" if parts else ""


def drop_repeats(detections: Detections) -> tuple[Detections, Repeats]:
    """Remove blobs that are bit-identical copies of others.

    Args:
        detections: all blobs, snapshots in chronological order.

    Returns:
        The other blobs, with the names of all snapshots, and what was removed.

    Raises:
        RefusedError: two cameras show the same images: one camera's frames are stored under several names. The message
            names the cameras.
    """
    kept, order, begins = _sort_images(detections)
    _require_own_images(detections, order, begins)
    rows = int((~kept).sum())
    snapshots, cameras = detections.snapshot[order[begins]], detections.camera[order[begins]]
    ends = np.append(begins[1:], len(order))
    first: dict[tuple[int, bytes], int] = {}
    originals = dict[int, set[int]]()
    copies = list[tuple[int, str]]()
    for number in _find_equal(detections.uv[order], cameras, begins):
        part = order[begins[number] : ends[number]]
        if len(part) < LEAST_BLOBS:
            continue
        snapshot, camera = int(snapshots[number]), int(cameras[number])
        earlier = first.setdefault((camera, detections.uv[part].tobytes()), snapshot)
        if earlier != snapshot:
            kept[part] = False
            copies.append((snapshot, detections.camera_names[camera]))
            originals.setdefault(snapshot, set()).add(earlier)
    own = set(np.unique(detections.snapshot[kept]).tolist()) if originals else set()
    names = detections.snapshot_names
    whole = tuple((names[s], names[min(of)]) for s, of in sorted(originals.items()) if s not in own)
    repeats = Repeats(rows, tuple(sorted(copies)), whole)
    return (detections if kept.all() else detections.select(kept)), repeats


def _require_own_images(detections: Detections, order: NDArray[np.int64], begins: NDArray[np.int64]) -> None:
    """Refuse if two cameras show the same images.

    No two cameras see a snapshot alike to the last bit. As both would fit, the result would be a rig of two cameras in
    one place.

    Args:
        detections: all blobs.
        order: of those that are listed once, by image.
        begins: where in it each image begins.
    """
    snapshot, camera = detections.snapshot[order[begins]], detections.camera[order[begins]]
    ends = np.append(begins[1:], len(order))
    cameras = len(detections.camera_names)
    images, blobs = (np.zeros((cameras, cameras), dtype=np.int64) for _ in range(2))
    same: dict[tuple[int, bytes], list[int]] = {}
    for number in _find_equal(detections.uv[order], snapshot, begins):
        part = order[begins[number] : ends[number]]
        others = same.setdefault((int(snapshot[number]), detections.uv[part].tobytes()), [])
        images[others, camera[number]] += 1
        blobs[others, camera[number]] += len(part)
        others.append(int(camera[number]))
    own = np.bincount(camera, minlength=cameras)
    a, b = np.nonzero((blobs >= LEAST_BLOBS) & (images > MOST_SHARED * np.minimum(own[:, None], own)))
    if len(a):
        first = int(a[0])
        copies = b[a == first].tolist()
        names = [detections.camera_names[c] for c in (first, *copies)]
        raise RefusedError(
            f"{name_cameras(names)}: found identical images in {plural(int(images[first, copies].max()), 'snapshot')}, "
            "expected different ones: one camera's frames may be stored under several names",
            python="give each camera its own frames, or leave the wrong ones out (rig.select)",
            command="give each camera its own frames, or leave the wrong ones out (--without)",
        )


def _sort_images(detections: Detections) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Sort blobs by image: which are listed once (M,), the order of those, and where in it each image begins (I,)."""
    u, v = detections.uv.T
    image = detections.snapshot * len(detections.camera_names) + detections.camera
    order = np.lexsort((u, image))
    again = _equal_to_previous(order, image, u)
    if again.any():
        order = np.lexsort((detections.fiducial, v, u, image))
        again = _equal_to_previous(order, image, u, v, detections.fiducial)
    kept = np.ones(len(detections), dtype=np.bool_)
    kept[order] = ~again
    order = order[kept[order]]
    begins = np.flatnonzero(~_equal_to_previous(order, image))
    return kept, order, begins


def _equal_to_previous(order: NDArray[np.int64], *columns: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which rows of sorted columns (M,) are equal to the row before."""
    equal = np.zeros(len(order), dtype=np.bool_)
    equal[1:] = np.logical_and.reduce([column[order[1:]] == column[order[:-1]] for column in columns])
    return equal


def _find_equal(uv: NDArray[np.float64], group: NDArray[np.int64], begins: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find images (I,), starting at the rows `begins`, that may be copies within their group: equal sums of blobs."""
    if not len(begins):
        return begins
    sums = np.column_stack((group, np.diff(np.append(begins, len(uv))), np.add.reduceat(uv, begins)))
    order = np.lexsort(sums.T)
    next_equal = (sums[order[1:]] == sums[order[:-1]]).all(1)
    equal = np.zeros(len(sums), dtype=np.bool_)
    equal[order[1:]] |= next_equal
    equal[order[:-1]] |= next_equal
    return np.flatnonzero(equal)


def hide_repeats(sight: Sight, repeats: Repeats) -> Sight:
    """Take copies out of the frames that a detector looks at."""
    hidden = frozenset(repeats.copies)

    def frames(number: int) -> Mapping[str, Frame | None]:
        shown = sight.frames(number)
        return {camera: None if (number, camera) in hidden else frame for camera, frame in shown.items()}

    return replace(sight, frames=frames) if hidden else sight


def name_repeats(labelled: Associations, repeats: Repeats) -> Associations:
    """Record, for snapshots that are whole copies, that this is why they were refused."""
    first = dict(repeats.snapshots)
    snapshots = tuple(
        replace(snapshot, reason=f"a copy of snapshot {first[snapshot.name]}")
        if snapshot.name in first and snapshot.status == "refused"
        else snapshot
        for snapshot in labelled.snapshots
    )
    return replace(labelled, snapshots=snapshots)
