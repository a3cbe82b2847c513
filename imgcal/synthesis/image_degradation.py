"""How hard colour-coded images are to read: `LEVELS` 0 to 4, what happens to dots and pixels in each.

A level adds to the one before it. In every image the strength of pixel noise, blur and background is drawn from
zero to the number that is named, so that a network meets all that lies between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from imgcal.io import StrictRecord
from imgcal.synthesis.colour_coding import ImageOptions, round_to_grey_levels
from imgcal.synthesis.corruption import Corrupted, Corruption
from imgcal.types import CalibrationObject, Views
from renderers import splat

COARSE = 7  # cells, width and height of the random map that is spread over an image as its background
BLUR_REACH = 3  # standard deviations of the strongest blur that its kernel reaches

Amount = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True)
class Degradation(StrictRecord):
    """What happens to the dots of colour-coded images, and to the pixels. Zero is nothing.

    Light is in shares of a full channel, lengths are in pixels of the image.
    """

    points: Corruption = Corruption()  # of what was detected, in pixels of the sensor: dots are drawn where it says
    pixel_noise: Amount = 0.0  # light, largest standard deviation of the noise of an image's pixels
    size: Amount = 0.0  # a dot's size is multiplied by exp(-size) to exp(size)
    colour: Amount = 0.0  # standard deviation of the relative error of each channel of a dot
    strays: Annotated[int, Field(ge=0, le=64)] = 0  # most dots of no fiducial in an image, of any colour, anywhere
    merged: Share = 0.0  # share of strays that touch the dot of a fiducial
    blur: Amount = 0.0  # largest standard deviation of an image's blur
    background: Amount = 0.0  # light, largest of an image's background
    jpeg: Annotated[int, Field(ge=0, le=100)] = 0  # least quality, up to 95, that images were saved with; 0 = exactly

    @torch.no_grad()
    def draw(
        self,
        views: Views,
        image_size: Tensor,
        obj: CalibrationObject,
        options: ImageOptions,
        generator: torch.Generator,
    ) -> tuple[Tensor, Corrupted]:
        """Draw the images of labelled points that an image network gets, on the device of the points.

        Args:
            views: uv (B, C, N, 2) pixels of the sensor, and seen (B, C, N).
            image_size: (C, 2) width and height of the sensors.
            obj: N fiducials, whose colours are drawn.
            options: size of the images and of the dots.
            generator: on the device of the views.

        Returns:
            Images (B, C, 3, size, size) in [0, 1], 8 bit a channel; and the views as they are drawn: where each
            fiducial's dot is, which dots are there, and which of them are what they are said to be.

        Examples:
            >>> import imgcal
            >>> uv = torch.rand(2, 1, 8, 2, generator=torch.Generator().manual_seed(0)) * 1000
            >>> views = Views(uv, torch.ones(2, 1, 8, dtype=torch.bool))
            >>> given = (views, torch.tensor([[1000, 1000]]), imgcal.load_object("cube8"), ImageOptions(size=64))
            >>> images, drawn = LEVELS[2].draw(*given, torch.Generator().manual_seed(1))
            >>> images.shape, drawn.inlier.shape
            (torch.Size([2, 1, 3, 64, 64]), torch.Size([2, 1, 8]))
        """
        drawn = self.points.apply(views, image_size, generator)
        uv, seen = drawn.views.uv, drawn.views.seen
        assert uv is not None and seen is not None
        images = self._dots(options.from_sensor(uv, image_size), seen, obj.colours.to(uv), options, generator)
        return round_to_grey_levels(self._degrade(images.flatten(0, 1), generator).view_as(images)), drawn

    def _dots(
        self, uv: Tensor, seen: Tensor, colours: Tensor, options: ImageOptions, generator: torch.Generator
    ) -> Tensor:
        """Splat fiducials (B, C, N, 2) and strays on black: (B, C, 3, size, size)."""
        batch, count, strays = uv.shape[:-2], uv.shape[-2], self.strays
        total = count + strays
        near = torch.randint(count, (*batch, strays), generator=generator, device=uv.device)
        uniform = torch.rand((*batch, strays, 5), generator=generator, dtype=uv.dtype, device=uv.device)
        normal = torch.randn((*batch, total, 5), generator=generator, dtype=uv.dtype, device=uv.device)
        size = torch.rand((*batch, total), generator=generator, dtype=uv.dtype, device=uv.device) * 2 - 1
        touching = uv.gather(-2, near[..., None].expand(*near.shape, 2)) + options.dot * normal[..., count:, 3:]
        place = torch.where(uniform[..., :1] < self.merged, touching, uniform[..., 1:3] * options.size - 0.5)
        # As many strays as the image's own share of the most: each is there with that share.
        there = uniform[..., 3] < torch.rand((*batch, 1), generator=generator, dtype=uv.dtype, device=uv.device)
        paint = torch.cat((colours.expand(*batch, -1, -1), (normal[..., count:, :3].abs()).clamp_max(1)), dim=-2)
        paint = (paint * (1 + self.colour * normal[..., :3])).clamp(0, 1)
        return splat(
            torch.cat((uv, place), dim=-2),
            paint,
            options.dot * (self.size * size).exp(),
            (options.size, options.size),
            visible=torch.cat((seen, there), dim=-1),
        )

    def _degrade(self, images: Tensor, generator: torch.Generator) -> Tensor:
        """Background, blur, noise and compression of images (I, 3, H, W)."""
        count, _, height, width = images.shape
        like: dict[str, Any] = {"generator": generator, "dtype": images.dtype, "device": images.device}
        strength = torch.rand((3, count, 1, 1, 1), **like)
        if self.background:
            coarse = torch.rand(
                (count, 3, COARSE, COARSE), generator=generator, dtype=images.dtype, device=images.device
            )
            smooth = functional.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)
            images = images + self.background * strength[0] * smooth
        if self.blur:
            images = _blur(images, self.blur * strength[1], self.blur)
        if self.pixel_noise:
            noise = torch.randn(images.shape, **like)
            images = images + self.pixel_noise * strength[2] * noise
        images = images.clamp(0, 1)
        return _compress(images, self.jpeg, generator) if self.jpeg else images


_NOISY = Corruption(noise=0.1)
_DOTS: dict[str, Any] = {"size": 0.4, "colour": 0.08, "strays": 4}

LEVELS: tuple[Degradation, ...] = (
    Degradation(),
    Degradation(points=_NOISY, pixel_noise=0.06),
    Degradation(points=Corruption(noise=0.1, missing=0.05, false=0.01), pixel_noise=0.06, **_DOTS),
    Degradation(
        points=Corruption(noise=0.1, missing=0.05, false=0.01),
        pixel_noise=0.06, merged=0.3, blur=1.5, background=0.25, **_DOTS,
    ),
    Degradation(
        points=Corruption(noise=0.2, missing=0.1, swapped=0.02, false=0.03),
        pixel_noise=0.09, merged=0.3, blur=1.5, background=0.35, jpeg=50, **{**_DOTS, "strays": 8},
    ),
)  # fmt: skip
"""By difficulty: 0 exact dots in 8 bit; 1 noise of positions and pixels; 2 wrong sizes and colours, missing and false
dots; 3 blur, background, merged dots; 4 more of all that, exchanged labels, JPEG."""


def _blur(images: Tensor, sigma: Tensor, largest: float) -> Tensor:
    """Blur each image (I, 3, H, W) with its own Gaussian, sigma (I, 1, 1, 1) pixels."""
    reach = max(1, round(BLUR_REACH * largest))
    offset = torch.arange(-reach, reach + 1, device=images.device, dtype=images.dtype)
    kernel = torch.softmax(-0.5 * (offset / sigma.view(-1, 1).clamp_min(1e-2)).square(), dim=-1)  # (I, K)
    count, channels = images.shape[:2]
    each = kernel.repeat_interleave(channels, 0)[:, None]  # one group a channel of an image
    flat = functional.pad(images.flatten(0, 1)[None], (reach,) * 4, mode="replicate")
    flat = functional.conv2d(flat, each[..., None], groups=count * channels)
    return functional.conv2d(flat, each[..., None, :], groups=count * channels).view_as(images)


def _compress(images: Tensor, least: int, generator: torch.Generator) -> Tensor:
    """Save and load images (I, 3, H, W) as JPEG, each with its own quality."""
    from kornia.enhance import jpeg_codec_differentiable  # slow to import, and only the last level needs it

    draw = torch.rand(len(images), generator=generator, dtype=images.dtype, device=images.device)
    height, width = images.shape[-2:]
    padded = functional.pad(images, (0, -width % 16, 0, -height % 16), mode="replicate")
    return jpeg_codec_differentiable(padded, least + (95 - least) * draw)[..., :height, :width].clamp(0, 1)
