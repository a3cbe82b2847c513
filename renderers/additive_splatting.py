"""Add Gaussian splats to images with tensors: each splat is an outer product, so one matrix product per image."""

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Splats(NamedTuple):
    """Splats to draw: tensors of one floating-point type, at least float32."""

    uv: Tensor  # (B, N, 2) pixels
    sizes: Tensor  # (B, N) standard deviations in pixels
    weight: Tensor  # (B, N) intensities
    colours: Tensor  # (B, N, K)
    visible: Tensor  # (B, N) bool; invisible splats may hold anything

    def drop_undrawable(self) -> "Splats":
        """Replace splats that are invisible, not finite or without a positive size by ones that draw nothing.

        Multiplying by zero is not enough: NaN times zero is still NaN, in the image and in the gradient.
        """
        drawn = self.uv.isfinite().all(-1) & self.visible & (self.sizes > 0) & self.sizes.isfinite()
        return Splats(
            torch.where(drawn[..., None], self.uv, 0.0),
            torch.where(drawn, self.sizes, 1.0),
            torch.where(drawn, self.weight, 0.0),
            torch.where(drawn[..., None], self.colours, 0.0),
            drawn,
        )


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


def splat_additively(splats: Splats, image_size: tuple[int, int], out: Tensor | None = None) -> Tensor:
    """Draw splats into images.

    Args:
        splats: Splats to draw.
        image_size: Height and width.
        out: (B, K, H, W) contiguous images of the same dtype, overwritten; not differentiable.

    Returns:
        (B, K, H, W) images on black.

    """
    uv, sizes, weight, colours, _ = splats.drop_undrawable()
    height, width = image_size
    along_u = profile(uv[..., 0], sizes, 0, width)  # (B, N, W)
    along_v = profile(uv[..., 1], sizes, 0, height)  # (B, N, H)
    left = ((colours * weight[..., None])[..., None] * along_v[..., None, :]).flatten(2).mT  # (B, K*H, N)
    if out is None:
        return torch.bmm(left, along_u).unflatten(1, (-1, height))
    torch.bmm(left, along_u, out=out.flatten(1, 2))
    return out
