"""The measurer: the centre of a marker in a small patch at full scale, its accuracy, and whether it is a marker.

It learns effects that a fitted ellipse cannot model: a half-hidden or half-dark sphere, motion blur, or two merged
markers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from imgcal.io import StrictModel
from imgcal.networks.infrared_encoders import STRIDE, CropCnn, CropVit
from imgcal.types import PATCH_SIZE, BlobKind

RADIUS = 3.5  # patch pixels to which larger markers are downsampled; smaller ones keep their scale

CNN_WIDTHS, VIT_WIDTH_AND_DEPTH = (8, 18, 54), (48, 2)  # equal numbers of weights and operations


class MeasurerConfig(StrictModel):
    """Architecture of the measurer."""

    encoder: Literal["cnn", "vit"] = "cnn"  # family of the encoder
    channels: Annotated[int, Field(ge=1, le=128)] = 24  # of the feature map


@dataclass(frozen=True)
class Measured:
    """Measurements of M patches."""

    offset: Tensor  # (M, 2) patch pixels, from the centre of the patch to the marker's centre
    log_sigma: Tensor  # (M,) log standard deviation of the offset per axis, patch pixels
    kind: Tensor  # (M, 4) logits of BlobKind

    @property
    def valid(self) -> Tensor:
        """Logit that the marker is visible: (M,)."""
        return self.kind[:, : BlobKind.FALSE].logsumexp(-1) - self.kind[:, BlobKind.FALSE]


class Measurer(nn.Module):
    """Measure marker centres in patches."""

    def __init__(self, config: MeasurerConfig = MeasurerConfig()) -> None:
        """Create an untrained network; weights come from torch's default generators (see `use_generators`)."""
        super().__init__()
        self.config = config
        channels = config.channels
        self.encoder: nn.Module = (
            CropCnn(channels, CNN_WIDTHS)
            if config.encoder == "cnn"
            else CropVit(channels, PATCH_SIZE, *VIT_WIDTH_AND_DEPTH)
        )
        self.size = nn.Linear(2, channels)
        self.head = nn.Sequential(
            nn.GELU(), nn.Conv2d(channels, channels, 3, padding=1), nn.GELU(), nn.Conv2d(channels, 4, 1)
        )
        self.verdict = nn.Sequential(
            nn.Linear(2 * channels + 1, 2 * channels), nn.GELU(), nn.Linear(2 * channels, 1 + len(BlobKind))
        )

    def forward(self, patches: Tensor, radius: Tensor) -> Measured:
        """Measure one marker per patch, the one near its centre.

        Args:
            patches: (M, 24, 24) grey, normalized by `normalized`.
            radius: (M,) patch pixels, expected.
        """
        known = torch.stack((radius, radius.clamp(min=0.1).log()), -1)
        features = self.encoder(patches[:, None]) + self.size(known)[..., None, None]
        said = self.head(features).float()
        weight = said[:, 0].flatten(1).softmax(-1)
        steps = STRIDE * (torch.arange(said.shape[-1], device=said.device) - (said.shape[-1] - 1) / 2)
        cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"))
        votes = (cells + said[:, 1:3]).flatten(2)
        offset = (votes * weight[:, None]).sum(-1)
        # Disagreement between cells is the best sign of an inaccurate centre.
        spread = ((votes - offset[..., None]).square().mean(1) * weight).sum(-1, keepdim=True).clamp(min=1e-4).log()
        attended = (features.float().flatten(2) * weight[:, None]).sum(-1)
        # The kind of a blob also shows around its centre.
        around = functional.gelu(features.float()).mean((2, 3))
        verdict = self.verdict(torch.cat((attended, around, spread), -1)).float()
        return Measured(offset, verdict[:, 0].clamp(-5, 3), verdict[:, 1:])

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        rest = [p for name, p in self.named_parameters() if not name.startswith("encoder.")]
        return {"encoder": self.encoder.parameters(), "decoder": rest}
