"""Fiducial positions from an encoder's map: heatmaps locate them roughly, and the pixels there precisely.

Everything here is float32. Only the map decides where to look: with another image's map, that is the wrong place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from kornia.geometry.subpix import spatial_expectation2d, spatial_softmax2d
from torch import Tensor, nn
from torch.nn import functional

from imgcal.geometry import resized_pixels
from imgcal.networks.layers import mlp, zero_last_layer

WINDOW = 5  # cells around the maximum of a heatmap in which its centroid is computed
CROP = 9  # pixels, side of the crop around this centroid
DARK = 1 / 255  # keeps the logarithm of brightness finite
SHARPEST, BLUNTEST = -8.0, 3.0  # limits of the log of the error's scale, pixels of the image


@dataclass(frozen=True)
class Located:
    """Output of a locator for I images, in pixels of the image."""

    uv: Tensor  # (I, N, 2)
    log_scale: Tensor  # (I, N) log of b, the mean absolute error per axis, if the dot is nearby
    confidence: Tensor  # (I, N) in [0, 1]: probability that the dot is nearby, rather than elsewhere or absent
    near: Tensor  # (I, N, 2) centre of the crop, without gradient
    logits: Tensor  # (I, N, h, w) of the cells
    nowhere: Tensor  # (I, N) logit that a fiducial is not in the image


class Locator(nn.Module):
    """Heads on an encoder's map: a heatmap per fiducial with a logit for absence, then a soft-argmax over pixels.

    Source: spatial soft-argmax by kornia; Laplace distribution of the errors (Kendall and Gal, NeurIPS 2017).
    """

    def __init__(self, width: int, fiducials: int, inner: int = 64) -> None:
        """Create the layers for maps of `width` features."""
        super().__init__()
        self.heatmaps = nn.Conv2d(width, fiducials, 1)
        self.nowhere = nn.Linear(width, fiducials)
        self.context = nn.Linear(width, inner)
        self.identity = nn.Parameter(0.5 * torch.randn(fiducials, inner))
        self.look = nn.Linear(8, inner, bias=False)
        self.weigh = mlp((inner, inner // 2, 1))
        self.correct = zero_last_layer(mlp((3 * CROP**2 + inner, inner, 3)))

    def forward(self, features: Tensor, images: Tensor) -> Located:
        """Locate fiducials in images (I, 3, H, W) from maps (I, width, h, w); float32."""
        logits, nowhere = self.heatmaps(features), self.nowhere(features.mean((-2, -1)))
        coarse, confidence = _centre(logits, nowhere)
        height, width = images.shape[-2:]
        edge = coarse.new_tensor((width, height)) - 1 - CROP // 2
        near = resized_pixels(coarse.detach(), _cell(images, logits)).round()
        near = near.clamp_min(CROP // 2).minimum(edge)
        offset, log_scale = self._fine(features, images, near)
        return Located(near + offset, log_scale, confidence, near, logits, nowhere)

    def _fine(self, features: Tensor, images: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets (I, N, 2) from the centres of crops, and the log scale of their errors (I, N)."""
        crops, place = _crops(images, near)  # (I, N, P, 3), (P, 2)
        cells = ((near + 0.5) / _cell(images, features)).long()
        index = (cells[..., 1] * features.shape[-1] + cells[..., 0]).clamp(0, features[0, 0].numel() - 1)
        there = features.flatten(2).mT.gather(1, index[..., None].expand(*index.shape, features.shape[1]))
        context = self.context(there) + self.identity
        seen = torch.cat((crops, (crops + DARK).log() / 4, place.expand(*crops.shape[:-1], 2) / CROP), dim=-1)
        weight = self.weigh(functional.gelu(self.look(seen) + context[..., None, :])).squeeze(-1).softmax(-1)
        correction = self.correct(torch.cat((crops.flatten(-2), functional.gelu(context)), dim=-1))
        return weight @ place + correction[..., :2], correction[..., 2].clamp(SHARPEST, BLUNTEST)


class PositionNetwork(nn.Module):
    """An encoder with a locator on its map: the part of an image network that position training trains."""

    def __init__(self, backbone: nn.Module, width: int, fiducials: int) -> None:
        """Put a locator on an encoder's map of `width` features."""
        super().__init__()
        self.backbone = backbone
        self.locator = Locator(width, fiducials)

    def forward(self, images: Tensor) -> Located:
        """Locate the fiducials in single images (I, 3, H, W); float32 after the encoder."""
        features = self.backbone(images)
        with torch.autocast(images.device.type, enabled=False):
            return self.locator(features.float(), images.float())

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates or freezing."""
        return {"encoder": self.backbone.parameters(), "heads": self.locator.parameters()}


def _cell(images: Tensor, features: Tensor) -> Tensor:
    """Pixels per cell of a map: (2,) width, height."""
    return images.new_tensor((images.shape[-1] / features.shape[-1], images.shape[-2] / features.shape[-2]))


def _centre(logits: Tensor, nowhere: Tensor) -> tuple[Tensor, Tensor]:
    """Centroids (I, N, 2), in cells, of heatmaps around their maxima, and the probability mass there (I, N)."""
    height, width = logits.shape[-2:]
    flat = logits.flatten(2)
    most = flat.detach().argmax(-1)
    row = (most // width - WINDOW // 2).clamp(0, height - WINDOW)
    column = (most % width - WINDOW // 2).clamp(0, width - WINDOW)
    step = torch.arange(WINDOW, device=logits.device)
    index = (row[..., None, None] + step[:, None]) * width + column[..., None, None] + step
    window = flat.gather(-1, index.flatten(-2)).unflatten(-1, (WINDOW, WINDOW))
    centre = spatial_expectation2d(spatial_softmax2d(window), normalized_coordinates=False)
    everything = torch.logaddexp(flat.logsumexp(-1), nowhere)
    return torch.stack((column, row), dim=-1) + centre, (window.flatten(-2).logsumexp(-1) - everything).exp()


def _crops(images: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels around integer places (I, N, 2): their colours (I, N, P, 3) and offsets (P, 2)."""
    step = torch.arange(CROP, device=images.device) - CROP // 2
    place = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).flatten(0, 1)
    pixels = near.long()[..., None, :] + place
    index = (pixels[..., 1] * images.shape[-1] + pixels[..., 0]).flatten(1)  # (I, N P)
    light = images.flatten(2).gather(-1, index[:, None].expand(-1, 3, -1))
    return light.mT.unflatten(1, (-1, CROP**2)), place.to(images)
