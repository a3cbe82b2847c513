"""The task of positions: from one colour-coded image to fiducial positions. Encoders are trained on this first.

Dots lie anywhere. The images depend on no rig and no object, so the result serves all objects with the same number of
colours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import ConfigDict, Field
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.formats import load_rig
from imgcal.io import load_object, object_text, rig_text
from imgcal.networks import (
    Checkpoint,
    ImageNetwork,
    Located,
    NetworkSpec,
    PositionNetwork,
    build_network,
    drop_pretrained,
    warm_start,
)
from imgcal.training.data import Levels, draw_levels, object_to
from imgcal.training.experiment import Experiment
from imgcal.training.random_streams import FIXED, make_stream
from imgcal.training.task import Loss, Task
from imgcal.types import Views

CENTRES = 0.09  # of the width of an image: standard deviation of the centre of its dots
SPREADS = ((0.04, 0.15), (0.05, 0.2))  # of it, along u and v: smallest and largest standard deviation of the dots
PAIRED, APART = 0.25, 0.012  # share of dots next to another one; their distance in widths of the image, each axis
FINE = 0.3  # weight of the precise positions relative to the rough ones
NEAR = 4.5  # pixels, each axis: half the side of the crop for the precise position
FOUND = 1.0  # pixels: a fiducial with a larger error is lost


class PositionsExperiment(Experiment, NetworkSpec):
    """Encoder and locator of an image variant: the blocks of `NetworkSpec`, and the difficulty of the images."""

    model_config = ConfigDict(extra="forbid")

    task: Literal["positions"]
    rig: str  # shipped name or path: rig of the network in the file; does not affect the images
    object: str  # shipped name or path: only the number of its fiducials and their colours matter
    levels: Annotated[Levels, Field(min_length=1)] = Field(default=[0, 1, 2, 3, 4])  # difficulties, in equal shares

    def make_task(self, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool) -> PositionsTask:
        """Build the network; see `Experiment.make_task`."""
        return PositionsTask(self, device, batch_size, weights, fresh)


@dataclass(frozen=True)
class PositionBatch:
    """Single images, and the positions of their dots."""

    images: Tensor  # (I, 3, H, W)
    uv: Tensor  # (I, N, 2) pixels of the image; any finite value where there is no dot
    seen: Tensor  # (I, N) bool

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for saving."""
        return vars(self)


