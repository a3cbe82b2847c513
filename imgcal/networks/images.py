"""Image variants: one colour-coded image a camera in, a rig out; and the baseline that needs no encoder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from imgcal.geometry import resized_pixels
from imgcal.networks.config import HueCentroids, Images
from imgcal.networks.feature_maps import make_encoder
from imgcal.networks.locator import Located, PositionNetwork
from imgcal.networks.network import Network
from imgcal.networks.parameterization import Parameterization
from imgcal.networks.refiner import IterativeRefiner
from imgcal.networks.soft_positions import find_soft_positions
from imgcal.synthesis import ImageOptions
from imgcal.types import Prediction, Views

FOUND = 0.5  # confidence from which on a fiducial is taken to be there
TRUSTED = 3.0  # pixels of the sensor: positions of larger errors do not count for the trunk; a refinement weighs them
FAINT = 1e-3  # weight of what does not count: enough for a gradient to reach it


@dataclass(frozen=True)
class Positions:
    """Where a network sees fiducials, in pixels of the sensors."""

    uv: Tensor  # (B, C, N, 2)
    sigma: Tensor  # (B, C, N) one standard deviation of each axis, if the fiducial is there
    confidence: Tensor  # (B, C, N) in [0, 1]: probability that it is there

    @property
    def weight(self) -> Tensor:
        """How much each counts: (B, C, N), 1 or next to nothing, as points are there or not where the trunk learns.

        The gradient is that of a smooth weight (a straight-through estimator, Bengio et al. 2013).
        """
        smooth = self.confidence / (1 + (self.sigma / TRUSTED).square())
        counts = (self.confidence > FOUND) & (self.sigma < TRUSTED)
        return torch.where(counts, 1 + (smooth - smooth.detach()), FAINT * smooth)

    @property
    def views(self) -> Views:
        """The points that were found, for a refinement."""
        return Views(uv=self.uv, seen=self.confidence > FOUND)


class ImageNetwork(Network):
    """Our image variant: an encoder's map says where each fiducial is and how sure that is; the trunk says which rig.

    The gradient goes the whole way, from the rig to the images.
    """

    def __init__(self, config: Images, parameterization: Parameterization, images: ImageOptions | None = None) -> None:
        """Make the layers; images are as large as the encoder takes them unless `images` says otherwise."""
        backbone, width, size = make_encoder(config, None if images is None else images.size)
        super().__init__(parameterization, images or ImageOptions(size=size))
        # Keys of shipped weights.
        self.positions = PositionNetwork(backbone, width, len(parameterization.colours))
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump())

    @property
    def encoder(self) -> nn.Module:
        """The image encoder: nothing else says where to look."""
        return self.positions.backbone

    def sight(self, images: Tensor) -> Positions:
        """Locate the fiducials in the images of rigs (B, C, 3, H, W), in pixels of the sensors."""
        batch = images.shape[:2]
        located: Located = self.positions(images.flatten(0, 1))
        with torch.autocast(images.device.type, enabled=False):
            scale = self.parameterization.image_size.to(located.uv) / images.shape[-1]  # (C, 2)
            uv = resized_pixels(located.uv.unflatten(0, batch), scale[:, None])
            # Of Laplace's distribution; one number for both axes, as the points of a sensor have.
            sigma = 2**0.5 * located.log_scale.exp().unflatten(0, batch) * scale.prod(-1).sqrt()[:, None]
            return Positions(uv, sigma, located.confidence.unflatten(0, batch))

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction a pass."""
        found = self.sight(stack_images(views))
        return self.trunk(found.uv, found.weight)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates, or be frozen."""
        return {**self.positions.parameter_groups(), "trunk": self.trunk.parameters()}


class HueCentroidNetwork(Network):
    """No encoder: positions are the centres of all light of a fiducial's hue; then the same trunk. A baseline."""

    def __init__(
        self, config: HueCentroids, parameterization: Parameterization, images: ImageOptions | None = None
    ) -> None:
        """Make the trunk."""
        super().__init__(parameterization, images or ImageOptions())
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump())

    def sight(self, images: Tensor) -> Positions:
        """Find the fiducials in the images of rigs (B, C, 3, H, W), in pixels of the sensors."""
        assert self.image_options is not None
        batch = images.shape[:2]
        with torch.autocast(images.device.type, enabled=False):
            flat = images.flatten(0, 1).float()
            uv, confidence = find_soft_positions(flat, self.parameterization.colours, self.image_options.dot)
            scale = self.parameterization.image_size.to(uv) / images.shape[-1]
            uv = resized_pixels(uv.unflatten(0, batch), scale[:, None])
            return Positions(uv, torch.zeros_like(uv[..., 0]), confidence.unflatten(0, batch))

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction a pass."""
        found = self.sight(stack_images(views))
        return self.trunk(found.uv, found.weight)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates."""
        return {"trunk": self.trunk.parameters()}


def stack_images(views: Views) -> Tensor:
    """Images (B, C, 3, H, W).

    Raises:
        ValueError: the views hold points only.
    """
    if views.images is None:
        raise ValueError("an image variant needs views.images, found points only")
    return views.images
