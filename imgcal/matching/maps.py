"""Frames as maps of surprise: how unusual it is, in this very frame, to look so much like a marker.

A frame is reduced and filtered for spots of several sizes. What the filters say is replaced by its rank: minus the
logarithm of the share of the frame in which they say as much. Without markers that is a standard exponential variable,
whatever noise, contrast, background and clutter are; the more clutter a frame has, the less a bright spot is worth.
Where the object's place is known, all this is done within a window of each frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.matching.camera_threads import each_camera
from imgcal.matching.ranks import average, raise_ranks, rank_spots

SIZES = (0.0, 1.2, 2.4)  # cells, standard deviations of the spots that are looked for; 0 = as reduced
SURROUND = 2.0  # of the ring around a spot, in parts of the spot's
LEAST_SURROUND = 1.6  # cells


@dataclass(frozen=True)
class Maps:
    """Surprise of all cameras at one scale, of their frames or windows in these."""

    surprise: NDArray[np.float32]  # (C, H, W), 0 where a camera has no image
    factor: int  # pixels to a cell
    size: NDArray[np.int64]  # (C, 2) width and height in cells
    corner: NDArray[np.int64]  # (C, 2) cells left of the first one, and above it

    def cells(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn pixels (*K, C, N, 2) into cells: cell i reaches from i to i + 1; what is nowhere is far outside."""
        return np.nan_to_num((uv + 0.5) / self.factor - self.corner[:, None], nan=-1e6).clip(-1e6, 1e6)

    def pixels(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn cells (*K, C, N, 2) into pixels."""
        return (cells + self.corner[:, None]) * self.factor - 0.5

    def select(self, cameras: list[int]) -> Maps:
        """Keep the given cameras."""
        return Maps(self.surprise[cameras], self.factor, self.size[cameras], self.corner[cameras])

    def pool(self, factor: int) -> Maps:
        """Make larger cells, each as surprising as the most surprising one within it or next to it."""
        step = factor // self.factor
        if step <= 1:
            return self
        count, height, width = self.surprise.shape
        padded = np.zeros((count, -(-height // step) * step, -(-width // step) * step), np.float32)
        padded[:, :height, :width] = self.surprise
        rows = padded.reshape(count, -1, step, padded.shape[2]).max(2)
        most = rows.reshape(count, rows.shape[1], -1, step).max(3)
        size = -(-self.size // step)
        return Maps(_rank(most, size), self.factor * step, size, self.corner // step)

    def dilate(self) -> Maps:
        """Let every cell be as surprising as its most surprising neighbour."""
        kernel = np.ones((3, 3), np.uint8)
        most = np.stack([cv2.dilate(one, kernel) for one in self.surprise])
        return Maps(_rank(most, self.size), self.factor, self.size, self.corner)


def surprise_maps(
    frames: list[Frame | None],
    factor: int,
    dark: bool,
    masks: list[NDArray[np.bool_] | None],
    windows: NDArray[np.int64] | None = None,
) -> tuple[Maps, NDArray[np.float32]]:
    """Filter the frames of all cameras.

    Args:
        frames: (H, W) of each camera, None = it has none.
        factor: pixels to a cell.
        dark: markers are darker than their surroundings.
        masks: (H, W) of each camera, True where not to look.
        windows: (C, 4) first and last column and row of what is looked at, in pixels, the last ones excluded; a
            multiple of `factor`, and of that of whatever `pooled` makes of it; None = all of each frame.

    Returns:
        Maps, and the response to each size of spots in standard deviations of the noise: (C, sizes, H, W).
    """
    if windows is None:
        windows = np.array([(0, 0, 0, 0) if f is None else (0, f.shape[1], 0, f.shape[0]) for f in frames])
    there = np.array([frame is not None for frame in frames])
    size = np.where(there[:, None], np.maximum(windows[:, 1::2] - windows[:, ::2], 0) // factor, 0)
    shape = (len(frames), int(max(size[:, 1].max(), 1)), int(max(size[:, 0].max(), 1)))
    surprise = np.zeros(shape, np.float32)
    response = np.zeros((shape[0], len(SIZES), *shape[1:]), np.float32)

    def fill(camera: int) -> None:
        frame, mask, (width, height) = frames[camera], masks[camera], size[camera].tolist()
        if frame is None or width * height == 0:
            return
        left, top = windows[camera, ::2].tolist()
        # What is left over at the right and at the bottom is not seen.
        cells = np.empty((height, width), np.float32)
        average(frame, windows[camera, ::2], factor, cells)
        _spots(-cells if dark else cells, response[camera, :, :height, :width])
        covered = np.zeros((0, 0), np.uint8)
        if mask is not None:
            area = mask[top : top + height * factor, left : left + width * factor].astype(np.uint8)
            covered = np.asarray(cv2.resize(area, (width, height), interpolation=cv2.INTER_AREA))
        rank_spots(response[camera], covered, size[camera], surprise[camera])

    each_camera(fill, range(len(frames)))
    return Maps(surprise, factor, size, windows[:, ::2] // factor), response


def _rank(values: NDArray[Any], size: NDArray[np.int64]) -> NDArray[np.float32]:
    """Rank the values (C, H, W) of each camera among those of its map."""
    ranked = np.zeros_like(values)
    there = np.flatnonzero(size.prod(1)).tolist()
    each_camera(lambda camera: raise_ranks(values[camera], size[camera], 1, ranked[camera]), there)
    return ranked


def _spots(image: NDArray[np.float32], found: NDArray[np.float32]) -> None:
    """Fill (sizes, H, W) with what each size of spots is brighter than the ring around it."""
    rings = [max(LEAST_SURROUND, SURROUND * sigma) for sigma in SIZES]
    blurred = {sigma: cv2.GaussianBlur(image, (0, 0), sigma) for sigma in {*SIZES, *rings} - {0.0}} | {0.0: image}
    for number, (sigma, ring) in enumerate(zip(SIZES, rings, strict=True)):
        np.subtract(blurred[sigma], blurred[ring], out=found[number])
