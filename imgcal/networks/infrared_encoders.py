"""Encoders of monochrome crops: a dense CNN and a small ViT with the same output stride, parameters and operations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from imgcal.networks.layers import TransformerBlock

STRIDE = 2
"""Crop pixels per cell of the feature map, for either encoder."""

EncoderName = Literal["cnn-small", "cnn", "cnn-large", "vit-small", "vit", "vit-large", "vit-stem"]
"""Encoders that an experiment file can name."""


class CropCnn(nn.Module):
    """Strides 2, 4 and 8 in 3x3 convolutions, and an additive upsampling path.

    The convolutions are dense, because depthwise ones are slow on a CPU. There is no normalization layer, because
    brightness is already normalized, and statistics of small batches would be noisy.
    """

    def __init__(self, channels: int, widths: tuple[int, int, int] = (24, 48, 88)) -> None:
        """Create the layers, for crops of any size that is a multiple of 8.

        Args:
            channels: of the feature map.
            widths: at strides 2, 4 and 8.
        """
        super().__init__()
        a, b, c = widths
        self.stem = nn.Conv2d(1, a, 3, stride=2, padding=1)
        self.fine = CropResidual(a)
        self.down_middle = nn.Conv2d(a, b, 3, stride=2, padding=1)
        self.middle = CropResidual(b)
        self.down_coarse = nn.Conv2d(b, c, 3, stride=2, padding=1)
        self.coarse = CropResidual(c)
        self.up_middle = nn.Conv2d(c, b, 1)
        self.up_fine = nn.Conv2d(b, a, 1)
        self.out = nn.Conv2d(a, channels, 3, padding=1)

    def forward(self, crops: Tensor) -> Tensor:
        """Encode crops (P, 1, S, S) as features (P, channels, S / 2, S / 2)."""
        fine = self.fine(functional.gelu(self.stem(crops)))
        middle = self.middle(functional.gelu(self.down_middle(fine)))
        coarse = self.coarse(functional.gelu(self.down_coarse(middle)))
        middle = middle + _upsample(self.up_middle(coarse))
        return self.out(functional.gelu(fine + _upsample(self.up_fine(middle))))

    def group_matcher(self, coarse: bool = False) -> dict[str, Any]:
        """Group layers by depth, as timm's models do: for learning rates that decrease towards the crops."""
        blocks = [(r"^(?:down_)?middle", (0,)), (r"^(?:down_)?coarse", (1,)), (r"^(?:up_|out)", (99999,))]
        return {"stem": "^(?:stem|fine)", "blocks": blocks}


class CropVit(nn.Module):
    """Patches of 6 pixels, attention over the whole crop, then each token is expanded to its own 3 x 3 cells."""

    def __init__(
        self, channels: int, size: int, width: int = 80, depth: int = 3, heads: int = 4, stem: int = 0
    ) -> None:
        """Create the layers for crops of one size.

        Args:
            channels: of the feature map.
            size: crop pixels, width and height; a multiple of the patch.
            width: of the tokens.
            depth: blocks.
            heads: of the attention.
            stem: channels of a convolution before the tokens (Xiao et al., Early Convolutions Help Transformers See
                Better, 2021); 0: patches are embedded directly.
        """
        super().__init__()
        patch = 3 * STRIDE
        self.embed: nn.Module = nn.Conv2d(1, width, patch, stride=patch)
        if stem:
            fine, tokens = nn.Conv2d(1, stem, 3, stride=2, padding=1), nn.Conv2d(stem, width, 3, stride=3)
            self.embed = nn.Sequential(fine, nn.GELU(), CropResidual(stem), tokens)
        self.position = nn.Parameter(0.02 * torch.randn(1, (size // patch) ** 2, width))
        self.blocks = nn.Sequential(*(TransformerBlock(width, heads) for _ in range(depth)))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, channels * 9)

    def forward(self, crops: Tensor) -> Tensor:
        """Encode crops (P, 1, S, S) as features (P, channels, S / 2, S / 2)."""
        patches = self.embed(crops)
        tokens = self.blocks(patches.flatten(2).mT + self.position)
        cells = self.out(self.norm(tokens)).mT.unflatten(-1, patches.shape[-2:])
        return functional.pixel_shuffle(cells, 3)

    def group_matcher(self, coarse: bool = False) -> dict[str, Any]:
        """Group layers by depth, as timm's models do: for learning rates that decrease towards the crops."""
        return {"stem": "^(?:embed|position)", "blocks": [(r"^blocks\.(\d+)", None), (r"^(?:norm|out)", (99999,))]}


class CropResidual(nn.Module):
    """Residual block of two 3x3 convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.normal_(self.second.weight, std=0.01)

    def forward(self, x: Tensor) -> Tensor:
        """Keep the shape (P, width, H, W)."""
        return x + self.second(functional.gelu(self.first(x)))


ENCODERS: dict[EncoderName, Callable[[int, int], nn.Module]] = {
    "cnn-small": lambda channels, size: CropCnn(channels, (17, 34, 62)),
    "cnn": lambda channels, size: CropCnn(channels),
    "cnn-large": lambda channels, size: CropCnn(channels, (34, 68, 124)),
    "vit-small": lambda channels, size: CropVit(channels, size, width=64, depth=2),
    "vit": lambda channels, size: CropVit(channels, size),
    "vit-large": lambda channels, size: CropVit(channels, size, width=96, depth=4),
    "vit-stem": lambda channels, size: CropVit(channels, size, width=72, stem=16),
}
"""Constructors by name, of channels of the feature map and pixels of the crop; equal sizes have equal cost."""


def _upsample(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")
