"""Maps of surprise: how rare it is within a frame to look as much like a marker as a cell does.

A frame is reduced and filtered for spots of several sizes. The filter response is replaced by its rank: minus the
logarithm of the share of the frame with at least this response. Without markers, this is a standard exponential
variable for any noise, contrast, background and clutter; the more clutter a frame has, the less a bright spot counts.
Where the object's pose is known, only a window of each frame is processed.
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

SIZES = (0.0, 1.2, 2.4)  # cells, standard deviations of the spot filters; 0 = the reduced frame itself
SURROUND = 2.0  # standard deviation of the ring around a spot, relative to the spot's
LEAST_SURROUND = 1.6  # cells


@dataclass(frozen=True)
class Maps:
    """Surprise of all cameras at one scale, for whole frames or for windows."""

    surprise: NDArray[np.float32]  # (C, H, W), 0 where a camera has no image
    factor: int  # pixels per cell
    size: NDArray[np.int64]  # (C, 2) width and height in cells
    corner: NDArray[np.int64]  # (C, 2) offset of the first cell from the frame's left and top

    def cells(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert pixels (*K, C, N, 2) to cells: cell i extends from i to i + 1; invalid points go far outside."""
        return np.nan_to_num((uv + 0.5) / self.factor - self.corner[:, None], nan=-1e6).clip(-1e6, 1e6)

    def pixels(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert cells (*K, C, N, 2) to pixels."""
        return (cells + self.corner[:, None]) * self.factor - 0.5

    def select(self, cameras: list[int]) -> Maps:
        """Select cameras."""
        return Maps(self.surprise[cameras], self.factor, self.size[cameras], self.corner[cameras])

    def pool(self, factor: int) -> Maps:
        """Pool into larger cells by the maximum, and rank the result again."""
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
        """Replace each cell by the maximum over itself and its neighbours, and rank the result again."""
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
        frames: (H, W) of each camera; None = no frame.
        factor: pixels per cell.
        dark: markers are darker than their surroundings.
        masks: (H, W) of each camera, True in excluded pixels.
        windows: (C, 4) first and last column and row of each window, in pixels, the last ones excluded; multiples of
            `factor`, and of the factor of later `pool` calls; None = whole frames.

    Returns:
        Maps, and the response to each spot size in standard deviations of the noise: (C, sizes, H, W).
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
        # Incomplete cells at the right and at the bottom are dropped.
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
    """Rank the values (C, H, W) of each camera within its own map."""
    ranked = np.zeros_like(values)
    there = np.flatnonzero(size.prod(1)).tolist()
    each_camera(lambda camera: raise_ranks(values[camera], size[camera], 1, ranked[camera]), there)
    return ranked


def _spots(image: NDArray[np.float32], found: NDArray[np.float32]) -> None:
    """Fill (sizes, H, W) with the contrast of each spot size against the ring around it."""
    rings = [max(LEAST_SURROUND, SURROUND * sigma) for sigma in SIZES]
    blurred = {sigma: cv2.GaussianBlur(image, (0, 0), sigma) for sigma in {*SIZES, *rings} - {0.0}} | {0.0: image}
    for number, (sigma, ring) in enumerate(zip(SIZES, rings, strict=True)):
        np.subtract(blurred[sigma], blurred[ring], out=found[number])
