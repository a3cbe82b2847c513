"""`CropPlacement`: the position and scale of square crops in their images, and how crops are cut."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Networks for frames must be given crops like those they were trained on.
CROP_MARGIN = 0.06
"""Margin around the expected object, as a share of the focal length: a drift of 3 degrees."""
CROP_SIZE = 96
"""Crop pixels, width and height: markers, motion and drift have their usual sizes at this one alone."""
PATCH_SIZE = 24
"""Pixels, width and height of a patch around one marker."""


@dataclass(frozen=True)
class CropPlacement:
    """Crops of `size` x `size` pixels, each the mean of `scale` x `scale` pixels of its image.

    Examples:
        >>> placement = CropPlacement(corner=torch.tensor([99.5, 49.5]), scale=torch.tensor(8.0), size=96)
        >>> placement.to_crop(torch.tensor([[103.5, 53.5]]))  # the middle of the crop's first pixel
        tensor([[0., 0.]])
        >>> placement.to_image(torch.tensor([[0.0, 1.0]]))
        tensor([[103.5000,  61.5000]])
    """

    corner: Tensor  # (*B, 2) pixels, the outer corner of the crop: a whole number minus 1/2
    scale: Tensor  # (*B) image pixels per crop pixel
    size: int  # crop pixels, each way

    @classmethod
    def around(cls, uv: Tensor, seen: Tensor, margin: Tensor, size: int) -> CropPlacement:
        """Place crops around points, reduced by a whole number, so that the points and a margin fit.

        Args:
            uv: (*B, N, 2) pixels.
            seen: (*B, N) bool, points to include; without any, the crop lies at the image's corner.
            margin: (*B) pixels to be left on each side.
            size: crop pixels, each way.
        """
        counted = seen[..., None]
        low = uv.masked_fill(~counted, torch.inf).amin(-2)
        high = uv.masked_fill(~counted, -torch.inf).amax(-2)
        some = seen.any(-1)
        low, high = (torch.where(some[..., None], value, 0.0) for value in (low, high))
        half = ((high - low).amax(-1) / 2 + margin).clamp(max=1e6)
        scale = torch.ceil(2 * half / size).clamp(min=1)
        corner = torch.round((low + high) / 2 - scale[..., None] * size / 2) - 0.5
        return cls(corner, scale, size)

    def to_crop(self, uv: Tensor) -> Tensor:
        """Turn image pixels (*B, N, 2) into crop pixels."""
        return (uv - self.corner[..., None, :]) / self.scale[..., None, None] - 0.5

    def to_image(self, crop: Tensor) -> Tensor:
        """Turn crop pixels (*B, N, 2) into image pixels."""
        return (crop + 0.5) * self.scale[..., None, None] + self.corner[..., None, :]
