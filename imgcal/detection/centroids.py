"""How exactly a blob lies where: a blurred ellipse fitted above the local background, else the weighted centroid.

Each blob is measured in a window of its own that is walked a few times while it is in the cache.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.candidates import Candidates
from imgcal.detection.kernels import measure_all
from imgcal.detection.options import DetectionOptions, Frame
from imgcal.types import BlobFlag

HALF_SIZES = (7, 10, 14, 20, 29, 42, 60)  # px; windows of 2 h + 1
REACH = 4  # px from a component to the end of its window: the skirt and a ring that is clear of it


@dataclass(frozen=True)
class Blobs:
    """Measured blobs of one snapshot, one row each; see `Detections` for the columns."""

    uv: NDArray[np.float64]  # (K, 2) pixels
    sigma: NDArray[np.float64]  # (K,) pixels
    radius: NDArray[np.float64]  # (K,) pixels
    flags: NDArray[np.uint8]  # (K,) BlobFlag bits
    camera: NDArray[np.int64]  # (K,) which of the frames
    contrast: NDArray[np.float64]  # (K,) brightest pixel above the background, share of full scale

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Blobs:
        """Keep the given rows."""
        return Blobs(*(getattr(self, field.name)[rows] for field in fields(self)))


def measure(frame: Frame, candidates: Candidates, options: DetectionOptions, scale: int) -> Blobs:
    """Measure the candidates of one frame, and keep those that are blobs; their camera is 0.

    Args:
        frame: (H, W) grey values, contiguous.
        candidates: of this frame.
        options: what counts as a blob.
        scale: largest grey value.
    """
    boxes = candidates.boxes
    count = len(boxes)
    half = half_sizes(boxes, candidates.whole)
    blobs = Blobs(
        np.zeros((count, 2)), np.zeros(count), np.zeros(count), np.zeros(count, np.uint8), np.zeros(count, np.int64),
        np.zeros(count),
    )  # fmt: skip
    kept = np.zeros(count, np.bool_)
    saturation = 0.995 * scale if options.saturation is None else options.saturation
    least = 0.0 if options.threshold is None else options.threshold
    limits = (least, options.min_radius, options.radius_limit, options.max_elongation)
    measure_all(
        frame, candidates.tile, candidates.labels, boxes, candidates.label, candidates.parted, half,
        scale if options.polarity == "dark" else -1, saturation, limits,
        blobs.uv, blobs.sigma, blobs.radius, blobs.contrast, blobs.flags, kept,
    )  # fmt: skip
    blobs.contrast[:] /= scale
    last = np.array(frame.shape[::-1]) - 1
    blobs.flags[((boxes[:, :2] <= 1) | (boxes[:, 2:] >= last - 1)).any(1)] |= np.uint8(BlobFlag.BORDER)
    return blobs.select(_first(blobs, kept))


def half_sizes(boxes: NDArray[np.int64], whole: NDArray[np.int64]) -> NDArray[np.int64]:
    """Half sizes (K,) of windows around boxes (K, 4): the smallest that hold what they are parts of.

    Only around that is the background.
    """
    middle = (boxes[:, :2] + boxes[:, 2:]) // 2
    reach = np.maximum(whole[:, 2:] - middle, middle - whole[:, :2]).max(1, initial=0) + REACH
    return np.array(HALF_SIZES)[np.searchsorted(HALF_SIZES[:-1], reach)]


def _first(blobs: Blobs, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the kept blobs without those that lie on an earlier one: components of one blob found in pieces."""
    rows = np.flatnonzero(kept)
    pixel = np.rint(blobs.uv[rows]).astype(np.int64)
    return rows[np.sort(np.unique((pixel[:, 1] << 32) + pixel[:, 0], return_index=True)[1])]
