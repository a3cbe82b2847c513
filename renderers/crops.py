"""Render crops of infrared frames alone: the same physics as whole frames, thousands of crops at a time."""

from __future__ import annotations

from operator import itemgetter

import torch
from torch import Tensor

from renderers.infrared import render_blobs
from renderers.spots import Spots, in_crop

LEAST_BLUR = 0.15  # px of the crop: smear is computed on two samples per pixel, too few for a sharper blur
AT_ONCE = 2**22  # pixels of crops times blobs that are processed together: more would overflow the caches and memory


def render_crops(
    spots: Spots,
    centre: Tensor,
    scale: float,
    size: tuple[int, int],
    blur: float,
    *,
    extent: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor]:
    """Render the light of crops only; their pixels are means over squares of the frame's pixels.

    Args:
        spots: (B, N) in pixels of the frame, including false ones; nearer spots hide farther ones.
        centre: (B, 2) px of the frame, the middle of each crop.
        scale: Pixels of the frame per pixel of the crop.
        size: height and width of the crops.
        blur: of the lens, standard deviation in pixels of the frame.
        extent: as for ``render_blobs``, in pixels of the crop; without it a GPU has to synchronize.

    Returns:
        Light (B, h, w), and (B, N), the share of each blob's area that is inside the crop and not hidden.

    Examples:
        >>> one = torch.ones(6, 1)
        >>> uv = torch.full((6, 1, 2), 700.0)
        >>> spots = Spots(uv, 81.0 * torch.eye(2).expand(6, 1, 2, 2), one, one > 0, one)
        >>> light, _ = render_crops(spots, uv[:, 0] + 3, 8.0, (96, 96), 0.7)
        >>> light.shape
        torch.Size([6, 96, 96])
    """
    local = in_crop(spots, centre, scale, size)
    blur = blur / scale if spots.smear is None else max(blur / scale, LEAST_BLUR)
    count = len(spots.uv)
    step = max(1, AT_ONCE // (size[0] * size[1] * max(spots.uv.shape[1], 1)))
    parts = [
        render_blobs(local.of_each(itemgetter(slice(i, i + step))), size, blur, extent=extent)
        for i in range(0, count, step)
    ]
    return torch.cat([light for light, _ in parts]), torch.cat([seen for _, seen in parts])
