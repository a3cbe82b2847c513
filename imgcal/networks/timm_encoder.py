"""timm models as image encoders: a feature map at a stride of 4 pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import timm
import torch
from timm.data import resolve_data_config
from torch import Tensor, nn
from torch.nn import functional

from imgcal.networks.backbone import input_size, make_backbone
from imgcal.networks.encoders import STRIDE, Cells, Pyramid, resize_images


class TimmEncoder(nn.Module):
    """A timm model: the sum of its maps of several strides, if it has them; otherwise its tokens, expanded to cells."""

    mean: Tensor  # (3, 1, 1)
    std: Tensor  # (3, 1, 1)

    def __init__(self, name: str, pretrained: bool, options: Mapping[str, Any], width: int) -> None:
        """Create the model without its classifier, and the layers that convert its features to a map of `width`."""
        super().__init__()
        plain = make_backbone(name, pretrained, options)
        self.size = input_size(plain)
        wanted = resolve_data_config({}, model=plain)
        self.register_buffer("mean", torch.tensor(wanted["mean"]).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(wanted["std"]).view(3, 1, 1), persistent=False)
        strided, levels = _make_strided(name, pretrained, options)
        self.model: Any = strided or plain
        self.levels = levels
        if strided is not None:
            widths = [strided.feature_info.channels()[level] for level in levels]
            self.join: nn.Module = Pyramid(widths, width)
        else:
            with torch.no_grad():
                side = self._tokens(torch.zeros(1, 3, *self.size)).shape[-1]
            factor = max(1, -(-self.size[1] // (side * STRIDE)))
            self.join = Cells(cast(int, plain.num_features), width, factor)

    def forward(self, images: Tensor) -> Tensor:
        """Images (I, 3, H, W) in [0, 1] -> (I, width, h / 4, w / 4) for the h x w pixels of the model's input."""
        height, width = self.size
        normalized = (resize_images(images, self.size) - self.mean) / self.std
        if self.levels:
            maps = self.model(normalized)
            maps = [_channels_first(self.model, maps[level]) for level in self.levels]
            features = self.join(maps)
        else:
            features = self.join(self._tokens(normalized))
        cells = -(-height // STRIDE), -(-width // STRIDE)
        if features.shape[-2:] == cells:
            return features
        return functional.interpolate(features, cells, mode="bilinear", align_corners=False)

    def _tokens(self, images: Tensor) -> Tensor:
        """(I, inner, h, w)."""
        features = self.model.forward_features(images)
        if features.ndim == 4:
            return _channels_first(self.model, features)
        # Tokens before the patches (class token) are not part of the map.
        patches = features[:, int(getattr(self.model, "num_prefix_tokens", 0)) :]
        side = round((patches.shape[1] * images.shape[-2] / images.shape[-1]) ** 0.5)
        return patches.mT.unflatten(-1, (side, -1))


def _make_strided(name: str, pretrained: bool, options: Mapping[str, Any]) -> tuple[Any, list[int]]:
    """Create a timm model that returns its maps, and the indices of those from stride 4 on; None without several."""
    try:
        model: Any = timm.create_model(name, pretrained=pretrained, features_only=True, **options)
        strides = model.feature_info.reduction()
    except (RuntimeError, AttributeError, AssertionError, TypeError, ValueError, KeyError):
        return None, []  # the errors of timm models without maps
    levels = [level for level, stride in enumerate(strides) if stride >= STRIDE]
    if len({strides[level] for level in levels}) < 2 or len(set(strides)) < len(strides):
        return None, []
    return model, levels


def _channels_first(model: Any, features: Tensor) -> Tensor:
    return features.movedim(-1, 1) if str(getattr(model, "output_fmt", "NCHW")).endswith("NHWC") else features
