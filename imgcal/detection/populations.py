"""Markers apart from what is far dimmer (paint on the floor, scratches, faint reflections) or of no marker's size.

Markers of one object are alike: their peaks differ by distance, angle and illumination, a few times at most, and those
in between fill the range. Blobs that are close to the background and several times dimmer than all the others, with
nothing in between, are something else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.centroids import Blobs
from imgcal.detection.options import DetectionOptions
from imgcal.types import UNUSABLE

GAP = 3.0  # ratio of neighbouring contrasts between two populations
DIM = 0.08  # of full scale: the dim population is below, the bright one above
LEAST_BRIGHT = 3  # blobs in a frame that the bright population must have
ONE_SIZE = 1.6  # ratio of radii of markers of one size
LEAST_LARGE = 3  # blobs of one size beyond the usual ones that must be there
OFTEN = 0.25  # share of a camera's frames that must have a limit for the others to take it over


def dim_limit(contrast: NDArray[np.floating]) -> float:
    """Contrast that separates two populations, 0 where there is one.

    Args:
        contrast: (K,) peaks above the background, shares of full scale.
    """
    ordered = np.sort(contrast)[::-1]
    above, below = ordered[LEAST_BRIGHT - 1 : -1], ordered[LEAST_BRIGHT:]
    if not len(below):
        return 0.0
    ratio = np.where((below < DIM) & (above > DIM), above / np.maximum(below, 1e-9), 0.0)
    widest = int(ratio.argmax())
    return float(np.sqrt(above[widest] * below[widest])) if ratio[widest] >= GAP else 0.0


def usable(blobs: Blobs) -> NDArray[np.bool_]:
    """Mark blobs whose centres may be used: (K,)."""
    return (blobs.flags & int(UNUSABLE)) == 0


def usual_size(blobs: Blobs, limit: float) -> NDArray[np.bool_]:
    """Mark blobs (K,) up to a radius `limit` (px), and larger ones if several are alike in size and no dimmer."""
    small = blobs.radius <= limit
    if small.all():
        return small
    large = ~small & usable(blobs)
    if large.sum() >= LEAST_LARGE:
        ratio = blobs.radius / np.median(blobs.radius[large])
        alike = large & (ratio < ONE_SIZE) & (ratio > 1 / ONE_SIZE)
        least = 0.5 * np.median(blobs.contrast[small]) if small.any() else 0.0
        if (alike & (blobs.contrast >= least)).sum() >= LEAST_LARGE:
            return small | alike
    return small


def without_dim(shots: Sequence[Blobs], options: DetectionOptions) -> list[Blobs]:
    """Leave out the dim population of each frame of some snapshots.

    A frame that shows too few markers to tell takes over the usual limit of its camera.
    """
    if options.dim_blobs or options.threshold is not None:
        return list(shots)
    kept = [np.ones(len(shot.uv), bool) for shot in shots]
    for camera in range(1 + max((int(shot.camera.max(initial=-1)) for shot in shots), default=-1)):
        rows = [np.flatnonzero(shot.camera == camera) for shot in shots]
        limits = np.array([dim_limit(shot.contrast[mine]) for shot, mine in zip(shots, rows, strict=True)])
        shown = sum(len(mine) > 0 for mine in rows)
        usual = np.median(limits[limits > 0]) if (limits > 0).sum() > OFTEN * shown else 0.0
        for shot, mine, keep, limit in zip(shots, rows, kept, limits, strict=True):
            keep[mine] = shot.contrast[mine] >= (limit or usual)
    return [shot.select(keep) for shot, keep in zip(shots, kept, strict=True)]
