"""Our own image encoders: from images to a feature map at an output stride of 4 pixels.

Both produce maps of the same size and width, and are matched: about 1.1 million weights, and half a GFLOP for 224 x 224
pixels.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from imgcal.networks.layers import transformer

STRIDE = 4  # pixels of the image per cell of the map
PATCH = 16  # pixels, width and height of a patch of the transformer


class Pyramid(nn.Module):
    """Merge maps of several strides into the finest one.

    Source: Lin et al., "Feature Pyramid Networks for Object Detection", CVPR 2017.
    """

    def __init__(self, widths: Sequence[int], width: int) -> None:
        """Create the layers; `widths` are those of the maps, from fine to coarse."""
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(inputs, width, 1) for inputs in widths)
        self.smooth = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in widths[1:-1])

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """(I, widths[0], h, w), ... -> (I, width, h, w)."""
        lateral = [layer(each) for layer, each in zip(self.lateral, maps, strict=True)]
        summed = lateral[-1]
        for level in range(len(lateral) - 2, -1, -1):
            summed = lateral[level] + functional.interpolate(summed, lateral[level].shape[-2:])
            if level:
                summed = summed + functional.relu(self.smooth[level - 1](summed))
        return summed


class Residual(nn.Module):
    """Residual block of two convolutions, without normalization, because the absolute brightness of a dot matters."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """(I, width, h, w) -> (I, width, h, w)."""
        return features + self.second(functional.relu(self.first(functional.relu(features))))


class CnnEncoder(nn.Module):
    """A small convolutional network: strides 4, 8, 16 and 32, and an additive upsampling path."""

    def __init__(
        self, width: int, dims: Sequence[int] = (32, 64, 96, 128), depths: Sequence[int] = (1, 1, 1, 2)
    ) -> None:
        """Create the layers: `dims` and `depths` are widths and residual blocks per stride, `width` is the map's."""
        super().__init__()
        self.width = width
        self.stem = nn.Conv2d(3, dims[0], 7, stride=STRIDE, padding=3)
        self.down = nn.ModuleList(
            nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in itertools.pairwise(dims)
        )
        self.stages = nn.ModuleList(
            nn.Sequential(*(Residual(inner) for _ in range(count))) for inner, count in zip(dims, depths, strict=True)
        )
        self.pyramid = Pyramid(dims, width)

    def forward(self, images: Tensor) -> Tensor:
        """Images (I, 3, H, W) -> (I, width, H / 4, W / 4)."""
        maps = [self.stages[0](self.stem(images))]
        for down, stage in zip(self.down, self.stages[1:], strict=True):
            maps.append(stage(down(functional.relu(maps[-1]))))
        return self.pyramid(maps)

    def group_matcher(self, coarse: bool = False) -> dict[str, Any]:
        """Group layers by depth, as timm's models do: for learning rates that decrease towards the images."""
        return {"stem": "^stem", "blocks": [(r"^(?:down|stages)\.(\d+)", None), (r"^pyramid", (99999,))]}


class VitEncoder(nn.Module):
    """A small vision transformer: the token of every patch is expanded to the cells of the map within it.

    Source: Dosovitskiy et al., "An Image is Worth 16x16 Words", ICLR 2021; Shi et al. (pixel shuffle), CVPR 2016.
    """

    def __init__(self, width: int, size: int, embed_dim: int = 128, depth: int = 4, num_heads: int = 4) -> None:
        """Create the layers for images of `size` pixels; `width` is the map's."""
        if embed_dim % num_heads:
            raise ValueError(
                f"found embed_dim {embed_dim} and {num_heads} heads, expected embed_dim to be a multiple of the heads"
            )
        super().__init__()
        self.width, self.size = width, size
        side = -(-size // PATCH)
        self.patches = nn.Conv2d(3, embed_dim, PATCH, stride=PATCH)
        self.place = nn.Parameter(0.02 * torch.randn(embed_dim, side, side))
        self.blocks = transformer(embed_dim, depth, num_heads)
        self.cells = Cells(embed_dim, width, PATCH // STRIDE)

    def forward(self, images: Tensor) -> Tensor:
        """Images (I, 3, H, W) -> (I, width, size / 4, size / 4); other sizes are resized."""
        images = resize_images(images, (self.size, self.size))
        tokens = self.patches(functional.pad(images, (0, -self.size % PATCH, 0, -self.size % PATCH))) + self.place
        encoded = self.blocks(tokens.flatten(2).mT).mT.unflatten(-1, tokens.shape[-2:])
        side = -(-self.size // STRIDE)
        return self.cells(encoded)[..., :side, :side]

    def group_matcher(self, coarse: bool = False) -> dict[str, Any]:
        """Group layers by depth, as timm's models do: for learning rates that decrease towards the images."""
        return {"stem": "^(?:patches|place)", "blocks": [(r"^blocks\.(\d+)", None), (r"^cells", (99999,))]}


class Cells(nn.Module):
    """From one token per patch to one feature per cell: linear, then pixel shuffle."""

    def __init__(self, inner: int, width: int, factor: int) -> None:
        """Create the layer; a patch is `factor` x `factor` cells."""
        super().__init__()
        self.factor = factor
        self.linear = nn.Conv2d(inner, width * factor**2, 1)

    def forward(self, tokens: Tensor) -> Tensor:
        """(I, inner, h, w) -> (I, width, h * factor, w * factor)."""
        return functional.pixel_shuffle(self.linear(tokens), self.factor)


def resize_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images (I, 3, H, W) to another size (height, width), unless they already have it."""
    if images.shape[-2:] == size:
        return images
    return functional.interpolate(images, size, mode="bilinear", antialias=True, align_corners=False)
