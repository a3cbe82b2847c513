"""Accurate blob centres: the fit of a blurred ellipse above the local background, or the weighted centroid.

Each blob is measured in its own window, which is visited a few times while it is in the cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.candidates import Candidates
from imgcal.detection.checks import Frame
from imgcal.detection.kernels import measure_all
from imgcal.detection.options import DetectionOptions
from imgcal.types import Detections


@dataclass(frozen=True)
class Blobs:
    """Measured blobs of one snapshot, one row each; see `Detections` for the columns."""

    uv: NDArray[np.float64]  # (K, 2) pixels
    sigma: NDArray[np.float64]  # (K,) pixels
    radius: NDArray[np.float64]  # (K,) pixels
    flags: NDArray[np.uint8]  # (K,) BlobFlag bits
    camera: NDArray[np.int64]  # (K,) index of the frame
    contrast: NDArray[np.float64]  # (K,) brightest pixel above the background, share of full scale
    fiducial: NDArray[np.int64]  # (K,) label, -1 = unknown from the image
    blur: NDArray[np.float64]  # (K,) pixels, Gaussian blur of the edge; 0 = unknown

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Blobs:
        """Keep some of the K blobs, given as a mask (K,) or as indices."""
        return Blobs(*(getattr(self, field.name)[rows] for field in fields(self)))


def to_detections(shots: Sequence[Blobs], camera_names: tuple[str, ...], snapshot_names: tuple[str, ...]) -> Detections:
    """Stack the blobs of one or several snapshots: rows run over snapshots, then cameras.

    Args:
        shots: blobs of each snapshot, at least one.
        camera_names: names of the cameras that `Blobs.camera` indexes.
        snapshot_names: one for each snapshot.
    """
    names = ("uv", "sigma", "radius", "flags", "camera", "fiducial")
    uv, sigma, radius, flags, camera, fiducial = (
        np.concatenate([getattr(shot, name) for shot in shots]) for name in names
    )
    return Detections(
        uv=uv,
        sigma=sigma,
        camera=camera,
        snapshot=np.repeat(np.arange(len(shots)), [len(shot.uv) for shot in shots]),
        fiducial=fiducial,
        radius=radius,
        flags=flags,
        camera_names=camera_names,
        snapshot_names=snapshot_names,
    )


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
    blobs = Blobs(
        np.zeros((count, 2)), np.zeros(count), np.zeros(count), np.zeros(count, np.uint8), np.zeros(count, np.int64),
        np.zeros(count), np.full(count, -1, np.int64), np.zeros(count),
    )  # fmt: skip
    kept = np.zeros(count, np.bool_)
    saturation = options.first_clipped(scale)
    least = 0.0 if options.threshold is None else options.threshold
    limits = (least, options.min_radius, options.radius_limit, options.max_elongation)
    # Options may be whole numbers: without `float`, the kernel would be compiled again for them.
    measure_all(
        frame,
        (candidates.tile, candidates.labels, boxes, candidates.label, candidates.whole),
        (scale, scale if options.polarity == "dark" else -1, float(saturation)),
        tuple(map(float, limits)),
        (blobs.uv, blobs.sigma, blobs.radius, blobs.contrast, blobs.flags, blobs.blur, kept),
    )
    return blobs.select(_first(blobs, kept))


def _first(blobs: Blobs, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the kept blobs without duplicates at the same pixel: components of one blob that was found in pieces."""
    rows = np.flatnonzero(kept)
    places = [(round(u), round(v)) for u, v in blobs.uv[rows].tolist()]
    if len(set(places)) == len(places):
        return rows
    first = dict(zip(reversed(places), reversed(rows.tolist()), strict=True))
    return np.array(sorted(first.values()))
