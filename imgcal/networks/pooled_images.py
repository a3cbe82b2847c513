"""Image variants with one pooled feature per image: the paper's network, and ours for comparison."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import nn
from torch.nn import functional

from imgcal.networks.backbone import Backbone
from imgcal.networks.config import PaperImages, PooledImages
from imgcal.networks.images import stack_images
from imgcal.networks.network import Network
from imgcal.networks.parameterization import Parameterization
from imgcal.networks.points import PaperHeads
from imgcal.networks.refiner import IterativeRefiner
from imgcal.synthesis import ImageOptions
from imgcal.types import Prediction, Views


class _PooledNetwork(Network):
    """An encoder whose pooled feature of each image goes through a bottleneck."""

    def __init__(
        self, config: PaperImages | PooledImages, parameterization: Parameterization, images: ImageOptions | None = None
    ) -> None:
        """Create the layers; the image size is the encoder's own unless `images` overrides it."""
        size = None if images is None else images.size
        backbone = Backbone(config.backbone, config.pretrained, config.options, size)
        super().__init__(parameterization, images or ImageOptions(size=max(backbone.size)))
        self.backbone = backbone
        self.bottleneck = nn.Linear(self.backbone.width, config.bottleneck)

    @property
    def encoder(self) -> nn.Module:
        """The image encoder."""
        return self.backbone


class PaperImageNetwork(_PooledNetwork):
    """The paper's image variant: each image goes through an encoder by itself, a bottleneck to 128, and five heads.

    Source: paper, supplementary section 1.2.
    """

    def __init__(
        self, config: PaperImages, parameterization: Parameterization, images: ImageOptions | None = None
    ) -> None:
        """Create the layers; see `_PooledNetwork`."""
        super().__init__(config, parameterization, images)
        self.heads = PaperHeads(config.bottleneck, config.head_widths, parameterization.widths)

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`."""
        images = stack_images(views)
        pooled = self.backbone(images.flatten(0, 1))
        numbers = self.heads(self.bottleneck(pooled).unflatten(0, images.shape[:2]))
        with torch.autocast(images.device.type, enabled=False):
            return (self.parameterization.absolute(numbers),)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        groups = {"encoder": self.backbone.parameters(), "bottleneck": self.bottleneck.parameters()}
        return groups | self.heads.groups()


class PooledImageNetwork(_PooledNetwork):
    """An image variant with one pooled feature per image, like the paper's, and our trunk."""

    def __init__(
        self, config: PooledImages, parameterization: Parameterization, images: ImageOptions | None = None
    ) -> None:
        """Create the layers; see `_PooledNetwork`."""
        super().__init__(config, parameterization, images)
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump(), features=config.bottleneck)

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction per pass."""
        images = stack_images(views)
        features = functional.gelu(self.bottleneck(self.backbone(images.flatten(0, 1))))
        fiducials = len(self.parameterization.colours)
        nothing = images.new_zeros((*images.shape[:2], fiducials), dtype=torch.float32)
        uv = nothing[..., None].expand(*nothing.shape, 2)
        return self.trunk(uv, nothing, features.float().unflatten(0, images.shape[:2]))

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        return {
            "encoder": self.backbone.parameters(),
            "heads": self.bottleneck.parameters(),
            "trunk": self.trunk.parameters(),
        }
