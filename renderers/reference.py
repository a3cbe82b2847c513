"""Slow, obvious renderers: the whole volume of fiducials times pixels. The fast ones are tested against these."""

import math
from typing import Literal

import torch
from torch import Tensor

from renderers.spots import Spots


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
        samples: Samples per pixel along each axis.

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


def blob_reference(
    spot: Spots, image_size: tuple[int, int], *, blur: float, samples: int = 8, moments: int = 32
) -> Tensor:
    """Draw one blob with its surface and its smear by brute force: many sharp pictures, averaged, blurred, binned.

    Args:
        spot: without batch axes, N = 1; visible, on an empty background.
        image_size: Height and width.
        blur: Standard deviation of the lens blur in pixels.
        samples: Samples per pixel along each axis.
        moments: Pictures along the path; the disc of confusion has four times as many points.

    Returns:
        (H, W) light.
    """
    v, u = (((torch.arange(n * samples, dtype=spot.uv.dtype) + 0.5) / samples - 0.5) for n in image_size)
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1) - spot.uv[0]
    shifts = spot.uv.new_zeros(1, 2)
    if spot.smear is not None:
        time = (torch.arange(moments, dtype=u.dtype) + 0.5) / moments - 0.5
        point = torch.arange(2 * moments, dtype=u.dtype)
        turn, away = point * math.pi * (3 - math.sqrt(5)), ((point + 0.5) / len(point)).sqrt()  # Vogel's spiral
        disc = torch.stack([away * turn.cos(), away * turn.sin()], dim=-1) * spot.smear.defocus[0]
        disc = torch.cat([disc, -disc])
        way = time[:, None] * spot.smear.path[0]
        parts = [part if bool(part.any()) else shifts for part in (way, disc)]
        shifts = (parts[0][:, None] + parts[1]).reshape(-1, 2)
    light = torch.zeros_like(grid[..., 0])
    for shift in shifts:
        light += _sharp(grid - shift, spot) / len(shifts)
    kernel_v, kernel_u = (torch.exp(-0.5 * ((x[:, None] - x) / blur) ** 2) for x in (v, u))
    norm = math.sqrt(2 * math.pi) * blur * samples
    blurred = (kernel_v / norm) @ light @ (kernel_u / norm)
    height, width = image_size
    return spot.intensity[0] * blurred.view(height, samples, width, samples).mean(dim=(1, 3))


def _sharp(offset: Tensor, spot: Spots) -> Tensor:
    """Brightness of a blob's surface at offsets (H, W, 2) from its centre."""
    (uu, uv), (_, vv) = spot.shape[0]
    upper = torch.stack([torch.stack([(uu - uv**2 / vv).sqrt(), uv / vv.sqrt()]), torch.stack([0 * uv, vv.sqrt()])])
    x, y = (offset @ torch.linalg.inv(upper).mT).unbind(-1)
    light = (x**2 + y**2 <= 1).to(offset.dtype)
    surface = spot.surface
    if surface is None:
        return light
    if surface.limb is not None:
        light = light * (1 - surface.limb[0] * (1 - (1 - x**2 - y**2).clamp(min=0).sqrt()))
    for at_x, at_y, radius, gain in () if surface.bumps is None else surface.bumps[0]:
        light = light * (1 + gain * torch.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * radius**2)))
    for normal_u, normal_v, far in surface.cuts[0]:
        light = light * (offset[..., 0] * normal_u + offset[..., 1] * normal_v <= far)
    return light


def _pixel_integral(offset: Tensor, sigma: Tensor) -> Tensor:
    """Integrate exp(-x^2 / (2 sigma^2)) over the pixel at ``offset`` (*B, N, H, W) from the centre."""
    scale = math.sqrt(2) * sigma[..., None, None]
    step = torch.erf((offset + 0.5) / scale) - torch.erf((offset - 0.5) / scale)
    return math.sqrt(math.pi / 2) * sigma[..., None, None] * step