class PositionsTask(Task[PositionBatch, Located]):
    """Random dots, and the two losses of a locator."""

    unit = "images"
    judged = "validation_lost"
    headline: ClassVar = {"coarse": "cross-entropy {:.3g}", "validation_lost": "lost {:.2%}"}
    network: PositionNetwork

    def __init__(
        self,
        experiment: PositionsExperiment,
        device: torch.device,
        batch_size: int,
        weights: torch.Generator,
        fresh: bool,
    ) -> None:
        """Build the task; see `Experiment.make_task`."""
        self.experiment, self.batch_size = experiment, batch_size
        self.rig, obj = load_rig(experiment.rig), load_object(experiment.object)
        self.files = {"rig": rig_text(self.rig, experiment.rig), "object": object_text(obj, experiment.object)}
        spec, starts = experiment if fresh else drop_pretrained(experiment), experiment.training.starts
        whole = build_network(spec, self.rig, obj, weights)
        if not isinstance(whole, ImageNetwork):
            raise InputError(f"task positions: found the network {spec.network.preset}, expected vit or cnn")
        self.untrained = warm_start(starts, whole) if fresh and starts else ()
        self.whole, self.network = whole, whole.positions.to(device)
        self.obj, self.true_obj = object_to(obj, device), obj
        assert whole.image_options is not None
        self.options, self.device = whole.image_options, device
        self.image_size = torch.full((1, 2), self.options.size, device=device)

    def batch(self, count: int, generator: torch.Generator) -> PositionBatch:
        """Draw dots at random positions."""
        return self._draw(count, self.experiment.levels, generator)

    def predict(self, network: nn.Module, batch: PositionBatch) -> Located:
        """Locate the dots."""
        return network(batch.images)

    def loss(self, answer: Located, batch: PositionBatch, step: int) -> Loss:
        """Cross-entropy of the cells, and Laplace likelihood of the precise positions within their crops."""
        coarse, fine = coarse_loss(answer, batch), fine_loss(answer, batch)
        return Loss(coarse + FINE * fine, {"coarse": coarse.detach(), "fine": fine.detach()})

    def validate(self, predict: Callable[[PositionBatch], Located]) -> dict[str, float]:
        """By level and for all: median error (px of the image), and the share of lost dots."""
        count = -(-self.experiment.training.validation_rigs // len(self.experiment.levels))
        if not count:
            return {}
        medians, lost = {}, {}
        for level in self.experiment.levels:
            generator = make_stream("validation", FIXED, device=self.device)
            batch = self._draw(count, (level,), generator)
            parts = (tensor.split(self.batch_size) for tensor in (batch.images, batch.uv, batch.seen))
            found = torch.cat([predict(PositionBatch(*part)).uv for part in zip(*parts, strict=True)])
            error = (found - batch.uv).norm(dim=-1)[batch.seen]
            medians[f"validation_level{level}_px"] = float(error.median())
            lost[f"validation_level{level}_lost"] = float((~(error <= FOUND)).float().mean())
        means = {"validation_px": sum(medians.values()), "validation_lost": sum(lost.values())}
        return medians | lost | {name: value / len(lost) for name, value in means.items()}

    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> Checkpoint:
        """Return the whole image network with an untrained trunk: `training.init_from` of others uses what it needs."""
        whole = build_network(
            drop_pretrained(self.experiment), self.rig, self.true_obj, torch.Generator().manual_seed(0)
        )
        assert isinstance(whole, ImageNetwork)
        whole.positions.load_state_dict(network.state_dict())
        return Checkpoint(whole, self.rig, self.true_obj, self.experiment, metrics)

    def _draw(self, count: int, levels: Sequence[int], generator: torch.Generator) -> PositionBatch:
        cloud = random_dots(count, self.obj.num_fiducials, self.options.size, generator)
        images, drawn = draw_levels(cloud, self.image_size, self.obj, self.options, levels, generator)
        assert drawn.uv is not None and drawn.seen is not None
        return PositionBatch(images[:, 0], drawn.uv[:, 0], drawn.seen[:, 0])


def random_dots(count: int, fiducials: int, size: int, generator: torch.Generator) -> Views:
    """Scatter dots over images of `size` pixels: (count, 1, fiducials, 2); those outside are not seen.

    Some lie next to others, like dots on two faces of an object in a view from above.
    """
    device = generator.device
    centre = torch.randn(count, 1, 1, 2, generator=generator, device=device)
    share = torch.rand(count, 1, 1, 2, generator=generator, device=device)
    dots = torch.randn(count, 1, fiducials, 2, generator=generator, device=device)
    least, most = torch.tensor(SPREADS, device=device).unbind(-1)
    uv = size * (0.5 + CENTRES * centre + (least + (most - least) * share) * dots) - 0.5
    paired = torch.rand(count, 1, fiducials, 1, generator=generator, device=device) < PAIRED
    beside = uv.roll(1, -2) + APART * size * torch.randn(uv.shape, generator=generator, device=device)
    uv = torch.where(paired, beside, uv)
    seen = ((uv > 0) & (uv < size - 1)).all(-1)
    return Views(torch.where(seen[..., None], uv, 0.0), seen)


def coarse_loss(found: Located, batch: PositionBatch) -> Tensor:
    """Cross-entropy of each fiducial's cells and of absence; a dot between cells belongs to the four around it.

    The shares are bilinear, so that the centre of mass is the dot.
    """
    height, width = found.logits.shape[-2:]
    cells, pixels = batch.uv.new_tensor((width, height)), batch.uv.new_tensor(batch.images.shape[:-3:-1])
    place = ((batch.uv + 0.5) * cells / pixels - 0.5).clamp_min(0).minimum(cells - 1)
    first = place.floor().minimum(cells - 2)
    share = torch.stack((1 - (place - first), place - first), dim=-1)  # (I, N, axis, lower or upper)
    corner = (first[..., 1] * width + first[..., 0]).long()[..., None, None]
    step = torch.arange(2, device=corner.device)
    index = (corner + step[:, None] * width + step).flatten(-2)  # (I, N, 4), row by row
    weight = (share[..., 1, :, None] * share[..., 0, None, :]).flatten(-2)
    flat = found.logits.flatten(2)
    target = torch.where(batch.seen, (flat.gather(-1, index) * weight).sum(-1), found.nowhere)
    return (torch.logaddexp(flat.logsumexp(-1), found.nowhere) - target).mean()


def fine_loss(found: Located, batch: PositionBatch) -> Tensor:
    """Mean negative Laplace log likelihood of precise positions, for dots within their crops."""
    near = batch.seen & ((batch.uv - found.near).abs() <= NEAR).all(-1)
    error = torch.where(near[..., None], found.uv - batch.uv, 0.0).abs().sum(-1)
    each = error * (-found.log_scale).exp() + 2 * found.log_scale
    return torch.where(near, each, 0.0).sum() / near.sum().clamp_min(1)
