"""Where the blobs are: candidate components, found on block means so that each frame is read once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from imgcal.detection.options import DetectionOptions, Frame

BLOCK = 4  # px, side of a block; a 4 x 4 mean is close to the matched filter of a small blob
NOISE_FACTOR = 5.0  # candidates stand out of the block means by this many standard deviations
LEAST_CONTRAST = 0.006  # of full scale: below this, block means tell quantization steps rather than blobs
LEVELS = 5  # components that are too large are tried again at higher levels
EDGE = 0.3  # of the level: what the blocks at the edge of a blob hold
PEAK_FRACTION = 0.3  # of the local peak: keeps the skirts of neighbours apart


@dataclass(frozen=True)
class Screening:
    """Blocks of one frame that stand out of its background."""

    blocks: NDArray[np.int64]  # (K,) flat indices of blocks
    base: NDArray[np.floating]  # (K,) grey levels of the background
    excess: NDArray[np.floating]  # (K,) grey levels above the base that a pixel of a blob exceeds
    shape: tuple[int, int]  # blocks in a column and in a row of the frame


@dataclass(frozen=True)
class Candidates:
    """Connected bright components of several frames."""

    mask: NDArray[np.uint8]  # (R, W) 255 on the components: the rows that hold any, of all frames below each other
    rows: list[NDArray[np.int64]]  # (H,) of each frame: row of the mask that stands for a row of the frame, 0 = empty
    frame: NDArray[np.int64]  # (K,) which frame
    boxes: NDArray[np.int64]  # (K, 4) left, top, right, bottom pixel (included)
    seeds: NDArray[np.int64]  # (K, 2) one pixel (u, v) of each component

    @property
    def centres(self) -> NDArray[np.int64]:
        """Middle pixels of the boxes: (K, 2)."""
        return (self.boxes[:, :2] + self.boxes[:, 2:]) // 2


def screen(frame: Frame, options: DetectionOptions, scale: int) -> Screening:
    """Find the blocks of `frame` that are brighter (darker) than their surroundings.

    Args:
        frame: (H, W) grey values.
        options: polarity, threshold and radii.
        scale: largest grey value, for the inversion of dark blobs.
    """
    means = _block_means(frame)
    if options.polarity == "dark":
        means = scale - means
    # An opening follows steps of the background (paper on a table), which a median would smear; blobs are smaller.
    side = math.ceil((2 * options.max_radius + 6) / BLOCK) + 1
    background = cv2.morphologyEx(means, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    contrast = cv2.subtract(means, background)
    floor, level = _levels(contrast, options, scale)
    local_peak = cv2.dilate(contrast, np.ones((3, 3), np.uint8))
    # Blocks that stand out, and those next to them that hold something.
    blocks = np.flatnonzero((local_peak > int(floor + level)) & (contrast > int(floor + EDGE * level)))
    local_peak = local_peak.ravel()[blocks] - floor
    # The mean of the 3 x 3 pixels around a pixel has 4/3 of the noise of a block mean.
    excess = np.maximum(level * 4 / 3, PEAK_FRACTION * local_peak)
    return Screening(blocks, background.ravel()[blocks] + floor, excess, (means.shape[0], means.shape[1]))


def outline(
    frames: list[Frame], screenings: list[Screening], options: DetectionOptions, scales: list[int]
) -> Candidates:
    """Outline the components of several frames at once; those too large are tried again at higher levels."""
    heights = np.array([screening.shape[0] + 1 for screening in screenings])  # an empty row between frames
    first = np.cumsum(heights) - heights
    columns = max(screening.shape[1] for screening in screenings)
    blocks = np.concatenate([screening.blocks for screening in screenings])
    counts = [len(screening.blocks) for screening in screenings]
    row, column = np.divmod(blocks, np.repeat([screening.shape[1] for screening in screenings], counts))
    row += np.repeat(first, counts)
    mask_rows = _mask_rows(row, int(heights.sum()))
    row = mask_rows[row]
    mask = np.zeros(((mask_rows.max() + 2) * BLOCK, columns * BLOCK), np.uint8)
    tiles = mask.reshape(-1, BLOCK, columns, BLOCK)
    base = np.concatenate([screening.base for screening in screenings])
    excess = np.concatenate([screening.excess for screening in screenings])
    smooth = _smooth_pixels(frames, screenings, scales if options.polarity == "dark" else None)
    contours: list[MatLike] = []
    for _ in range(LEVELS):
        tiles[row, :, column, :] = np.where(smooth > (base + excess)[:, None, None], 255, 0)
        contours, oversize = _components(mask, 4 * options.max_radius + 8)  # merged blobs pass: they are to be reported
        if oversize is None:
            break
        raised = oversize.reshape(tiles.shape)[row, :, column, :].any((1, 2))
        row, column, base, smooth, excess = (
            row[raised],
            column[raised],
            base[raised],
            smooth[raised],
            1.6 * excess[raised],
        )
    return _candidates(mask, mask_rows, first, contours, [frame.shape for frame in frames])


def _block_means(frame: Frame) -> MatLike:
    """Average blocks of 4 x 4: (ceil(H / 4), ceil(W / 4)). Two halvings are much faster than one resize by four."""
    height, width = (-(-n // BLOCK) * BLOCK for n in frame.shape)
    if (height, width) != frame.shape:
        pad = (0, height - frame.shape[0], 0, width - frame.shape[1])
        padded = cv2.copyMakeBorder(frame, *pad, cv2.BORDER_REPLICATE)
    else:
        padded = frame
    half = cv2.resize(padded, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(half, (width // 4, height // 4), interpolation=cv2.INTER_AREA)


def _levels(contrast: MatLike, options: DetectionOptions, scale: int) -> tuple[float, float]:
    """Estimate what the opening leaves of an empty background, and how far above it a candidate must stand."""
    sample = np.sort(contrast[::8, ::8], axis=None)
    lower = sample[: max(1, int(0.6 * sample.size))]  # without the blobs and most of the texture
    noise = 1.54 * float(lower.std())  # the standard deviation of a normal variable below its 60th percentile
    level = max(NOISE_FACTOR * noise, LEAST_CONTRAST * scale)
    if options.threshold is not None:
        level = max(level, 0.2 * options.threshold)  # a block mean holds at least this part of a small blob's peak
    return float(sample[sample.size // 2]), level


def _mask_rows(used: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Number the rows of blocks that are in use from 1, with an empty one between bands: (count,), 0 = not in use.

    A sparse frame then needs a mask of a fraction of its size, and outlining the components costs as much less.
    """
    in_use = np.zeros(count, np.bool_)
    in_use[used] = True
    starts = in_use & ~np.concatenate([[False], in_use[:-1]])
    return np.where(in_use, np.cumsum(in_use) + np.cumsum(starts) - 1, 0)


