"""Separation of markers from blobs that are far dimmer (paint, scratches, faint reflections) or of another size.

Markers of one object are alike: distance, angle and illumination change their peaks by a small factor, and those in
between fill the range. Blobs close to the background that are several times dimmer than all the others, with nothing in
between, are not markers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.centroids import Blobs
from imgcal.detection.options import DetectionOptions
from imgcal.medians import median
from imgcal.types import UNUSABLE

GAP = 3.0  # ratio of neighbouring contrasts between two populations
DIM = 0.08  # of full scale: the dim population is below, the bright one above
LEAST_BRIGHT = 3  # smallest number of blobs of the bright population in a frame
ONE_SIZE = 1.6  # largest ratio of radii of markers of one size
DIMMER = 0.5  # relative to the usual contrast of blobs of usual size: dimmer ones are no larger markers
LEAST_LARGE = 3  # smallest number of blobs of one size above the usual limit
OFTEN = 0.25  # share of a camera's frames with a limit from which it applies to the other frames, too
_UNUSABLE = int(UNUSABLE)


def dim_limits(contrast: NDArray[np.floating], group: NDArray[np.integer], groups: int) -> NDArray[np.float64]:
    """Contrast (G,) that separates two populations within a group of blobs, 0 where there is only one.

    Args:
        contrast: (K,) peaks above the background, shares of full scale.
        group: (K,) index of each blob's group, 0 to G - 1.
        groups: G.
    """
    bright = contrast > DIM
    above, below = np.full(groups, np.inf), np.zeros(groups)  # bounds of the gap about `DIM`
    np.minimum.at(above, group[bright], contrast[bright])
    np.maximum.at(below, group[~bright], contrast[~bright])
    apart = (below < DIM) & (above / np.maximum(below, 1e-9) >= GAP)
    apart &= np.bincount(group[bright], minlength=groups) >= LEAST_BRIGHT
    return np.where(apart, np.sqrt(np.where(apart, above, 0.0) * below), 0.0)


def select_usable(blobs: Blobs) -> NDArray[np.bool_]:
    """Select blobs with usable centres: (K,)."""
    return (blobs.flags & _UNUSABLE) == 0


def usual_size(blobs: Blobs, limit: float) -> NDArray[np.bool_]:
    """Select blobs (K,) up to a radius `limit` (px), and larger ones if several have one size and enough contrast."""
    small = blobs.radius <= limit
    if small.all():
        return small
    large = ~small & select_usable(blobs)
    if large.sum() >= LEAST_LARGE:
        ratio = blobs.radius / median(blobs.radius[large])
        alike = large & (ratio < ONE_SIZE) & (ratio > 1 / ONE_SIZE)
        least = DIMMER * median(blobs.contrast[small]) if small.any() else 0.0
        if (alike & (blobs.contrast >= least)).sum() >= LEAST_LARGE:
            return small | alike
    return small


def drop_dim(shots: Sequence[Blobs], options: DetectionOptions) -> list[Blobs]:
    """Remove the dim population from each frame of some snapshots.

    A frame with too few markers for a decision uses its camera's usual limit.
    """
    if options.dim_blobs or options.threshold is not None or not shots:
        return list(shots)
    contrast = np.concatenate([shot.contrast for shot in shots])
    if contrast.min(initial=1.0) > DIM:
        return list(shots)
    camera = np.concatenate([shot.camera for shot in shots])
    cameras, counts = int(camera.max()) + 1, [len(shot.uv) for shot in shots]
    frame = np.repeat(np.arange(len(shots)), counts) * cameras + camera
    shown = np.bincount(frame, minlength=len(shots) * cameras).reshape(-1, cameras) > 0
    limits = dim_limits(contrast, frame, shown.size).reshape(shown.shape)
    for own, some in zip(limits.T, shown.sum(0), strict=True):
        known = own[own > 0]
        if len(known) > OFTEN * some:
            own[own == 0] = median(known)
    kept = contrast >= limits.reshape(-1)[frame]
    return [
        shot if keep.all() else shot.select(keep)
        for shot, keep in zip(shots, np.split(kept, np.cumsum(counts)[:-1]), strict=True)
    ]
