"""Where the blobs are: candidate components, found on block means so that each frame is read once."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection.options import DetectionOptions, Frame
from renderers.compiling import njit

BLOCK = 4  # px, side of a block; a 4 x 4 mean is close to the matched filter of a small blob
NOISE_FACTOR = 5.0  # candidates stand out of the block means by this many standard deviations
LEAST_CONTRAST = 0.006  # of full scale: below this, block means tell quantization steps rather than blobs
LEVELS = 5  # components that are too large are tried again at higher levels
LEVEL_STEP = 1.6  # from one level to the next
EDGE = 0.3  # of the level: what the blocks at the edge of a blob hold
SPLIT_AT = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # of a clipped peak: levels at which several are looked for
LEAST_CLIPPED = 4  # pixels of a peak in the midst of clipped ones
PEAK_FRACTION = 0.3  # of the local peak: keeps the skirts of neighbours apart


@dataclass(frozen=True)
class Screening:
    """Blocks of one frame that stand out of its background."""

    blocks: NDArray[np.int64]  # (K,) flat indices of blocks, ascending
    base: NDArray[np.floating]  # (K,) grey levels of the background
    excess: NDArray[np.floating]  # (K,) grey levels above the base that a pixel of a blob exceeds
    means: Frame  # (R, Q) grey levels of all blocks, inverted for dark blobs

    @property
    def shape(self) -> tuple[int, int]:
        """Blocks in a column and in a row of the frame."""
        return self.means.shape[0], self.means.shape[1]

    def bulk(self, least: float, most: float) -> float:
        """Grey levels of the brightest thing that is wider than `least` (px) and narrower than `most`."""
        cells = self.means[::4, ::4].copy()
        sides = (math.ceil(width / (4 * BLOCK)) for width in (least, most))
        wide, wider = (cv2.morphologyEx(cells, cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) for side in sides)
        return float(cv2.subtract(wide, wider).max())


@dataclass(frozen=True)
class Candidates:
    """Connected bright components of one frame. Their pixels are kept as tiles, one a block that holds any."""

    tile: NDArray[np.int32]  # (R + 2, Q + 2) tile of each block, 0 = empty; one empty block around the frame
    labels: NDArray[np.int32]  # (K + 1, 4, 4) component of each pixel of a tile, 0 = none
    boxes: NDArray[np.int64]  # (M, 4) left, top, right, bottom pixel (included)
    label: NDArray[np.int32]  # (M,) number of the component in `labels`
    whole: NDArray[np.int64]  # (M, 4) box of what the component is a part of: its own where it is whole

    @property
    def parted(self) -> NDArray[np.bool_]:
        """Mark the components that are parts of a larger one: (M,)."""
        return (self.whole != self.boxes).any(1)


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
    side = math.ceil((2 * options.radius_limit + 6) / BLOCK) + 1
    background = cv2.morphologyEx(means, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    contrast = cv2.subtract(means, background)
    floor, level = _levels(contrast, options, scale)
    local_peak = cv2.dilate(contrast, np.ones((3, 3), np.uint8))
    # Blocks that stand out, and those next to them that hold something.
    blocks = np.flatnonzero((local_peak > int(floor + level)) & (contrast > int(floor + EDGE * level)))
    local_peak = local_peak.ravel()[blocks] - floor
    # The mean of the 3 x 3 pixels around a pixel has 4/3 of the noise of a block mean.
    excess = np.maximum(level * 4 / 3, PEAK_FRACTION * local_peak)
    return Screening(blocks, background.ravel()[blocks] + floor, excess, means)


def outline(frame: Frame, screening: Screening, options: DetectionOptions, scale: int) -> Candidates:
    """Connect the bright pixels of the screened blocks; components too large are tried again at higher levels.

    Args:
        frame: (H, W) grey values, contiguous.
        screening: of this frame.
        options: polarity and radii.
        scale: largest grey value, for the inversion of dark blobs.
    """
    count = len(screening.blocks)
    tile = np.zeros((screening.shape[0] + 2, screening.shape[1] + 2), np.int32)
    smooth = _smooth_tiles(frame, screening.blocks, tile, scale if options.polarity == "dark" else -1)
    labels = np.empty((count + 1, BLOCK, BLOCK), np.int32)
    largest = 4 * options.radius_limit + 8  # merged blobs pass: they are to be reported
    level = screening.base + screening.excess
    raised, excess = np.arange(count), screening.excess
    for _ in range(LEVELS):
        _threshold(smooth, level, labels)
        boxes = _connect(screening.blocks, tile, labels)
        small = (boxes[:, 2:] - boxes[:, :2]).max(1, initial=0) < largest
        if small.all():
            break
        oversize = np.append(~small, False)[labels[raised + 1] - 1].any((1, 2))  # label 0, of no component: the last
        raised, excess = raised[oversize], LEVEL_STEP * excess[oversize]
        level[raised] = screening.base[raised] + excess
    saturation = 0.995 * scale if options.saturation is None else options.saturation
    whole, clipped = boxes, smooth.max(initial=-1) >= saturation
    merged = labels.copy() if clipped else labels
    if clipped and _split(screening, tile, smooth, level, merged, saturation):
        _threshold(smooth, level, labels)
        boxes = _connect(screening.blocks, tile, labels)
        whole = whole[_parents(merged, labels, len(boxes))]
        small = (boxes[:, 2:] - boxes[:, :2]).max(1, initial=0) < largest
    return Candidates(tile, labels, boxes[small], np.flatnonzero(small).astype(np.int32) + 1, whole[small])


def _split(
    screening: Screening,
    tile: NDArray[np.int32],
    smooth: NDArray[np.float32],
    level: NDArray[np.floating],
    labels: NDArray[np.int32],
    saturation: float,
) -> bool:
    """Raise levels (K,) where that parts a component into several clipped peaks, which the light around them joins.

    Returns:
        Whether there is any.
    """
    count = int(labels.max(initial=0))
    tops = _heights(smooth, screening.base, labels, count, saturation)  # above the base, 0 = not clipped
    if not tops.any():
        return False
    trial, top = np.empty_like(labels), tops[labels[1:]].max((1, 2))
    # What the highest level parts, and the lowest level that parts it as much.
    most, chosen = np.ones(count + 1, np.int64), np.zeros(count + 1)
    for part in SPLIT_AT[::-1]:
        _threshold(smooth, np.maximum(level, screening.base + part * top), trial)
        pieces = len(_connect(screening.blocks, tile, trial))
        peaks = _peaks(smooth, labels, trial, pieces, count, saturation)
        most = np.maximum(most, peaks)
        chosen[(peaks == most) & (most > 1)] = part
        if not (peaks > 1).any():
            break
    height = (chosen * tops)[labels[1:]].max((1, 2), initial=0)
    level[:] = np.where(height > 0, np.maximum(level, screening.base + height), level)
    return bool(chosen.any())


def _block_means(frame: Frame) -> Frame:
    """Average blocks of 4 x 4: (ceil(H / 4), ceil(W / 4)). Beyond the border the last row or column repeats."""
    height, width = (-(-n // BLOCK) for n in frame.shape)
    means = np.empty((height, width), frame.dtype)
    _average(frame, np.empty(BLOCK * width, np.uint16 if frame.dtype == np.uint8 else np.uint32), means)
    return means


@njit(cache=True, nogil=True)
def _average(frame, sums, means):
    """Fill the block means in one pass over the frame, which is far larger than the cache; (4 Q,) sums are scratch."""
    height, width = frame.shape
    for row in range(len(means)):
        first, second = frame[BLOCK * row], frame[min(BLOCK * row + 1, height - 1)]
        third, fourth = frame[min(BLOCK * row + 2, height - 1)], frame[min(BLOCK * row + 3, height - 1)]
        mean = means[row]
        for u in range(width):
            sums[u] = first[u] + second[u] + third[u] + fourth[u]
        for u in range(width, len(sums)):
            sums[u] = sums[width - 1]
        for q in range(len(mean)):
            mean[q] = (sums[4 * q] + sums[4 * q + 1] + sums[4 * q + 2] + sums[4 * q + 3] + 8) >> 4


def _levels(contrast: NDArray[np.generic], options: DetectionOptions, scale: int) -> tuple[float, float]:
    """Estimate what the opening leaves of an empty background, and how far above it a candidate must stand."""
    sample = np.sort(contrast[::8, ::8], axis=None, kind="stable")  # by radix: these are integers
    lower = sample[: max(1, int(0.6 * sample.size))]  # without the blobs and most of the texture
    noise = 1.54 * float(lower.std())  # the standard deviation of a normal variable below its 60th percentile
    level = max(NOISE_FACTOR * noise, LEAST_CONTRAST * scale)
    if options.threshold is not None:
        level = max(level, 0.2 * options.threshold)  # a block mean holds at least this part of a small blob's peak
    return float(sample[sample.size // 2]), level


@njit(cache=True, nogil=True)
def _smooth_tiles(frame, blocks, tile, invert):
    """Number the tiles, and average the 3 x 3 pixels around each of their pixels: (K, 4, 4), -1 outside the frame.

    `invert` is the grey value from which dark frames are subtracted, -1 = bright.
    """
    height, width = frame.shape
    smooth = np.empty((len(blocks), BLOCK, BLOCK), np.float32)
    smooth[:] = -1
    for k in range(len(blocks)):
        row, column = blocks[k] // (tile.shape[1] - 2), blocks[k] % (tile.shape[1] - 2)
        tile[row + 1, column + 1] = k + 1
        for v in range(row * BLOCK, min(row * BLOCK + BLOCK, height)):
            for u in range(column * BLOCK, min(column * BLOCK + BLOCK, width)):
                total = 0
                for y in range(v - 1, v + 2):
                    for x in range(u - 1, u + 2):
                        total += frame[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
                mean = np.float32(total) / np.float32(9)
                smooth[k, v % BLOCK, u % BLOCK] = np.float32(invert) - mean if invert >= 0 else mean
    return smooth


@njit(cache=True, nogil=True)
def _threshold(smooth, level, labels):
    """Mark the pixels above the level of their tile (K,) by -1, all others by 0; tile 0 is empty."""
    labels[0] = 0
    for k in range(len(smooth)):
        for i in range(BLOCK):
            for j in range(BLOCK):
                labels[k + 1, i, j] = -1 if smooth[k, i, j] > level[k] else 0


@njit(cache=True, nogil=True)
def _heights(smooth, base, labels, count, saturation):
    """Height (count + 1,) above the base of each component that is clipped, 0 of all others."""
    heights = np.zeros(count + 1)
    for k in range(len(smooth)):
        for i in range(BLOCK):
            for j in range(BLOCK):
                if labels[k + 1, i, j] > 0 and smooth[k, i, j] >= saturation:
                    heights[labels[k + 1, i, j]] = max(heights[labels[k + 1, i, j]], smooth[k, i, j] - base[k])
    return heights


@njit(cache=True, nogil=True)
def _peaks(smooth, labels, parts, pieces, count, saturation):
    """Number of clipped peaks (count + 1,) in each component of `labels`, of the `parts` into which a level cuts it."""
    clipped, parent = np.zeros(pieces + 1, np.int64), np.zeros(pieces + 1, np.int64)
    for k in range(len(smooth)):
        for i in range(BLOCK):
            for j in range(BLOCK):
                parent[parts[k + 1, i, j]] = labels[k + 1, i, j]
                clipped[parts[k + 1, i, j]] += smooth[k, i, j] >= saturation
    peaks = np.zeros(count + 1, np.int64)
    for piece in range(1, pieces + 1):
        peaks[parent[piece]] += clipped[piece] >= LEAST_CLIPPED
    return peaks


@njit(cache=True, nogil=True)
def _parents(merged, labels, count):
    """Component (counted from 0) of `merged` that each of the `count` components of `labels` is a part of."""
    parents = np.zeros(count, np.int64)
    for k in range(1, len(labels)):
        for i in range(BLOCK):
            for j in range(BLOCK):
                if labels[k, i, j] > 0:
                    parents[labels[k, i, j] - 1] = merged[k, i, j] - 1
    return parents


@njit(cache=True, nogil=True)
def _place(tile, v, u):
    """Place of a pixel, counted from the empty blocks around the frame, among all pixels of all tiles."""
    return np.uint32(tile[np.uint32(v) >> 2, np.uint32(u) >> 2] * BLOCK * BLOCK + (v & 3) * BLOCK + (u & 3))


@njit(cache=True, nogil=True)
def _connect(blocks, tile, labels):
    """Number the components (eight neighbours) of the marked pixels from 1, in place; return their boxes (M, 4)."""
    columns, flat = tile.shape[1] - 2, labels.reshape(-1)
    stack = np.empty((4 * BLOCK * BLOCK * len(blocks), 2), np.int32)  # a run of L pixels touches at most L + 3 runs
    boxes = np.empty((4 * len(blocks), 4), np.int64)  # no more than four separate pixels fit into a tile
    count = 0
    for k in range(len(blocks)):
        # Pixels are counted from the empty blocks around the frame.
        top, left = BLOCK * (blocks[k] // columns + 1), BLOCK * (blocks[k] % columns + 1)
        for i in range(BLOCK):
            for j in range(BLOCK):
                if labels[k + 1, i, j] >= 0:
                    continue
                box = boxes[count]
                count += 1
                box[0], box[1], box[2], box[3] = left + j, top + i, left + j, top + i
                stack[0, 0], stack[0, 1], size = top + i, left + j, 1
                while size:
                    size -= 1
                    v, first = stack[size, 0], stack[size, 1]
                    # The whole run of marked pixels in this row, then the runs that touch it above and below.
                    while flat[_place(tile, v, first - 1)] < 0:
                        first -= 1
                    last = first
                    while flat[_place(tile, v, last)] < 0:
                        flat[_place(tile, v, last)] = count
                        last += 1
                    if last == first:
                        continue
                    box[0], box[1] = min(box[0], first), min(box[1], v)
                    box[2], box[3] = max(box[2], last - 1), max(box[3], v)
                    for y in (v - 1, v + 1):
                        inside = False
                        for x in range(first - 1, last + 1):
                            marked = flat[_place(tile, y, x)] < 0
                            if marked and not inside:
                                stack[size, 0], stack[size, 1] = y, x
                                size += 1
                            inside = marked
    return boxes[:count] - BLOCK
