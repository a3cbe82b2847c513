"""Soft blobs, as of a lens out of focus: they are measured in a frame of half the resolution.

The light of a soft blob reaches beyond the window that suits a sharp one, and its wide skirt breaks up into blobs of
their own. At half the resolution it is half as soft, and hardly any information about its centre is lost.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.centroids import Blobs
from imgcal.detection.checks import Frame
from imgcal.detection.options import DetectionOptions
from imgcal.detection.populations import select_usable
from imgcal.types import BlobFlag

SOFT = 1.75  # px, blur of a soft blob: the windows suit blobs up to a blur of 2 px
LEAST_SOFT = 1.3  # px, least blur of a blob that is replaced by a soft one: noise may make it seem sharper
SMOOTH = 0.7  # of the radius: largest blur of a smooth spot, even a Gaussian one; irregular shapes seem to have more
SAME_SIZE = 1.6  # largest ratio of a blob's radii in the two frames
SKIRT = 2.0  # radii of a soft blob within which its skirt breaks up
LEAST_SIDE = 64  # px, of a frame that is halved
DEEPEST = 65535  # largest grey value that a frame can hold
_MERGED = np.uint8(BlobFlag.MERGED)


def has_soft_blobs(blobs: Blobs, frame: Frame) -> bool:
    """Check whether any usable blob of a frame is soft, and the frame large enough to be halved."""
    if min(frame.shape) < LEAST_SIDE or blobs.blur.max(initial=0.0) < SOFT:  # nearly always
        return False
    return bool((_select_smooth(blobs, SOFT) & select_usable(blobs)).any())


def halve_frame(frame: Frame, options: DetectionOptions, scale: int) -> tuple[Frame, DetectionOptions, int]:
    """Sum blocks of 2 x 2 pixels, or average them if sums exceed 16 bit. A block with a clipped pixel is clipped.

    An odd last row or column is left out.

    Args:
        frame: (H, W) grey values.
        options: what counts as a blob in this frame.
        scale: largest grey value.

    Returns:
        (H // 2, W // 2) uint16 grey values; what counts as a blob there; its largest grey value.
    """
    height, width = (n // 2 * 2 for n in frame.shape)
    parts = [frame[i:height:2, j:width:2] for i in (0, 1) for j in (0, 1)]
    gain = 4 if 4 * scale <= DEEPEST else 1
    total = parts[0].astype(np.uint32) + parts[1] + parts[2] + parts[3]
    halves = total if gain == 4 else (total + 2) // 4
    saturation = options.first_clipped(scale)
    if options.polarity == "dark":
        halves[np.minimum.reduce(parts) <= scale - saturation] = 0
    else:
        halves[np.maximum.reduce(parts) >= saturation] = gain * scale
    suited = replace(
        options,
        threshold=None if options.threshold is None else min(gain * options.threshold, DEEPEST),
        min_radius=options.min_radius / 2,
        max_radius=None if options.max_radius is None else options.max_radius / 2,
        saturation=gain * saturation,
    )
    return halves.astype(np.uint16), suited, gain * scale


def replace_soft(blobs: Blobs, halved: Blobs) -> Blobs:
    """Replace soft blobs by those of the halved frame, and remove the pieces of their skirts.

    Args:
        blobs: K blobs of a frame.
        halved: blobs of the halved frame, in its pixels.

    Returns:
        At most K blobs in the same order. A soft one is flagged as merged if it is in the halved frame.
    """
    coarse = replace(
        halved, uv=2 * halved.uv + 0.5, sigma=2 * halved.sigma, radius=2 * halved.radius, blur=2 * halved.blur
    )
    smooth, merged = _select_smooth(blobs, LEAST_SOFT), (blobs.flags & _MERGED) > 0
    rows = np.flatnonzero(smooth | merged)
    if not len(rows) or not len(coarse.uv):
        return blobs
    distance = np.linalg.norm(blobs.uv[rows, None] - coarse.uv, axis=-1)
    near, away = distance.argmin(1), distance.min(1)  # (R,) rows of `coarse`, px
    radius = coarse.radius[near]
    ratio = blobs.radius[rows] / radius
    same = smooth[rows] & (away < radius) & (ratio < SAME_SIZE) & (ratio > 1 / SAME_SIZE)
    doubtful = same & ((coarse.flags[near] & _MERGED) > 0) & (blobs.blur[rows] > SOFT)
    same &= _select_smooth(coarse, SOFT)[near]
    found, first = np.unique(near[same], return_index=True)  # one of several pieces is replaced
    replaced = rows[same][first]
    pieces = np.isin(near, found) & (same | (merged[rows] & (away < SKIRT * radius)))
    columns = {field.name: getattr(blobs, field.name).copy() for field in fields(Blobs)}
    columns["flags"][rows[doubtful]] |= _MERGED
    for name, column in columns.items():
        column[replaced] = getattr(coarse, name)[found]
    kept = np.ones(len(blobs.uv), np.bool_)
    kept[rows[pieces]] = False
    kept[replaced] = True
    return Blobs(**columns).select(kept)


def _select_smooth(blobs: Blobs, least: float) -> NDArray[np.bool_]:
    """Select smooth spots (K,) with a blur of more than `least` px; that of a clipped one is not known well enough."""
    clipped = (blobs.flags & np.uint8(BlobFlag.SATURATED)) > 0
    return (blobs.blur > least) & (blobs.blur < SMOOTH * blobs.radius) & ~clipped
