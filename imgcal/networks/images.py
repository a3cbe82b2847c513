"""Image variants: one colour-coded image a camera in, a rig out. The paper's network and ours; any timm backbone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from imgcal.geometry import resized_pixels
from imgcal.networks.backbone import Backbone
from imgcal.networks.config import Images, PaperImages
from imgcal.networks.network import Network
from imgcal.networks.parameterization import Parameterization
from imgcal.networks.points import PaperHeads
from imgcal.networks.refiner import IterativeRefiner
from imgcal.networks.soft_positions import find_soft_positions
from imgcal.synthesis import ImageOptions
from imgcal.types import Prediction, Views


class PaperImageNetwork(Network):
    """The paper's image variant: each image on its own through an encoder, bottleneck to 128, five heads.

    Source: paper, supplementary section 1.2.
    """

    def __init__(
        self, config: PaperImages, parameterization: Parameterization, images: ImageOptions | None = None
    ) -> None:
        """Make the layers; images are as large as the encoder takes them unless `images` says otherwise."""
        backbone = Backbone(config.backbone, config.pretrained, config.options)
        super().__init__(parameterization, images or ImageOptions(size=max(backbone.size)))
        self.backbone = backbone
        self.bottleneck = nn.Linear(self.backbone.pooled_width, config.bottleneck)
        self.heads = PaperHeads(config.bottleneck, config.head_widths)

    @property
    def encoder(self) -> nn.Module:
        """What turns images into features."""
        return self.backbone

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`."""
        images = images_of(views)
        pooled, _ = self.backbone(images.flatten(0, 1))
        numbers = self.heads(self.bottleneck(pooled).unflatten(0, images.shape[:2]))
        with torch.autocast(images.device.type, enabled=False):
            return (self.parameterization.absolute(numbers),)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates."""
        groups = {"encoder": self.backbone.parameters(), "bottleneck": self.bottleneck.parameters()}
        return groups | self.heads.groups()


class ImageNetwork(Network):
    """Our image variant: an encoder weighs where each fiducial may be, positions go to the trunk in float32.

    The encoder's map gives each fiducial heatmap logits, zero at first, that multiplies the likeness of
    colours; its pooled feature goes to the trunk beside the positions, through the bottleneck. With
    `positions: false` the pooled feature is all that the trunk is told, as in the paper.
    """

    def __init__(self, config: Images, parameterization: Parameterization, images: ImageOptions | None = None) -> None:
        """Make the layers; images are as large as the encoder takes them unless `images` says otherwise."""
        backbone = Backbone(config.backbone, config.pretrained, config.options)
        drawn = images or ImageOptions(size=max(backbone.size))
        super().__init__(parameterization, drawn)
        self.backbone, self.dot = backbone, drawn.dot
        self.bottleneck = nn.Linear(self.backbone.pooled_width, config.bottleneck)
        self.positions = config.positions
        if config.positions:
            # Keys of shipped weights: `belief` makes heatmap logits, `trunk` is the iterative refiner.
            self.belief = nn.Conv2d(self.backbone.map_width, len(parameterization.colours), 1)
            for parameter in self.belief.parameters():
                nn.init.zeros_(parameter)
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump(), features=config.bottleneck)

    @property
    def encoder(self) -> nn.Module:
        """What turns images into features."""
        return self.backbone

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction a pass."""
        images = images_of(views)
        flat = images.flatten(0, 1)
        pooled, features = self.backbone(flat)
        bottleneck = functional.gelu(self.bottleneck(pooled)).float().unflatten(0, images.shape[:2])
        with torch.autocast(images.device.type, enabled=False):
            if not self.positions:
                nothing = images.new_zeros((*images.shape[:2], len(self.parameterization.colours)), dtype=torch.float32)
                return self.trunk(nothing[..., None].expand(*nothing.shape, 2), nothing, bottleneck)
            heatmap_logits = self.belief(features.float())
            in_image, confidence = find_soft_positions(
                flat.float(), self.parameterization.colours, self.dot, heatmap_logits
            )
            in_image = in_image.unflatten(0, images.shape[:2])
            scale = self.parameterization.image_size.to(in_image) / images.shape[-1]
            uv = resized_pixels(in_image, scale[:, None])
        return self.trunk(uv, confidence.unflatten(0, images.shape[:2]), bottleneck)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates."""
        heads = [*self.bottleneck.parameters(), *(self.belief.parameters() if self.positions else ())]
        return {"encoder": self.backbone.parameters(), "heads": heads, "trunk": self.trunk.parameters()}


def images_of(views: Views) -> Tensor:
    """Images (B, C, 3, H, W).

    Raises:
        ValueError: the views hold points only.
    """
    if views.images is None:
        raise ValueError("an image variant needs views.images, found points only")
    return views.images
