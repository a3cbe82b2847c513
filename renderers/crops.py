"""Crops of infrared frames, drawn alone: the same physics as whole frames, thousands of them at a time."""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter

import torch
from torch import Tensor

from renderers.infrared import render_blobs
from renderers.spots import Spots, in_crop

LEAST_BLUR = 0.15  # px of the crop: smear is computed on two samples a pixel, which hold no sharper ones
AT_ONCE = 2**22  # pixels of crops and blobs that are worked on together: more leave the caches, and fill the memory


@dataclass(frozen=True)
class CropSensor:
    """Optics and sensor of each crop; levels and noise in grey levels of one pixel of the frame."""

    background: Tensor  # (B,)
    contrast: Tensor  # (B,) that a blob of intensity 1 adds
    read_noise: Tensor  # (B,) standard deviation
    gain: Tensor  # (B,) grey levels an electron: the variance of shot noise is gain times the level; 0 = none
    slope: Tensor  # (B, 2) change of the background across the crop's width and height
    saturation: float = 255.0  # largest grey level


def render_crops(
    spots: Spots,
    centre: Tensor,
    scale: float,
    size: tuple[int, int],
    blur: float,
    *,
    extent: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor]:
    """Draw the light of crops: means over squares of the frame's pixels, and nothing else of the frame.

    Args:
        spots: (B, N) in pixels of the frame, false ones among them; what is nearer hides what is farther.
        centre: (B, 2) px of the frame on which the middle of each crop lies.
        scale: Pixels of the frame a pixel of the crop.
        size: height and width of the crops.
        blur: of the lens, standard deviation in pixels of the frame.
        extent: as of ``render_blobs``, in pixels of the crop; without it a GPU has to wait.

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


def expose_crops(light: Tensor, sensor: CropSensor, scale: float, generator: torch.Generator) -> Tensor:
    """Turn the light of crops into grey levels; a pixel that averages s x s pixels has their noise over s.

    Args:
        light: (B, h, w) of ``render_crops``.
        sensor: of each crop.
        scale: Pixels of the frame a pixel of the crop.
        generator: on the device of the light.
    """
    height, width = light.shape[-2:]
    across_u, across_v = (torch.linspace(-0.5, 0.5, n, dtype=light.dtype, device=light.device) for n in (width, height))
    ramp = sensor.slope[:, :1, None] * across_u + sensor.slope[:, 1:, None] * across_v[:, None]
    level = sensor.background[:, None, None] + ramp + sensor.contrast[:, None, None] * light
    level = level.clamp(0, sensor.saturation)
    variance = level * sensor.gain[:, None, None] + sensor.read_noise[:, None, None].square() + 1 / 12
    noise = torch.randn(level.shape, generator=generator, dtype=level.dtype, device=level.device)
    level = level + noise * (variance.sqrt() / scale)
    level = level.clamp(0, sensor.saturation)
    return level.round() if scale == 1 else level
