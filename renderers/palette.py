"""Colours for fiducials that stay distinguishable from each other and from black."""

import numpy as np
import torch
from torch import Tensor

GRID = 28  # candidate levels per channel
# Least value of a colour's brightest channel. A splat fades towards black, so colours that differ in brightness alone
# can be mistaken for each other: with 0.5 a green and its dark shade would both be among the first eight.
BRIGHT = 0.7


def palette(count: int) -> Tensor:
    """Choose colours by farthest-point selection in OKLab, starting from the black background.

    Every colour is the one that lies farthest from black and from all chosen before it, so ``palette(n)[:k]`` equals
    ``palette(k)``. The least CIEDE2000 difference of any two colours is 22, 9, 5 and 2 for 8, 27, 64 and 437 (about 1
    is just noticeable), and 34 to black. Seen from black, the first 8 lie in directions at least 18 degrees apart; with
    more colours some differ in brightness alone.

    Args:
        count: Number of colours.

    Returns:
        (count, 3) float32 sRGB in [0, 1].

    Raises:
        ValueError: A negative count, or more colours than candidates.

    Examples:
        >>> palette(8).shape
        torch.Size([8, 3])
    """
    levels = np.linspace(0, 1, GRID)
    srgb = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    srgb = srgb[srgb.max(axis=1) >= BRIGHT]
    if not 0 <= count <= len(srgb):
        raise ValueError(f"palette needs a count between 0 and {len(srgb)}, found {count}")
    lab = _oklab_from_srgb(srgb)
    chosen = np.empty(count, dtype=np.int64)
    squared_distance = np.einsum("ij,ij->i", lab, lab)  # to black, which is the origin of OKLab
    for i in range(count):
        chosen[i] = squared_distance.argmax()
        offset = lab - lab[chosen[i]]
        np.minimum(squared_distance, np.einsum("ij,ij->i", offset, offset), out=squared_distance)
    return torch.from_numpy(srgb[chosen].astype(np.float32))


def _oklab_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB in [0, 1] (N, 3) to OKLab (N, 3). Source: B. Ottosson, A perceptual color space, 2020."""
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    cone_from_linear = np.array(
        [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ]
    )
    lab_from_cone = np.array(
        [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ]
    )
    return np.cbrt(linear @ cone_from_linear.T) @ lab_from_cone.T
