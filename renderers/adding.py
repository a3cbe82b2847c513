"""Add Gaussian splats to images with tensors: an outer product each, so one matrix product an image."""

import math

import torch
from torch import Tensor


def profile(centre: Tensor, size: Tensor, start: Tensor | int, length: int) -> Tensor:
    """Integrate a Gaussian of peak 1 over each of ``length`` neighbouring pixels.

    Args:
        centre: (...) pixels.
        size: (...) standard deviation in pixels.
        start: First pixel, a number or (...).
        length: Number of pixels.

    Returns:
        (..., length) integrals; they sum to ``sqrt(2 pi) size`` over an infinite line.

    """
    first_edge = start - 0.5 - centre
    edges = first_edge[..., None] + torch.arange(length + 1, dtype=centre.dtype, device=centre.device)
    cumulative = torch.erf(edges / (math.sqrt(2) * size[..., None]))
    return (math.sqrt(math.pi / 2) * size[..., None]) * cumulative.diff(dim=-1)


def added(uv: Tensor, sizes: Tensor, colours: Tensor, image_size: tuple[int, int], out: Tensor | None = None) -> Tensor:
    """Draw splats into images.

    Args:
        uv: (B, N, 2) pixels.
        sizes: (B, N) standard deviations in pixels.
        colours: (B, N, K).
        image_size: Height and width.
        out: (B, K, H, W) contiguous images of the same dtype, overwritten; not differentiable.

    Returns:
        (B, K, H, W) images on black.

    """
    height, width = image_size
    along_u = profile(uv[..., 0], sizes, 0, width)  # (B, N, W)
    along_v = profile(uv[..., 1], sizes, 0, height)  # (B, N, H)
    left = (colours[..., None] * along_v[..., None, :]).flatten(2).mT  # (B, K*H, N)
    if out is None:
        return torch.bmm(left, along_u).unflatten(1, (-1, height))
    torch.bmm(left, along_u, out=out.flatten(1, 2))
    return out
