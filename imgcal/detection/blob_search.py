"""Blobs of all sizes in one frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imgcal.detection.candidates import block_means, outline, screen
from imgcal.detection.centroids import Blobs, measure
from imgcal.detection.checks import Frame
from imgcal.detection.options import DetectionOptions
from imgcal.detection.populations import DIMMER, select_usable, usual_size
from imgcal.detection.soft_blobs import halve_frame, has_soft_blobs, replace_soft
from imgcal.medians import median

LARGER = 32.0  # px, largest radius that a search with the usual limit still finds
LARGEST = 48.0  # px, largest radius that fits the windows
FEW = 4  # usable blobs of a frame below which the search for much larger ones is finer


def find_blobs(frame: Frame, options: DetectionOptions, scale: int) -> Blobs:
    """Find the blobs of a frame, and soft ones again at half its resolution; their camera is 0.

    Args:
        frame: (H, W) grey values.
        options: what counts as a blob; without a largest radius, larger blobs are found where several have one size.
        scale: largest grey value.
    """
    contiguous = frame if frame.flags.c_contiguous else frame.copy()
    if options.max_radius is None:
        blobs = _find_all_sizes(contiguous, options, scale)
    else:
        blobs = _find(contiguous, block_means(contiguous, options, scale), options, scale)
    if has_soft_blobs(blobs, frame):
        return replace_soft(blobs, find_blobs(*halve_frame(frame, options, scale)))
    return blobs


def _find_all_sizes(frame: Frame, options: DetectionOptions, scale: int) -> Blobs:
    """Find blobs of the usual sizes, and larger ones where there are several of one size.

    The first search also finds most of the larger ones. A frame is searched again if it has no blob, or something large
    that is as bright as its blobs; with hardly any blob, the check for the latter is finer.
    """
    limit, means = options.radius_limit, block_means(frame, options, scale)
    screening = screen(means, options, scale)
    blobs = measure(frame, outline(frame, screening, options, scale), replace(options, max_radius=LARGER), scale)
    kept = usual_size(blobs, limit)
    blobs = blobs if kept.all() else blobs.select(kept)
    if len(blobs.uv):
        least, step = (LARGER, 4) if np.count_nonzero(select_usable(blobs)) >= FEW else (limit, 1)
        if not screening.holds(DIMMER * scale * median(blobs.contrast), least, 2 * LARGEST, step):
            return blobs
    wide = _find(frame, means, replace(options, max_radius=LARGEST), scale)
    wide = wide.select(usual_size(wide, limit))
    return wide if (wide.radius > limit).any() else blobs


def _find(frame: Frame, means: Frame, options: DetectionOptions, scale: int) -> Blobs:
    return measure(frame, outline(frame, screen(means, options, scale), options, scale), options, scale)
