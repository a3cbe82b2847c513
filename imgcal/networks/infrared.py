"""The query network: it locates each fiducial in a monochrome crop, given its expected position in the factory rig.

Crops go through an encoder. A window around every fiducial's expected position is cut from the feature map, so that a
common displacement falls on the same cell for all fiducials. Set blocks then compare the windows of a camera, and a
head scores each cell for the fiducial. Rig and object enter only through positions, sizes and relative geometry, so one
network serves any rig and any object.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from imgcal.io import StrictModel
from imgcal.networks.infrared_encoders import ENCODERS, STRIDE, EncoderName
from imgcal.types import CROP_SIZE

GEOMETRY = 6
"""Numbers of relative geometry per fiducial: `Queries.geometry`."""


class InfraredConfig(StrictModel):
    """Architecture of the query network."""

    encoder: EncoderName = "cnn"  # CNN or ViT, in three sizes; vit-stem: a convolution before the tokens
    crop: Annotated[int, Field(ge=48, le=384, multiple_of=48)] = CROP_SIZE  # pixels, width and height; to train: 96
    channels: Annotated[int, Field(ge=1, le=128)] = 16  # of the feature map and of the windows
    window: Annotated[int, Field(ge=4, le=64, multiple_of=2)] = 22  # cells, width and height
    close_window: Annotated[int, Field(ge=4, le=64, multiple_of=2)] = 12  # the same for the second look
    blocks: Annotated[int, Field(ge=1, le=16)] = 3  # set blocks, which compare the windows of all fiducials
    keys: Annotated[int, Field(ge=1, le=32)] = 4  # weighted means over the fiducials, in addition to the plain one


@dataclass(frozen=True)
class Queries:
    """The fiducials to locate in P crops, at the positions that the factory rig and a pose predict."""

    place: Tensor  # (P, N, 2) crop pixels
    radius: Tensor  # (P, N) crop pixels, of the marker's image
    depth: Tensor  # (P, N) distance from the camera's plane over the mean of all fiducials, minus 1
    asked: Tensor  # (P, N) bool: expected in view

    def select(self, rows: Tensor) -> Queries:
        """Select some of the P crops by mask (P,) or indices."""
        return Queries(self.place[rows], self.radius[rows], self.depth[rows], self.asked[rows])

    def geometry(self, size: int) -> Tensor:
        """Relative geometry of the fiducials: (P, N, 6)."""
        asked = self.asked[..., None].to(self.place)
        centre = (self.place * asked).sum(1, keepdim=True) / asked.sum(1, keepdim=True).clamp(min=1)
        apart = (self.place - centre) * (4 / size)
        length = apart.square().sum(-1, keepdim=True)
        numbers = (apart, length, self.radius[..., None].clamp(min=0.05).log(), 5 * self.depth[..., None])
        return torch.cat((*numbers, torch.ones_like(length)), dim=-1) * asked


@dataclass(frozen=True)
class Evidence:
    """The network's output for every cell of every fiducial's window, and for each fiducial as a whole."""

    logits: Tensor  # (P, N, K, K) of the fiducial's cell
    offset: Tensor  # (P, N, K, K, 2) crop pixels, from the cell's centre to the marker's
    log_sigma: Tensor  # (P, N, K, K) log standard deviation of the offset per axis, crop pixels
    present: Tensor  # (P, N) logit that the fiducial is visible in its window
    cells: Tensor  # (P, N, K, K, 2) crop pixels, the cells' centres

    @classmethod
    def cat(cls, parts: Sequence[Evidence]) -> Evidence:
        """Concatenate along the crops."""
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))


class InfraredNetwork(nn.Module):
    """Compute evidence from crops and queries."""

    def __init__(self, config: InfraredConfig = InfraredConfig()) -> None:
        """Create an untrained network; weights come from torch's default generators (see `use_generators`)."""
        super().__init__()
        self.config = config
        width = config.channels
        self.encoder = ENCODERS[config.encoder](width, config.crop)
        self.blocks = nn.ModuleList(SetBlock(width, config.keys) for _ in range(config.blocks))
        self.head = nn.Sequential(nn.Conv2d(width, 2 * width, 3, padding=1), nn.GELU(), nn.Conv2d(2 * width, 4, 1))
        self.presence = nn.Sequential(nn.Linear(2 * width + 2, 2 * width), nn.GELU(), nn.Linear(2 * width, 1))

    def forward(self, crops: Tensor, queries: Queries, window: int | None = None) -> Evidence:
        """Locate each fiducial.

        Args:
            crops: (P, S, S) grey, normalized by `normalize_crops`.
            queries: (P, N) fiducials.
            window: cells per side; use `config.close_window` where the expected positions are more accurate than usual.
        """
        return self.search(self.encoder(crops[:, None]), queries, window)

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Evidence:
        """Locate each fiducial in feature maps (P, channels, S / 2, S / 2), which can be reused for other poses."""
        windows, cells = aligned_windows(features, queries.place, window or self.config.window)
        geometry = queries.geometry(self.config.crop).to(windows.dtype)
        for block in self.blocks:
            windows = block(windows, geometry, queries.asked)
        said = self.head(windows.flatten(0, 1)).float().unflatten(0, (-1, windows.shape[1]))
        logits = said[:, :, 0]
        weights = logits.flatten(2).softmax(-1).to(windows.dtype)
        attended = torch.einsum("pnk,pndk->pnd", weights, windows.flatten(3))
        highest, total = logits.flatten(2).amax(-1), logits.flatten(2).logsumexp(-1)
        level = total - math.log(logits.shape[-1] ** 2)  # independent of the size of a uniform window
        sharpness = torch.stack((highest - total, level), -1).to(windows.dtype)
        summary = torch.cat((attended, windows.flatten(3).mean(-1), sharpness), -1)
        present = self.presence(summary).float()[..., 0]
        offset = STRIDE * said[:, :, 1:3].movedim(2, -1)
        return Evidence(logits, offset, said[:, :, 3].clamp(-6, 4), present, cells)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        rest = [p for name, p in self.named_parameters() if not name.startswith("encoder.")]
        return {"encoder": self.encoder.parameters(), "decoder": rest}


