"""The input of image networks: one square image per camera, every fiducial a soft dot in its own colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import resized_pixels
from imgcal.io import StrictRecord
from imgcal.types import CalibrationObject
from renderers import splat

GREY_LEVELS = 255  # largest grey level of images as they are saved


@dataclass(frozen=True)
class ImageOptions(StrictRecord):
    """Size of the images, and of the dots in them; also the block `images` of an experiment file."""

    size: Annotated[int, Field(ge=8, le=4096)] = 224  # pixels, width and height
    dot: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.5  # pixels of the image, standard deviation of a dot

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.dot < self.size:
            raise InputError(f"dot: found {self.dot}, expected less than the {self.size} pixels of the image")

    def from_sensor(self, uv: Tensor, image_size: Tensor) -> Tensor:
        """Take sensor pixels (*B, C, N, 2) to pixels of the image by the pixel-centre rule u' + 1/2 = s (u + 1/2)."""
        return resized_pixels(uv, (self.size / image_size.to(uv))[:, None])

    def to_sensor(self, uv: Tensor, image_size: Tensor) -> Tensor:
        """Take pixels of the image (*B, C, N, 2) to pixels of the sensor: the inverse of `from_sensor`."""
        return resized_pixels(uv, (image_size.to(uv) / self.size)[:, None])


def render_views(
    uv: Tensor,
    seen: Tensor,
    image_size: Tensor,
    obj: CalibrationObject,
    options: ImageOptions = ImageOptions(),
    *,
    quantise: bool = False,
    out: Tensor | None = None,
) -> Tensor:
    """Draw the images that an image network takes: `Views.images`.

    Differentiable in uv. Without gradients, a reused `out` saves most of the time on a CPU (see `renderers.splat`).

    Args:
        uv: (*B, C, N, 2) pixels of the sensor, projected or detected; anything where not seen.
        seen: (*B, C, N) bool; the others are not drawn.
        image_size: (C, 2) width and height of the sensors (`CameraRig.image_size`).
        obj: N fiducials, whose colours are drawn.
        options: size of the images and of the dots.
        quantise: round to 8 bit as images that were saved are; the gradient passes as if it did not.
        out: (*B, C, 3, size, size) contiguous buffer that is overwritten and returned; not differentiable.

    Returns:
        (*B, C, 3, size, size) in [0, 1] on black; where dots overlap their light adds up, at most to 1.

    Raises:
        ValueError: shapes that do not belong together, or `out` while gradients are recorded.

    Examples:
        >>> import imgcal
        >>> obj, image_size = imgcal.load_object("cube8"), torch.tensor([[2048, 1088]])
        >>> uv = torch.rand(1, 8, 2, generator=torch.Generator().manual_seed(0)) * image_size
        >>> render_views(uv, torch.ones(1, 8, dtype=torch.bool), image_size, obj, ImageOptions(size=64)).shape
        torch.Size([1, 3, 64, 64])
    """
    points = options.from_sensor(uv, image_size)
    colours = obj.colours.to(points)
    shape = (options.size, options.size)
    if torch.is_grad_enabled() and points.requires_grad:
        images = splat(points, colours, options.dot, shape, visible=seen, out=out).clamp(0, 1)
        return images + (round_to_grey_levels(images.detach().clone()) - images.detach()) if quantise else images
    # Rounded to 8 bit before anything coarser: a bfloat16 buffer would round first.
    direct = out is None or not quantise or out.dtype == points.dtype
    images = splat(points, colours, options.dot, shape, visible=seen, out=out if direct else None).clamp_(0, 1)
    if quantise:
        images = round_to_grey_levels(images)
    return images if direct or out is None else out.copy_(images)


def round_to_grey_levels(images: Tensor) -> Tensor:
    """Round images in [0, 1] to grey levels, in place."""
    return images.mul_(GREY_LEVELS).round_().div_(GREY_LEVELS)
