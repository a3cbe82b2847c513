"""Cameras that show the same image again while the others show something new, such as a stuck frame grabber.

Noise makes no two images equal. An old image with a new time says where the object was: it would pass for a late clock,
and then for a camera that has moved. Its blobs are left out, as if the camera had sent nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imgcal.types import Detections


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

    before: Detections | None = None  # the latest blobs, sorted by camera and place

    def leave_out(self, blobs: Detections) -> Detections:
        """Leave out cameras whose blobs are exactly those of the snapshot before, if as many others show new ones."""
        now = blobs.select(np.lexsort((blobs.uv[:, 1], blobs.uv[:, 0], blobs.camera)))
        before, self.before = self.before, now
        if before is None or not len(now):
            return blobs
        count = len(now.camera_names)
        ends = [np.searchsorted(one.camera, np.arange(count + 1)) for one in (before, now)]
        shown = np.diff(ends[1]) > 0
        same = shown & (np.diff(ends[0]) == np.diff(ends[1]))
        for camera in np.flatnonzero(same):
            was, own = (one.uv[end[camera] : end[camera + 1]] for one, end in zip((before, now), ends, strict=True))
            same[camera] = np.array_equal(was, own)
        if not same.any() or same.sum() > (shown & ~same).sum():
            return blobs  # nothing moves
        return blobs.select(~same[blobs.camera])
