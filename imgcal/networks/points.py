"""Point variants: from labelled fiducial positions to a rig. The paper's network and ours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

from imgcal.networks.config import PaperPoints, Points
from imgcal.networks.layers import conv1d, mlp, transformer
from imgcal.networks.network import Network
from imgcal.networks.parameterization import Parameterization
from imgcal.networks.refiner import IterativeRefiner
from imgcal.types import Prediction, Views

CIE_NOISE = 0.01  # standard deviation of the noise on the one-hot camera identities


class CameraIdentity(nn.Module):
    """The paper's Camera Identity Encoding: one-hot over the embedding, plus fixed noise, so that more cameras than
    dimensions stay distinct.

    Source: paper, supplementary section 1.1.
    """

    encoding: Tensor  # (C, width)

    def __init__(self, cameras: int, width: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        one_hot = torch.eye(width)[torch.arange(cameras) % width]
        noise = CIE_NOISE * torch.randn(cameras, width, generator=generator)
        self.register_buffer("encoding", one_hot + noise, persistent=False)

    def forward(self, tokens: Tensor) -> Tensor:
        """Add the identities: (B, C, width) -> (B, C, width)."""
        return tokens + self.encoding


class PaperHeads(nn.Module):
    """Separate heads for r6D, t, f, pp and dist; each may have its own learning rate."""

    def __init__(self, features: int, widths: tuple[int, ...], outputs: Mapping[str, int]) -> None:
        super().__init__()
        self.names = tuple(outputs)
        self.heads = nn.ModuleList(mlp((features, *widths, count)) for count in outputs.values())

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, features) -> (B, C, 13 + D), in float32 even under autocast."""
        with torch.autocast(features.device.type, enabled=False):
            features = features.float()
            return torch.cat([head(features) for head in self.heads], dim=-1)

    def groups(self) -> dict[str, Iterable[nn.Parameter]]:
        """Parameters of each head by its name."""
        return {name: head.parameters() for name, head in zip(self.names, self.heads, strict=True)}


class PaperPointNetwork(Network):
    """The paper's point variant: linear embedding of a camera's fiducials, CIE, encoder, five heads.

    Source: paper, supplementary section 1.1.
    """

    def __init__(self, config: PaperPoints, parameterization: Parameterization) -> None:
        super().__init__(parameterization)
        cameras, fiducials = len(parameterization.focal_length), len(parameterization.centred)
        self.embed = nn.Linear(2 * fiducials, config.width)
        self.identity = CameraIdentity(cameras, config.width) if config.camera_identity else nn.Identity()
        self.layers = (
            transformer(config.width, config.depth, config.heads)
            if config.encoder == "transformer"
            else conv1d(config.width, config.depth)
        )
        self.heads = PaperHeads(config.width, config.head_widths, parameterization.widths)

    @property
    def encoder(self) -> nn.Module:
        """The layers that relate the cameras to one another."""
        return self.layers

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.uv`; missing fiducials are placed at the principal point."""
        uv, seen = stack_points(views)
        with torch.autocast(uv.device.type, enabled=False):
            positions = torch.where(seen[..., None], self.parameterization.normalize(uv.float()), 0.0).flatten(-2)
            embedded = self.embed(positions)  # bf16 would round positions to a pixel
        numbers = self.heads(self.layers(self.identity(embedded)))
        with torch.autocast(uv.device.type, enabled=False):
            return (self.parameterization.absolute(numbers),)

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        return {"encoder": [*self.embed.parameters(), *self.layers.parameters()]} | self.heads.groups()


class PointNetwork(Network):
    """Our point variant: `IterativeRefiner` on the positions; missing fiducials are masked."""

    def __init__(self, config: Points, parameterization: Parameterization) -> None:
        super().__init__(parameterization)
        self.trunk = IterativeRefiner(parameterization, **config.trunk.model_dump())

    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict the rig from `views.uv` and `views.seen`; one prediction per pass."""
        uv, seen = stack_points(views)
        return self.trunk(torch.where(seen[..., None], uv, 0.0), seen.to(uv.dtype))

    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""
        return {"trunk": self.trunk.parameters()}


def stack_points(views: Views) -> tuple[Tensor, Tensor]:
    """Return positions (B, C, N, 2) and a visibility mask (B, C, N).

    Raises:
        ValueError: the views have only images.
    """
    if views.uv is None:
        raise ValueError("a point variant needs views.uv, found images only")
    seen = torch.ones_like(views.uv[..., 0], dtype=torch.bool) if views.seen is None else views.seen
    return views.uv, seen