def _smooth_pixels(frames: list[Frame], screenings: list[Screening], invert: list[int] | None) -> NDArray[np.floating]:
    """Average the 3 x 3 pixels around each pixel of the screened blocks: (K, 4, 4), bright polarity."""
    reach = np.arange(-1, BLOCK + 1)
    parts = []
    for frame, screening in zip(frames, screenings, strict=True):
        row, column = np.divmod(screening.blocks, screening.shape[1])
        v = np.clip(row[:, None] * BLOCK + reach, 0, frame.shape[0] - 1) * frame.shape[1]
        u = np.clip(column[:, None] * BLOCK + reach, 0, frame.shape[1] - 1)
        parts.append(frame.take(v[:, :, None] + u[:, None, :]))  # (K, 6, 6)
    pixels: NDArray[np.floating] = np.concatenate(parts).astype(np.float32)
    pixels = pixels[:, :-2] + pixels[:, 1:-1] + pixels[:, 2:]
    pixels = (pixels[:, :, :-2] + pixels[:, :, 1:-1] + pixels[:, :, 2:]) / 9
    if invert is not None:
        pixels = np.repeat(np.array(invert, np.float32), [len(part) for part in parts])[:, None, None] - pixels
    return pixels


def _components(mask: NDArray[np.uint8], largest: float) -> tuple[list[MatLike], NDArray[np.uint8] | None]:
    """Outline the components of the mask up to the size `largest`, and draw those beyond: (R, W'), None without any."""
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    kept, oversize = [], None
    for index, contour in enumerate(contours):
        if hierarchy[0, index, 3] >= 0:  # a hole
            continue
        if max(cv2.boundingRect(contour)[2:]) <= largest:
            kept.append(contour)
        else:
            oversize = np.zeros_like(mask) if oversize is None else oversize
            cv2.drawContours(oversize, contours, index, 255, cv2.FILLED, hierarchy=hierarchy, maxLevel=1)
    return kept, oversize


def _candidates(
    mask: NDArray[np.uint8],
    mask_rows: NDArray[np.int64],
    first: NDArray[np.int64],
    contours: list[MatLike],
    shapes: list[tuple[int, ...]],
) -> Candidates:
    """Bound the outlined components in pixels of their frames; those inside the padding of a frame are dropped."""
    used = np.flatnonzero(mask_rows)
    block_row = np.zeros(mask.shape[0] // BLOCK, np.int64)
    block_row[mask_rows[used]] = used
    rectangles = np.array([cv2.boundingRect(contour) for contour in contours], np.int64).reshape(-1, 4)
    seeds = np.array([contour[0, 0] for contour in contours], np.int64).reshape(-1, 2)
    points = np.stack([rectangles[:, :2], rectangles[:, :2] + rectangles[:, 2:] - 1, seeds])  # (3, K, 2)
    block = block_row[points[..., 1] // BLOCK]
    frame = np.searchsorted(first, block[0], side="right") - 1
    points[..., 1] = (block - first[frame]) * BLOCK + points[..., 1] % BLOCK
    limit = np.array([(width, height) for height, width in shapes])[frame]
    inside = (points[0] < limit).all(1)
    points = np.minimum(points, limit - 1)[:, inside]
    pixel_rows = (mask_rows[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    rows = [pixel_rows[start * BLOCK :][: shape[0]] for start, shape in zip(first.tolist(), shapes, strict=True)]
    return Candidates(mask, rows, frame[inside], np.hstack([points[0], points[1]]), points[2])
