"""Where the blobs are: candidate components of a frame, found on block means so that the full frame is read once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection.options import DetectionOptions, Frame

BLOCK = 4  # px, side of a block; a 4 x 4 mean is close to the matched filter of a small blob
NOISE_FACTOR = 5.0  # candidates stand out of the block means by this many standard deviations
LEAST_CONTRAST = 0.006  # of full scale: below this, block means tell quantization steps rather than blobs
LEVELS = 5  # components that are too large are tried again at higher levels
PEAK_FRACTION = 0.3  # of the local peak: keeps the skirts of neighbours apart


@dataclass(frozen=True)
class Candidates:
    """Connected bright components of one frame."""

    mask: NDArray[np.uint8]  # (H', W') 255 on the components; padded to whole blocks
    boxes: NDArray[np.int64]  # (K, 4) left, top, right, bottom pixel (included)
    seeds: NDArray[np.int64]  # (K, 2) one pixel (u, v) of each component


def find_candidates(frame: Frame, options: DetectionOptions, scale: int) -> Candidates:
    """Find the components of `frame` that are brighter (darker) than their surroundings.

    Args:
        frame: (H, W) grey values.
        options: polarity, threshold and radii.
        scale: largest grey value, for the inversion of dark blobs.
    """
    means = _block_means(frame)
    if options.polarity == "dark":
        means = scale - means
    # An opening follows steps of the background (paper on a table) that a median would smear; blobs are smaller than it.
    side = math.ceil((2 * options.max_radius + 6) / BLOCK) + 1
    background = cv2.morphologyEx(means, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    contrast = cv2.subtract(means, background)
    floor, level = _levels(contrast, options, scale)
    hits = cv2.threshold(contrast, floor + level, 255, cv2.THRESH_BINARY)[1].astype(np.uint8, copy=False)
    mask = np.zeros((means.shape[0] * BLOCK, means.shape[1] * BLOCK), np.uint8)
    blocks = np.flatnonzero(cv2.dilate(hits, np.ones((3, 3), np.uint8)).view(np.bool_))
    local_peak = cv2.dilate(contrast, np.ones((3, 3), np.uint8)).ravel()[blocks] - floor
    # The mean of the 3 x 3 pixels around a pixel has 4/3 of the noise of a block mean.
    excess = np.maximum(level * 4 / 3, PEAK_FRACTION * local_peak)
    contours: list[NDArray[np.int32]] = []
    invert = scale if options.polarity == "dark" else None
    for _ in range(LEVELS):
        if not blocks.size:
            break
        _mark_pixels(frame, blocks, background.ravel()[blocks] + floor + excess, mask, invert)
        contours, oversize = _components(mask, 4 * options.max_radius + 8)  # merged blobs pass: they are to be reported
        raised = _blocks_under(oversize, blocks)
        blocks, excess = blocks[raised], 1.6 * excess[raised]
    return _candidates(mask, contours, frame.shape)


def _block_means(frame: Frame) -> Frame:
    """Average blocks of 4 x 4: (ceil(H / 4), ceil(W / 4)). Two halvings are much faster than one resize by four."""
    height, width = (-(-n // BLOCK) * BLOCK for n in frame.shape)
    if (height, width) != frame.shape:
        pad = (0, height - frame.shape[0], 0, width - frame.shape[1])
        frame = cv2.copyMakeBorder(frame, *pad, cv2.BORDER_REPLICATE)
    half = cv2.resize(frame, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(half, (width // 4, height // 4), interpolation=cv2.INTER_AREA)


def _levels(contrast: Frame, options: DetectionOptions, scale: int) -> tuple[float, float]:
    """Estimate what the opening leaves of an empty background, and how far above it a candidate must stand."""
    sample = np.sort(contrast[::4, ::4], axis=None)
    lower = sample[: max(1, int(0.6 * sample.size))]  # without the blobs and most of the texture
    noise = 1.54 * float(lower.std())  # the standard deviation of a normal variable below its 60th percentile
    level = max(NOISE_FACTOR * noise, LEAST_CONTRAST * scale)
    if options.threshold is not None:
        level = max(level, 0.2 * options.threshold)  # a block mean holds at least this part of a small blob's peak
    return float(sample[sample.size // 2]), level


def _mark_pixels(
    frame: Frame, blocks: NDArray[np.int64], least: NDArray[np.float64], mask: NDArray[np.uint8], invert: int | None
) -> None:
    """Set `mask` where the mean of the 3 x 3 pixels around a pixel of the given blocks exceeds `least` of its block."""
    rows, columns = np.divmod(blocks, mask.shape[1] // BLOCK)
    reach = np.arange(-1, BLOCK + 1)
    v = np.clip(rows[:, None] * BLOCK + reach, 0, frame.shape[0] - 1)
    u = np.clip(columns[:, None] * BLOCK + reach, 0, frame.shape[1] - 1)
    pixels = frame[v[:, :, None], u[:, None, :]].astype(np.int32)  # (K, 6, 6)
    pixels = pixels[:, :-2] + pixels[:, 1:-1] + pixels[:, 2:]
    pixels = pixels[:, :, :-2] + pixels[:, :, 1:-1] + pixels[:, :, 2:]  # (K, 4, 4) sums of nine
    if invert is not None:
        pixels = 9 * invert - pixels
    tiles = mask.reshape(mask.shape[0] // BLOCK, BLOCK, mask.shape[1] // BLOCK, BLOCK)
    tiles[rows, :, columns, :] = np.where(pixels > 9 * least[:, None, None], 255, 0)


def _components(
    mask: NDArray[np.uint8], largest: float
) -> tuple[list[NDArray[np.int32]], NDArray[np.uint8] | None]:
    """Outline the components of the mask up to the size `largest`, and draw those beyond: (H', W'), None without any."""
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


def _blocks_under(drawn: NDArray[np.uint8] | None, blocks: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which of the blocks hold a drawn pixel: (K,)."""
    if drawn is None:
        return np.zeros(len(blocks), np.bool_)
    rows, columns = np.divmod(blocks, drawn.shape[1] // BLOCK)
    tiles = drawn.reshape(drawn.shape[0] // BLOCK, BLOCK, drawn.shape[1] // BLOCK, BLOCK)
    held: NDArray[np.bool_] = tiles[rows, :, columns, :].any((1, 2))
    return held


def _candidates(mask: NDArray[np.uint8], contours: list[NDArray[np.int32]], shape: tuple[int, ...]) -> Candidates:
    """Bound the outlined components; those wholly inside the padding are dropped."""
    rectangles = np.array([cv2.boundingRect(contour) for contour in contours], np.int64).reshape(-1, 4)
    seeds = np.array([contour[0, 0] for contour in contours], np.int64).reshape(-1, 2)
    limit = np.array([shape[1], shape[0]]) - 1
    last = np.minimum(rectangles[:, :2] + rectangles[:, 2:] - 1, limit)
    inside = (rectangles[:, :2] <= limit).all(1)
    return Candidates(mask, np.hstack([rectangles[:, :2], last])[inside], np.minimum(seeds, limit)[inside])
