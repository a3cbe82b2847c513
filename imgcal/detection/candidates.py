"""Candidate components for blobs, found on block means so that each frame is read only once."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection.checks import Frame
from imgcal.detection.options import DetectionOptions
from renderers.compiling import njit

BLOCK = 4  # px, side of a block; a 4 x 4 mean is close to the matched filter of a small blob
NOISE_FACTOR = 5.0  # standard deviations of the block means by which candidates exceed the background
LEAST_CONTRAST = 0.006  # of full scale: below this, block means show quantization steps rather than blobs
LEVELS = 5  # attempts with increasing levels for components that are too large
LEVEL_STEP = 1.6  # factor from one level to the next
EDGE = 0.3  # of the level: smallest contrast of the blocks at the edge of a blob
SPLIT_AT = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # of a clipped peak: levels at which it may split into several
LEAST_CLIPPED = 4  # clipped pixels of a clipped peak
PEAK_FRACTION = 0.3  # of the local peak: keeps the skirts of neighbours apart


@dataclass(frozen=True)
class Screening:
    """Blocks of one frame that are brighter than its background."""

    blocks: NDArray[np.int64]  # (K,) flat indices of blocks, ascending
    base: NDArray[np.floating]  # (K,) grey levels of the background
    excess: NDArray[np.floating]  # (K,) grey levels above the base, threshold for the pixels of a blob
    means: Frame  # (R, Q) grey levels of all blocks, inverted for dark blobs

    @property
    def shape(self) -> tuple[int, int]:
        """Number of blocks along a column and along a row of the frame."""
        return self.means.shape[0], self.means.shape[1]

    def holds(self, height: float, least: float, most: float, step: int = 1) -> bool:
        """Check for anything `height` grey levels bright that is wider than `least` (px) and narrower than `most`.

        Only every `step`-th block along each axis is used.
        """
        cells = self.means[::step, ::step].copy()
        wide, wider = (math.ceil(width / (step * BLOCK)) for width in (least, most))
        worn = cv2.erode(cells, np.ones((wide, wide), np.uint8))
        if int(worn.max()) - int(cells.min()) < height:  # the usual case: nothing is that wide
            return False
        large, larger = (cv2.morphologyEx(cells, cv2.MORPH_OPEN, np.ones((n, n), np.uint8)) for n in (wide, wider))
        return float(cv2.subtract(large, larger).max()) >= height


@dataclass(frozen=True)
class Candidates:
    """Connected bright components of one frame. Their pixels are stored as tiles, one per non-empty block."""

    tile: NDArray[np.int32]  # (R + 2, Q + 2) tile of each block, 0 = empty; one empty block around the frame
    labels: NDArray[np.int32]  # (K + 1, 4, 4) component of each pixel of a tile, 0 = none
    boxes: NDArray[np.int64]  # (M, 4) left, top, right, bottom pixel (included)
    label: NDArray[np.int32]  # (M,) number of the component in `labels`
    whole: NDArray[np.int64]  # (M, 4) box of the component before it was split; its own box if it was not


def screen(means: Frame, options: DetectionOptions, scale: int) -> Screening:
    """Find the blocks of a frame that are brighter (darker) than their surroundings.

    Args:
        means: (R, Q) grey levels of its blocks.
        options: threshold and radii.
        scale: largest grey value.
    """
    # An opening follows steps of the background (paper on a table), which a median would smear; it removes blobs.
    side = math.ceil((2 * options.radius_limit + 6) / BLOCK) + 1
    background = cv2.morphologyEx(means, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    contrast = cv2.subtract(means, background)
    floor, level = _levels(contrast, options, scale)
    local_peak = cv2.dilate(contrast, np.ones((3, 3), np.uint8))
    blocks, base, excess = _select(contrast, local_peak, background, floor, level)
    return Screening(blocks, base, excess, means)


def outline(frame: Frame, screening: Screening, options: DetectionOptions, scale: int) -> Candidates:
    """Connect the bright pixels of the screened blocks; components that are too large are retried at higher levels.

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
    largest = 4.0 * options.radius_limit + 8  # includes merged blobs, which are reported
    level = screening.base + screening.excess
    raised, excess = np.arange(count), screening.excess
    for _ in range(LEVELS):
        boxes, small = _connect(screening.blocks, tile, smooth, level, labels, largest)
        if small.all():
            break
        oversize = np.append(~small, False)[labels[raised + 1] - 1].any((1, 2))  # label 0, no component, is the last
        raised, excess = raised[oversize], LEVEL_STEP * excess[oversize]
        level[raised] = screening.base[raised] + excess
    saturation = options.first_clipped(scale)
    whole = boxes
    if _split(screening.blocks, screening.base, tile, smooth, labels, len(boxes), saturation, level):
        merged = labels.copy()
        boxes, small = _connect(screening.blocks, tile, smooth, level, labels, largest)
        whole = whole[_parents(merged, labels, len(boxes))]
    label = np.arange(1, len(boxes) + 1, dtype=np.int32)
    if small.all():
        return Candidates(tile, labels, boxes, label, whole)
    return Candidates(tile, labels, boxes[small], label[small], whole[small])


