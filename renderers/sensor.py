"""From light to grey levels: background, vignetting, exposure, saturation, noise, hot pixels, quantization."""

from __future__ import annotations

import torch
from torch import Tensor

from renderers.sensor_model import SensorModel


def expose(light: Tensor, sensor: SensorModel, *, generator: torch.Generator | None = None) -> Tensor:
    """Turn light into grey levels: background, vignetting, exposure, saturation, noise, hot pixels, quantization.

    Args:
        light: (*B, H, W) from `render_blobs`; the last batch axis counts cameras.
        sensor: Optics and sensor.
        generator: Source of the noise, on the device of `light`.

    Returns:
        (*B, H, W) uint8, or uint16 for 12 and 16 bit.
    """
    height, width = light.shape[-2:]
    dtype = torch.uint8 if sensor.bit_depth == 8 else torch.uint16
    frames = torch.empty(light.shape, dtype=dtype, device=light.device)
    across_u, across_v = (torch.linspace(-0.5, 0.5, n, dtype=light.dtype, device=light.device) for n in (width, height))
    ground = sensor.background + sensor.gradient[0] * across_u + sensor.gradient[1] * across_v[:, None]
    passed = 1 - sensor.vignetting * corner_distance_squared((height, width), light) if sensor.vignetting > 0 else None
    hot = _hot_pixels(light.shape, sensor, light.device)
    # One frame at a time: the temporaries of a frame stay in the processor's cache.
    for i, (frame, target) in enumerate(
        zip(light.detach().reshape(-1, height, width), frames.view(-1, height, width), strict=True)
    ):
        level = ground + sensor.contrast * frame
        if passed is not None:
            level.mul_(passed)
        if sensor.polarity == "dark":
            level = 1 - level
        level.mul_(sensor.exposure).clamp_(0, sensor.saturation).mul_(sensor.full_scale)
        _add_noise(level, sensor, generator)
        level.view(-1)[hot[i % len(hot)]] = sensor.full_scale
        target.copy_(level.round_().clamp_(0, sensor.full_scale))
    return frames


def corner_distance_squared(image_size: tuple[int, int], like: Tensor) -> Tensor:
    """Squared distance of every pixel (H, W) from the middle of the frame, 1 in its corners."""
    v, u = (torch.linspace(-1, 1, n, dtype=like.dtype, device=like.device) for n in image_size)
    return (u.square() + v[:, None].square()) / 2


def _add_noise(level: Tensor, sensor: SensorModel, generator: torch.Generator | None) -> None:
    """Add noise to the grey levels (H, W) of a frame, in place."""
    if sensor.read_noise > 0 or sensor.shot_noise > 0:
        noise = torch.empty_like(level).normal_(generator=generator)
        if sensor.shot_noise > 0:
            variance = level * (sensor.shot_noise**2 / sensor.full_scale) + sensor.read_noise**2
            level.addcmul_(noise, variance.sqrt_())
        else:
            level.add_(noise, alpha=sensor.read_noise)
    if sensor.row_noise > 0:
        level.add_(torch.empty_like(level[:, :1]).normal_(generator=generator), alpha=sensor.row_noise)


def _hot_pixels(shape: torch.Size, sensor: SensorModel, device: torch.device) -> Tensor:
    """Choose the stuck pixels of each camera, the last batch axis: (C, count) indices into a frame."""
    cameras = shape[-3] if len(shape) > 2 else 1
    pixels = shape[-2] * shape[-1]
    generator = torch.Generator(device).manual_seed(sensor.hot_pixel_seed)
    count = round(sensor.hot_pixels * pixels)
    return torch.randint(pixels, (cameras, count), generator=generator, device=device)
