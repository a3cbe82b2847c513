"""Slow, obvious renderers: the whole volume of fiducials times pixels. The fast ones are tested against these."""

import math
from typing import Literal

import torch
from torch import Tensor


def splat_reference(
    uv: Tensor,
    colours: Tensor,
    size: Tensor | float,
    image_size: tuple[int, int],
    *,
    intensity: Tensor | None = None,
    visible: Tensor | None = None,
    depth: Tensor | None = None,
    compositing: Literal["add", "over"] = "add",
) -> Tensor:
    """Draw the images of ``renderers.splat`` pixel by pixel; same arguments, finite ``uv`` expected.

    Returns:
        (*B, K, H, W) images.

    """
    ones = torch.ones_like(uv[..., 0])  # (*B, N)
    sigma = ones * size
    weight = ones if intensity is None else ones * intensity
    if visible is not None:
        weight = weight * visible
    v, u = torch.meshgrid(*(torch.arange(n, dtype=uv.dtype, device=uv.device) for n in image_size), indexing="ij")
    offset_u = u - uv[..., 0, None, None]  # (*B, N, H, W)
    offset_v = v - uv[..., 1, None, None]
    light = weight[..., None, None] * _pixel_integral(offset_u, sigma) * _pixel_integral(offset_v, sigma)
    if compositing == "add":
        return torch.einsum("...nhw,...nk->...khw", light, colours.expand(*uv.shape[:-1], -1))

    alpha = light.clamp(0, 1)
    distance = torch.arange(uv.shape[-2], device=uv.device).expand(uv.shape[:-1]) if depth is None else depth
    images = torch.zeros_like(torch.einsum("...nhw,...nk->...khw", alpha, colours.expand(*uv.shape[:-1], -1)))
    for n in range(uv.shape[-2]):
        nearer = distance < distance[..., n, None]  # (*B, N)
        hidden_by = torch.where(nearer[..., None, None], alpha, torch.zeros_like(alpha))
        contribution = (1 - hidden_by).prod(dim=-3) * alpha[..., n, :, :]
        images = images + contribution[..., None, :, :] * colours[..., n, :, None, None]
    return images


def ellipse_reference(
    centre: Tensor, shape: Tensor, image_size: tuple[int, int], *, blur: float, samples: int = 16
) -> Tensor:
    """Blur an ellipse seen through square pixels by brute force: dense samples, dense Gaussian, box average.

    Args:
        centre: (2,) pixels.
        shape: (2, 2) matrix A of the ellipse ``(x - centre)^T A^-1 (x - centre) <= 1``, square pixels.
        image_size: Height and width.
        blur: Standard deviation of the lens blur in pixels, 0 for none.
        samples: Samples a pixel along each axis.

    Returns:
        (H, W) coverage in [0, 1].

    """
    v, u = (((torch.arange(n * samples, dtype=shape.dtype) + 0.5) / samples - 0.5) for n in image_size)
    offset = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1) - centre  # (H*s, W*s, 2)
    inside = (torch.einsum("...i,ij,...j->...", offset, torch.linalg.inv(shape), offset) <= 1).to(shape.dtype)
    if blur > 0:
        kernel_v, kernel_u = (torch.exp(-0.5 * ((x[:, None] - x) / blur) ** 2) for x in (v, u))
        norm = math.sqrt(2 * math.pi) * blur * samples
        inside = (kernel_v / norm) @ inside @ (kernel_u / norm)
    height, width = image_size
    return inside.view(height, samples, width, samples).mean(dim=(1, 3))


def _pixel_integral(offset: Tensor, sigma: Tensor) -> Tensor:
    """Integrate exp(-x^2 / (2 sigma^2)) over the pixel at ``offset`` (*B, N, H, W) from the centre."""
    scale = math.sqrt(2) * sigma[..., None, None]
    step = torch.erf((offset + 0.5) / scale) - torch.erf((offset - 0.5) / scale)
    return math.sqrt(math.pi / 2) * sigma[..., None, None] * step