def block_means(frame: Frame, options: DetectionOptions, scale: int) -> Frame:
    """Average blocks of 4 x 4: (ceil(H / 4), ceil(W / 4)). Beyond the border the last row or column is repeated.

    Args:
        frame: (H, W) grey values.
        options: polarity.
        scale: largest grey value, from which frames with dark blobs are subtracted.
    """
    height, width = (-(-n // BLOCK) for n in frame.shape)
    means = np.empty((height, width), frame.dtype)
    _average(frame, np.empty(BLOCK * width, np.uint16 if frame.dtype == np.uint8 else np.uint32), means)
    return scale - means if options.polarity == "dark" else means


@njit(cache=True, nogil=True, heavy=True)
def _average(frame, sums, means):
    """Compute block means in one pass over the frame, which exceeds the cache; `sums` (4 Q,) is scratch."""
    height, width = frame.shape
    for row in range(len(means)):
        first, second = frame[BLOCK * row], frame[min(BLOCK * row + 1, height - 1)]
        third, fourth = frame[min(BLOCK * row + 2, height - 1)], frame[min(BLOCK * row + 3, height - 1)]
        mean = means[row]
        for u in range(width):
            sums[u] = np.int64(first[u]) + second[u] + third[u] + fourth[u]
        for u in range(width, len(sums)):
            sums[u] = sums[width - 1]
        for q in range(len(mean)):
            mean[q] = (sums[4 * q] + sums[4 * q + 1] + sums[4 * q + 2] + sums[4 * q + 3] + 8) >> 4


def _levels(contrast: NDArray[np.generic], options: DetectionOptions, scale: int) -> tuple[float, float]:
    """Estimate the background's level after the opening, and the contrast that a candidate needs above it."""
    sample = np.sort(contrast[::8, ::8], axis=None, kind="stable")  # radix sort, because these are integers
    lower = sample[: max(1, int(0.6 * sample.size))]  # without the blobs and most of the texture
    spread = float(cv2.meanStdDev(lower)[1][0, 0])
    noise = 1.54 * spread  # converts the spread below the 60th percentile to a normal standard deviation
    # A block mean has at least a fifth of a small blob's peak.
    least = LEAST_CONTRAST * scale if options.threshold is None else 0.2 * options.threshold
    return float(sample[sample.size // 2]), max(NOISE_FACTOR * noise, least)


@njit(cache=True, nogil=True, heavy=True)
def _select(contrast, local_peak, background, floor, level):
    """Select bright blocks and their non-empty neighbours: indices (K,), base and excess."""
    columns, count = contrast.shape[1], 0
    blocks = np.empty(contrast.size, np.int64)
    for row in range(len(contrast)):
        own, near = contrast[row], local_peak[row]
        for column in range(columns):
            if near[column] > int(floor + level) and own[column] > int(floor + EDGE * level):
                blocks[count] = row * columns + column
                count += 1
    base, excess = np.empty(count), np.empty(count)
    for k in range(count):
        row, column = blocks[k] // columns, blocks[k] % columns
        base[k] = background[row, column] + floor
        # The mean of 3 x 3 pixels has 4/3 of the noise of a block mean.
        excess[k] = max(level * 4 / 3, PEAK_FRACTION * (local_peak[row, column] - floor))
    return blocks[:count], base, excess


@njit(cache=True, nogil=True, heavy=True)
def _smooth_tiles(frame, blocks, tile, invert):
    """Number the tiles, and average the 3 x 3 pixels around each of their pixels: (K, 4, 4), -1 outside the frame.

    `invert` is the grey value from which dark frames are subtracted; -1 = bright.
    """
    height, width = frame.shape
    columns = np.uint32(tile.shape[1] - 2)
    smooth = np.empty((len(blocks), BLOCK, BLOCK), np.float32)
    smooth[:] = -1
    for k in range(len(blocks)):
        row, column = np.int64(np.uint32(blocks[k]) // columns), np.int64(np.uint32(blocks[k]) % columns)
        tile[row + 1, column + 1] = k + 1
        for v in range(row * BLOCK, min(row * BLOCK + BLOCK, height)):
            above, middle, below = frame[max(v - 1, 0)], frame[v], frame[min(v + 1, height - 1)]
            before, now = np.int32(0), np.int32(0)  # sums of three pixels in a column
            for u in range(column * BLOCK - 1, min(column * BLOCK + BLOCK, width) + 1):
                at = min(max(u, 0), width - 1)
                after = np.int32(above[at]) + np.int32(middle[at]) + np.int32(below[at])
                if u > column * BLOCK:
                    mean = np.float32(before + now + after) / np.float32(9)
                    smooth[k, v % BLOCK, (u - 1) % BLOCK] = np.float32(invert) - mean if invert >= 0 else mean
                before, now = now, after
    return smooth


@njit(cache=True, nogil=True)
def _split(blocks, base, tile, smooth, labels, count, saturation, level):
    """Raise levels (K,) to split any of `count` components that consist of clipped peaks joined by their light.

    Only pixels connected to clipped ones are visited, a small part of the bright pixels.

    Returns:
        Whether any component was split.
    """
    tops = np.zeros(count + 1)  # height of each clipped component above its base, 0 for the others
    bright, many = np.empty(len(smooth), np.int64), 0  # tiles with clipped pixels
    for k in range(len(smooth)):
        found = False
        for i in range(BLOCK):
            for j in range(BLOCK):
                name = labels[k + 1, i, j]
                if smooth[k, i, j] >= saturation and name > 0:
                    tops[name], found = max(tops[name], smooth[k, i, j] - base[k]), True
        bright[many] = k
        many += found
    if many == 0:
        return False
    parts, stack = np.zeros(labels.shape, np.int32), np.empty((4 * smooth.size, 2), np.int32)
    # The largest number of peaks, and the lowest level that gives it.
    most, chosen = np.ones(count + 1, np.int64), np.zeros(count + 1)
    for trial in range(1, len(SPLIT_AT) + 1):
        part, parted = SPLIT_AT[len(SPLIT_AT) - trial], False
        for k in range(len(smooth)):
            top = _highest(labels, k, tops)
            for i in range(BLOCK if top > 0 else 0):
                for j in range(BLOCK):
                    parts[k + 1, i, j] = -1 if smooth[k, i, j] > max(level[k], base[k] + part * top) else 0
        peaks = _count_peaks(blocks, bright[:many], tile, smooth, labels, parts, count, saturation, stack)
        for name in range(1, count + 1):
            most[name], parted = max(most[name], peaks[name]), parted or peaks[name] > 1
            if peaks[name] == most[name] > 1:
                chosen[name] = part
        if not parted:
            break
    parted = False
    for name in range(1, count + 1):
        parted = parted or chosen[name] > 0
        tops[name] *= chosen[name]
    for k in range(len(smooth) if parted else 0):
        height = _highest(labels, k, tops)
        if height > 0:
            level[k] = max(level[k], base[k] + height)
    return parted


@njit(cache=True, nogil=True, heavy=True)
def _highest(labels, k, values):
    """Largest value of the components with pixels in a tile, at least 0."""
    highest = 0.0
    for i in range(BLOCK):
        for j in range(BLOCK):
            highest = max(highest, values[labels[k + 1, i, j]])
    return highest


@njit(cache=True, nogil=True)
def _count_peaks(blocks, bright, tile, smooth, labels, parts, count, saturation, stack):
    """Count the clipped peaks (count + 1,) in each component of `labels`; `parts` marks the pixels above a level."""
    flat, box, pieces = parts.reshape(-1), np.zeros(4, np.int64), 0
    clipped = np.zeros(BLOCK * BLOCK * len(bright) + 1, np.int64)
    peaks = np.zeros(count + 1, np.int64)
    for k in bright:
        top, left = _corner(blocks[k], tile)
        for i in range(BLOCK):
            for j in range(BLOCK):
                if smooth[k, i, j] >= saturation and parts[k + 1, i, j] != 0:
                    if parts[k + 1, i, j] < 0:
                        pieces += 1
                        _fill(flat, tile, top + i, left + j, pieces, stack, box)
                    piece = parts[k + 1, i, j]
                    clipped[piece] += 1
                    peaks[labels[k + 1, i, j]] += clipped[piece] == LEAST_CLIPPED
    return peaks


@njit(cache=True, nogil=True)
def _parents(merged, labels, count):
    """Component of `merged` (from 0) that contains each of the `count` components of `labels`."""
    parents = np.zeros(count, np.int64)
    for k in range(1, len(labels)):
        for i in range(BLOCK):
            for j in range(BLOCK):
                if labels[k, i, j] > 0:
                    parents[labels[k, i, j] - 1] = merged[k, i, j] - 1
    return parents


@njit(cache=True, nogil=True, heavy=True)
def _place(tile, v, u):
    """Flat index of a pixel in the tiles; coordinates start at the empty blocks around the frame."""
    return np.uint32(tile[np.uint32(v) >> 2, np.uint32(u) >> 2] * BLOCK * BLOCK + (v & 3) * BLOCK + (u & 3))


@njit(cache=True, nogil=True, heavy=True)
def _connect(blocks, tile, smooth, level, labels, largest):
    """Label connected components (8-neighbourhood) of pixels above their tile's level (K,) from 1; 0 elsewhere.

    Returns:
        Their boxes (M, 4), and whether each is smaller than `largest` (M,).
    """
    labels[0] = 0
    for k in range(len(smooth)):
        for i in range(BLOCK):
            for j in range(BLOCK):
                labels[k + 1, i, j] = -1 if smooth[k, i, j] > level[k] else 0
    flat = labels.reshape(-1)
    stack = np.empty((4 * BLOCK * BLOCK * len(blocks), 2), np.int32)  # a run of L pixels touches at most L + 3 runs
    boxes = np.empty((4 * len(blocks), 4), np.int64)  # no more than four separate pixels fit into a tile
    count = 0
    for k in range(len(blocks)):
        top, left = _corner(blocks[k], tile)
        for i in range(BLOCK):
            for j in range(BLOCK):
                if labels[k + 1, i, j] < 0:
                    count += 1
                    _fill(flat, tile, top + i, left + j, count, stack, boxes[count - 1])
    boxes, small = boxes[:count], np.empty(count, np.bool_)
    for c in range(count):
        for side in range(4):
            boxes[c, side] -= BLOCK
        small[c] = max(boxes[c, 2] - boxes[c, 0], boxes[c, 3] - boxes[c, 1]) < largest
    return boxes, small


@njit(cache=True, nogil=True)
def _corner(block, tile):
    """First pixel (v, u) of a block; coordinates start at the empty blocks around the frame."""
    columns = tile.shape[1] - 2
    return BLOCK * (block // columns + 1), BLOCK * (block % columns + 1)


@njit(cache=True, nogil=True, heavy=True)
def _fill(flat, tile, v, u, number, stack, box):
    """Label the component of a marked pixel, and compute its box; coordinates as in `_place`."""
    box[0], box[1], box[2], box[3] = u, v, u, v
    stack[0, 0], stack[0, 1], size = v, u, 1
    while size:
        size -= 1
        v, first = stack[size, 0], stack[size, 1]
        # The whole run of marked pixels in this row, then the runs that touch it above and below.
        while flat[_place(tile, v, first - 1)] < 0:
            first -= 1
        last = first
        while flat[_place(tile, v, last)] < 0:
            flat[_place(tile, v, last)] = number
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
