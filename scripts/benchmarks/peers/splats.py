"""Coloured Gaussian splats by other tools: the same points in, images out.

Every function takes a `Scene` and returns images (M, 3, H, W), or (M, H, W, 3) if the tool uses that layout. All are
tuned to match `renderers.splat`, a Gaussian integrated over each pixel, as far as the tool allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from kornia.geometry.subpix import render_gaussian2d
from numpy.typing import NDArray
from scipy.special import erf
from torch import Tensor

Images = NDArray[np.float32]
# Reach of windows in standard deviations, beyond which a splat is below a tenth of an 8-bit grey level.
REACH = 4.0
SUPERSAMPLING = 4
FRACTION_BITS = 4  # in the coordinates of cv2.circle


@dataclass(frozen=True)
class Scene:
    """Splats to draw."""

    uv: Images  # (M, N, 2) pixels
    colours: Images  # (N, 3)
    sigma: float  # pixels, standard deviation of a splat
    side: int  # pixels, of square images

    @property
    def reach(self) -> int:
        """Pixels from a splat's middle to the end of its window."""
        return math.ceil(REACH * self.sigma)


def kornia_dense(scene: Scene, uv: Tensor) -> Tensor:
    """Sum whole images of every splat with kornia, which samples Gaussians normalized to sum 1.

    The integral over a pixel is close to a sample of a Gaussian with the pixel's variance, 1/12, added.
    """
    std = torch.full_like(uv, math.sqrt(scene.sigma**2 + 1 / 12)).flatten(0, 1)
    each = render_gaussian2d(uv.flatten(0, 1), std, (scene.side, scene.side), normalized_coordinates=False)
    each = each.unflatten(0, uv.shape[:2])
    colours = torch.from_numpy(scene.colours) * (2 * math.pi * scene.sigma**2)
    return torch.einsum("mnhw,nk->mkhw", each, colours)


def numpy_windows(scene: Scene, images: Images) -> Images:
    """Add each splat's outer product to its window of images (M, 3, H, W), in NumPy and SciPy."""
    reach, side = scene.reach, scene.side
    images[:] = 0
    start = np.round(scene.uv).astype(np.int64) - reach  # (M, N, 2)
    edges = (start - scene.uv)[..., None] + (np.arange(2 * reach + 2, dtype=np.float32) - 0.5)
    scale = math.sqrt(math.pi / 2) * scene.sigma
    profiles = scale * np.diff(erf(edges / (math.sqrt(2) * scene.sigma)), axis=-1).astype(np.float32)
    for image, starts, both in zip(images, start, profiles, strict=True):
        for (left, top), (across, down), colour in zip(starts.tolist(), both, scene.colours, strict=True):
            u, v = slice(max(left, 0), min(left + len(across), side)), slice(max(top, 0), min(top + len(down), side))
            down, across = down[v.start - top : v.stop - top], across[u.start - left : u.stop - left]
            image[:, v, u] += (colour[:, None] * down)[:, :, None] * across
    return images


def opencv_blur(scene: Scene, images: Images) -> Images:
    """Blur impulses in images (M, H, W, 3), each shared among the four pixels around it.

    Sharing adds a variance that depends on the subpixel position, 1/6 on average; the blur is narrower by that.
    """
    side = scene.side
    sigma = math.sqrt(scene.sigma**2 + 1 / 12 - 1 / 6)
    window = (2 * scene.reach + 1,) * 2
    colours = scene.colours * (2 * math.pi * scene.sigma**2)
    images[:] = 0
    for image, points in zip(images, scene.uv.tolist(), strict=True):
        for (u, v), colour in zip(points, colours, strict=True):
            left, top = math.floor(u), math.floor(v)
            for x, share_u in ((left, left + 1 - u), (left + 1, u - left)):
                for y, share_v in ((top, top + 1 - v), (top + 1, v - top)):
                    if 0 <= x < side and 0 <= y < side:
                        image[y, x] += share_u * share_v * colour
        cv2.GaussianBlur(image, window, sigma, dst=image, borderType=cv2.BORDER_CONSTANT)
    return images


def opencv_circles(scene: Scene, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw discs of a splat's light into enlarged 8-bit canvases, and shrink them to images (M, H, W, 3)."""
    canvas = np.empty((scene.side * SUPERSAMPLING, scene.side * SUPERSAMPLING, 3), dtype=np.uint8)
    unit = SUPERSAMPLING * 2**FRACTION_BITS
    centres = np.round(((scene.uv + 0.5) * SUPERSAMPLING - 0.5) * 2**FRACTION_BITS).astype(int).tolist()
    radius = round(math.sqrt(2) * scene.sigma * unit)
    colours = np.round(255 * scene.colours).astype(int).tolist()
    for image, points in zip(images, centres, strict=True):
        canvas[:] = 0
        for point, colour in zip(points, colours, strict=True):
            cv2.circle(canvas, point, radius, colour, cv2.FILLED, cv2.LINE_AA, FRACTION_BITS)
        cv2.resize(canvas, (scene.side, scene.side), dst=image, interpolation=cv2.INTER_AREA)
    return images
