"""Image variants: one colour-coded image a camera in, a rig out. The paper's network and ours; any timm backbone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, cast

import timm
import torch
from torch import Tensor, nn
from torch.nn import functional

from imgcal.errors import InputError
from imgcal.formats.names import nearest
from imgcal.networks.config import Images, PaperImages
from imgcal.networks.decode import Decoder
from imgcal.networks.points import PaperHeads
from imgcal.networks.positions import soft_positions
from imgcal.networks.prediction import Prediction, Views
from imgcal.networks.rendering import ImageOptions
from imgcal.networks.trunk import Trunk

SIZE = 224  # pixels, width and height that the encoders take


class Backbone(nn.Module):
    """A timm model without its classifier: a pooled feature, and a map of features over the image."""

    def __init__(self, name: str, pretrained: bool, options: Mapping[str, Any]) -> None:
        super().__init__()
        self.model: Any = make_backbone(name, pretrained, options)
        self.map_width = cast(int, self.model.num_features)
        self.pooled_width = cast(int, getattr(self.model, "head_hidden_size", None) or self.map_width)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images (I, 3, H, W); other sizes than the encoder's are resized.

        Returns:
            The pooled feature (I, pooled_width) and the map (I, map_width, h, w).
        """
        if images.shape[-2:] != (SIZE, SIZE):
            images = functional.interpolate(images, (SIZE, SIZE), mode="bilinear", antialias=True, align_corners=False)
        features = self.model.forward_features(images)
        pooled = self.model.forward_head(features, pre_logits=True)
        if features.ndim == 3:  # tokens: those before the patches (class token) do not belong to the map
            patches = features[:, int(getattr(self.model, "num_prefix_tokens", 0)) :]
            side = round(patches.shape[1] ** 0.5)
            features = patches.mT.unflatten(-1, (side, -1))
        elif getattr(self.model, "output_fmt", "NCHW") == "NHWC":
            features = features.movedim(-1, 1)
        return pooled, features


class PaperImageNetwork(nn.Module):
    """The paper's image variant: each image on its own through an encoder, bottleneck to 128, five heads.

    Source: paper, supplementary section 1.2.
    """

    def __init__(self, config: PaperImages, decoder: Decoder) -> None:
        super().__init__()
        self.image_options: ImageOptions = ImageOptions(size=SIZE)
        self.decoder = decoder
        self.backbone = Backbone(config.backbone, config.pretrained, config.options)
        self.bottleneck = nn.Linear(self.backbone.pooled_width, config.bottleneck)
        self.heads = PaperHeads(config.bottleneck, config.head_widths)

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`."""
        images = images_of(views)
        pooled, _ = self.backbone(images.flatten(0, 1))
        numbers = self.heads(self.bottleneck(pooled).unflatten(0, images.shape[:2]))
        with torch.autocast(images.device.type, enabled=False):
            return (self.decoder.absolute(numbers),)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates."""
        groups = {"encoder": self.backbone.parameters(), "bottleneck": self.bottleneck.parameters()}
        return groups | self.heads.groups()


class ImageNetwork(nn.Module):
    """Our image variant: an encoder weighs where each fiducial may be, positions go to the trunk in float32.

    The encoder's map gives each fiducial a belief over the image, zero at first, that multiplies the likeness of
    colours; its pooled feature goes to the trunk beside the positions, through the bottleneck. With
    `positions: false` the pooled feature is all that the trunk is told, as in the paper.
    """

    colours: Tensor  # (N, 3)

    def __init__(self, config: Images, decoder: Decoder, colours: Tensor) -> None:
        super().__init__()
        self.image_options: ImageOptions = ImageOptions(size=SIZE)
        self.decoder = decoder
        self.register_buffer("colours", colours.to(decoder.focal_length), persistent=False)
        self.backbone = Backbone(config.backbone, config.pretrained, config.options)
        self.bottleneck = nn.Linear(self.backbone.pooled_width, config.bottleneck)
        self.positions = config.positions
        if config.positions:
            self.belief = nn.Conv2d(self.backbone.map_width, len(colours), 1)
            for parameter in self.belief.parameters():
                nn.init.zeros_(parameter)
        self.trunk = Trunk(decoder, **config.trunk.model_dump(), features=config.bottleneck)

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction a pass."""
        images = images_of(views)
        flat = images.flatten(0, 1)
        pooled, features = self.backbone(flat)
        bottleneck = functional.gelu(self.bottleneck(pooled)).float().unflatten(0, images.shape[:2])
        with torch.autocast(images.device.type, enabled=False):
            if not self.positions:
                nothing = images.new_zeros((*images.shape[:2], len(self.colours)), dtype=torch.float32)
                return self.trunk(nothing[..., None].expand(*nothing.shape, 2), nothing, bottleneck)
            belief = self.belief(features.float())
            options = self.image_options
            in_image, confidence = soft_positions(flat.float(), self.colours, options.dot, belief)
            in_image = in_image.unflatten(0, images.shape[:2])
            uv = ImageOptions(images.shape[-1], options.dot).to_sensor(in_image, self.decoder.image_size)
        return self.trunk(uv, confidence.unflatten(0, images.shape[:2]), bottleneck)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates."""
        heads = [*self.bottleneck.parameters(), *(self.belief.parameters() if self.positions else ())]
        return {"encoder": self.backbone.parameters(), "heads": heads, "trunk": self.trunk.parameters()}


def make_backbone(name: str, pretrained: bool, options: Mapping[str, Any]) -> nn.Module:
    """Make a timm model without a classifier.

    Args:
        name: as `timm.list_models()` has it.
        pretrained: load the published weights; needs network access or a filled cache.
        options: further arguments of `timm.create_model`.

    Raises:
        InputError: no such model, options that it does not take, or no way to its weights.
    """
    if not timm.is_model(name):
        raise InputError(f"backbone: found `{name}`, expected a timm model{nearest(name, timm.list_models())}")
    try:
        return timm.create_model(name, pretrained=pretrained, num_classes=0, **options)
    except TypeError as error:
        raise InputError(f"backbone {name}: found options {dict(options)} that it does not take: {error}") from error
    except (OSError, RuntimeError) as error:
        if not pretrained:
            raise InputError(f"backbone {name}: cannot be made: {str(error).splitlines()[0]}") from error
        raise InputError(
            f"backbone {name}: its pretrained weights cannot be loaded ({str(error).splitlines()[0]}); go online, "
            "put them into timm's cache (HF_HOME), or set pretrained: false"
        ) from error


def images_of(views: Views) -> Tensor:
    """Images (B, C, 3, H, W).

    Raises:
        ValueError: the views hold points only.
    """
    if views.images is None:
        raise ValueError("an image variant needs views.images, found points only")
    return views.images
