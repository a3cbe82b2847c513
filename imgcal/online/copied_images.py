"""Cameras that show the same image again while the others show something new, such as a stuck frame grabber.

Noise makes no two images equal. An old image with a new time says where the object was: it would pass for a late clock,
and then for a camera that has moved. Its blobs are left out, as if the camera had sent nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.types import Detections

ROUNDING = 1e-6
"""Pixels by which sums of equal coordinates may differ."""


@dataclass
class CopiedImages:
    """Compares each camera's blobs with those of the snapshot before.

    Examples:
        >>> from imgcal.synthesis import simulate_truth, true_detections
        >>> import imgcal, torch
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> both = true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(1), None))
        >>> first, second = both.of_snapshots(0, 1), both.of_snapshots(1, 2)
        >>> stuck = Detections.join([first.select(first.camera == 0), second.select(second.camera > 0)])
        >>> copies = CopiedImages()
        >>> [sorted(set(copies.leave_out(blobs).camera.tolist())) for blobs in (first, stuck)]
        [[0, 1, 2, 3], [1, 2, 3]]
    """

    before: Detections | None = None

    def leave_out(self, blobs: Detections) -> Detections:
        """Leave out cameras whose blobs are exactly those of the snapshot before, if as many others show new ones."""
        before, self.before = self.before, blobs
        if before is None or not len(blobs):
            return blobs
        (count, *sums), (count_before, *sums_before) = _summarize(blobs), _summarize(before)
        shown = count > 0
        same = shown & (count == count_before)
        for own, was in zip(sums, sums_before, strict=True):
            same &= np.abs(own - was) < ROUNDING
        for camera in np.flatnonzero(same).tolist():
            same[camera] = np.array_equal(_places(before, camera), _places(blobs, camera))
        if not same.any() or same.sum() > (shown & ~same).sum():
            return blobs  # nothing moves
        return blobs.select(~same[blobs.camera])


def _summarize(blobs: Detections) -> list[NDArray[np.float64]]:
    """Number of blobs and sums of their coordinates, by camera, in whatever order they come: (C,) each."""
    values = (np.ones(len(blobs)), blobs.uv[:, 0], blobs.uv[:, 1])
    return [np.bincount(blobs.camera, of, len(blobs.camera_names)).astype(np.float64) for of in values]


def _places(blobs: Detections, camera: int) -> NDArray[np.float64]:
    """Blobs of a camera in order: (M, 2)."""
    own = blobs.uv[blobs.camera == camera]
    return own[np.lexsort(own.T)]
