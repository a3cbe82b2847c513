"""Image variants: from one colour-coded image per camera to a rig; and a baseline without an encoder."""

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

FOUND = 0.5  # smallest confidence at which a fiducial counts as detected
TRUSTED = 3.0  # pixels of the sensor: the trunk ignores positions with larger errors; a refinement weights them
FAINT = 1e-3  # weight of ignored positions: enough for a gradient to reach them


@dataclass(frozen=True)
class Positions:
    """Fiducial positions that a network found, in pixels of the sensors."""

    uv: Tensor  # (B, C, N, 2)
    sigma: Tensor  # (B, C, N) standard deviation per axis, if the fiducial is there
    confidence: Tensor  # (B, C, N) in [0, 1]: probability that it is there

    @property
    def weight(self) -> Tensor:
        """Weight of each position: (B, C, N), 1 or almost 0, like points that are seen or not in the trunk's training.

        The gradient is that of a smooth weight (a straight-through estimator, Bengio et al. 2013).
        """
        smooth = self.confidence / (1 + (self.sigma / TRUSTED).square())
        counts = (self.confidence > FOUND) & (self.sigma < TRUSTED)
        return torch.where(counts, 1 + (smooth - smooth.detach()), FAINT * smooth)

    @property
    def views(self) -> Views:
        """The detected points, for a refinement."""
        return Views(uv=self.uv, seen=self.confidence > FOUND)


class ImageNetwork(Network):
    """Our image variant: an encoder's map gives fiducial positions and their errors; the trunk predicts the rig.

    The whole path from the images to the rig is differentiable.
    """

    def __init__(self, config: Images, parameterization: Parameterization, images: ImageOptions | None = None) -> None:
        """Create the layers; the image size is the encoder's own unless `images` overrides it."""
        backbone, width, size = make_encoder(config, None if images is None else images.size)
        super().__init__(parameterization, images or ImageOptions(size=size))
        # These names are keys of shipped weights.
        self.positions = PositionNetwork(backbone, width, len(parameterization.colours))
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump())

    @property
    def encoder(self) -> nn.Module:
        """The image encoder, which alone determines where to look."""
        return self.positions.backbone

    def sight(self, images: Tensor) -> Positions:
        """Locate the fiducials in the images of rigs (B, C, 3, H, W), in pixels of the sensors."""
        batch = images.shape[:2]
        located: Located = self.positions(images.flatten(0, 1))
        with torch.autocast(images.device.type, enabled=False):
            scale = self.parameterization.image_size.to(located.uv) / images.shape[-1]  # (C, 2)
            uv = resized_pixels(located.uv.unflatten(0, batch), scale[:, None])
            # Standard deviation of a Laplace distribution; one number for both axes, as for points on the sensor.
            sigma = 2**0.5 * located.log_scale.exp().unflatten(0, batch) * scale.prod(-1).sqrt()[:, None]
            return Positions(uv, sigma, located.confidence.unflatten(0, batch))

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction per pass."""
        found = self.sight(stack_images(views))
        return self.trunk(found.uv, found.weight)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates or freezing."""
        return {**self.positions.parameter_groups(), "trunk": self.trunk.parameters()}


class HueCentroidNetwork(Network):
    """A baseline without an encoder: positions are the centroids of a fiducial's hue; then the same trunk."""

    def __init__(
        self, config: HueCentroids, parameterization: Parameterization, images: ImageOptions | None = None
    ) -> None:
        """Create the trunk."""
        super().__init__(parameterization, images or ImageOptions())
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump())

    def sight(self, images: Tensor) -> Positions:
        """Locate the fiducials in the images of rigs (B, C, 3, H, W), in pixels of the sensors."""
        assert self.image_options is not None
        batch = images.shape[:2]
        with torch.autocast(images.device.type, enabled=False):
            flat = images.flatten(0, 1).float()
            uv, confidence = find_soft_positions(flat, self.parameterization.colours, self.image_options.dot)
            scale = self.parameterization.image_size.to(uv) / images.shape[-1]
            uv = resized_pixels(uv.unflatten(0, batch), scale[:, None])
            return Positions(uv, torch.zeros_like(uv[..., 0]), confidence.unflatten(0, batch))

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.images`; one prediction per pass."""
        found = self.sight(stack_images(views))
        return self.trunk(found.uv, found.weight)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        return {"trunk": self.trunk.parameters()}


def stack_images(views: Views) -> Tensor:
    """Return the images (B, C, 3, H, W).

    Raises:
        ValueError: the views have only points.
    """
    if views.images is None:
        raise ValueError("an image variant needs views.images, found points only")
    return views.images