class SetBlock(nn.Module):
    """Compare each window with those of the other fiducials at the same displacement."""

    def __init__(self, width: int, keys: int) -> None:
        """Create the layers for windows of `width` channels; `keys` means over fiducials are weighted by geometry."""
        super().__init__()
        self.spatial = nn.Conv2d(width, width, 3, padding=1)
        self.geometry = nn.Linear(GEOMETRY, width)
        self.key, self.query = nn.Linear(GEOMETRY, keys), nn.Linear(GEOMETRY, keys)
        self.mix = nn.Conv2d(3 * width, 2 * width, 1)
        self.out = nn.Conv2d(2 * width, width, 1)

    def forward(self, windows: Tensor, geometry: Tensor, asked: Tensor) -> Tensor:
        """Keep the shape (P, N, width, K, K).

        Args:
            windows: features around each fiducial's expected place.
            geometry: (P, N, 6).
            asked: (P, N) bool, the valid fiducials.
        """
        count = asked.shape[1]
        windows = windows.contiguous()
        seen = self.spatial(windows.flatten(0, 1)).unflatten(0, (-1, count))
        seen = functional.gelu(seen + self.geometry(geometry)[..., None, None])
        weight = asked.to(seen.dtype) / asked.sum(1, keepdim=True).clamp(min=1)
        rows = seen.flatten(2)
        mean = (weight[:, None] @ rows).view(-1, *seen.shape[2:])
        # For rotated or stretched constellations: features in proportion to the fiducials' positions, and back.
        keys, queries = self.key(geometry) * weight[..., None], self.query(geometry)
        related = ((queries @ keys.mT) @ rows).view_as(seen)
        # A convolution is linear, so the part that all fiducials share is convolved only once.
        own, shared, others = self.mix.weight.chunk(3, dim=1)
        mixed = functional.conv2d(seen.flatten(0, 1), own) + functional.conv2d(related.flatten(0, 1), others)
        common = functional.conv2d(mean, shared, self.mix.bias)
        mixed = mixed.unflatten(0, (-1, count)) + common[:, None]
        return windows + self.out(functional.gelu(mixed).flatten(0, 1)).unflatten(0, (-1, count))


def aligned_windows(features: Tensor, place: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Cut windows from feature maps, centred at places, at the map's resolution, bilinearly.

    Args:
        features: (P, D, G, G) maps of stride 2.
        place: (P, N, 2) crop pixels.
        window: cells per side, K.

    Returns:
        Windows (P, N, D, K, K), zero outside the map, and the cells' centres (P, N, K, K, 2) in crop pixels.
    """
    steps = STRIDE * (torch.arange(window, device=place.device, dtype=place.dtype) - (window - 1) / 2)
    shift = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)
    cells = place[:, :, None, None] + shift
    # Cell i of the map covers crop pixels 2 i and 2 i + 1; grid_sample maps the outer edges to -1 and 1.
    grid = (cells + 0.5) * (2 / (STRIDE * features.shape[-1])) - 1
    rows = grid.flatten(1, 2).to(features.dtype)  # one tall image per crop: (P, N K, K, 2)
    found = functional.grid_sample(features, rows, align_corners=False)
    return found.unflatten(2, (-1, window)).movedim(2, 1), cells


def normalize_crops(crops: Tensor) -> Tensor:
    """Normalize crops (P, S, S): subtract the median, divide by the noise, compress; NaN (no image) becomes 0.

    The noise is the median absolute difference of pixels two apart, which slow changes of the background hardly affect.
    """
    level = crops.flatten(1).nanmedian(1).values[:, None, None].nan_to_num()
    change = (crops[:, :, 2:] - crops[:, :, :-2]).abs().flatten(1).nanmedian(1).values[:, None, None].nan_to_num()
    largest = (crops - level).abs().nan_to_num().amax((1, 2), keepdim=True)
    noise = (change * 1.05).maximum(largest / 1000).clamp(min=1e-6)  # the median of |a - b| is 0.954 sigma
    relative = ((crops - level) / (2 * noise)).nan_to_num()
    # Inverse hyperbolic sine; torch's takes ten times as long on a CPU.
    size = relative.abs()
    return (size + (size.square() + 1).sqrt()).log().copysign(relative) / 2
