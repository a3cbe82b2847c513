"""The task of measuring: from patches to the centres of their markers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from imgcal.networks import (
    Measured,
    Measurer,
    MeasurerCheckpoint,
    MeasurerConfig,
    normalize_crops,
    use_generators,
    warm_start,
)
from imgcal.synthesis import Patches, expose_patches, host_generator, render_patches
from imgcal.training.experiment import Experiment, Fraction
from imgcal.training.frame_dataset import load_patches
from imgcal.training.random_streams import FIXED, make_stream
from imgcal.training.task import Loss, Task
from imgcal.types import BlobKind


class MeasurerExperiment(Experiment):
    """A network that measures markers in patches."""

    task: Literal["measurer"] = "measurer"  # what the network is trained for
    network: MeasurerConfig = MeasurerConfig()  # family and size
    pool: Annotated[int, Field(ge=1, le=10**7)] = 16_000  # patches rendered at the start; turned, lit and noised anew
    frames: Annotated[str, Field(min_length=1)] | None = None  # folder that `imgcal harvest` wrote: markers of your own
    frames_share: Fraction = 0.5  # share of the batches that are of these; the others are rendered

    def make_task(self, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool) -> MeasurerTask:
        """Build the network and its source of patches; see `Experiment.make_task`."""
        return MeasurerTask(self, device, batch_size, weights, fresh)


@dataclass(frozen=True)
class PatchBatch:
    """Patches and their ground truth: M."""

    patches: Tensor  # (M, 24, 24), normalized
    radius: Tensor  # (M,) patch pixels, expected
    offset: Tensor  # (M, 2) patch pixels, the truth
    kind: Tensor  # (M,) BlobKind

    @property
    def seen(self) -> Tensor:
        """Whether the patch has a marker: (M,) bool."""
        return self.kind != BlobKind.FALSE

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return dict(vars(self))


class MeasurerTask(Task[PatchBatch, Measured]):
    """Random markers: whole, half hidden, motion-blurred, merged, half lit, with any noise."""

    unit = "patches"
    judged = "validation_error_px"
    headline: ClassVar = {"error_px": "error {:.3g} px", "validation_error_px": "validation error {:.3g} px"}
    network: Measurer
    own: Patches | None = None  # of real frames, to learn from

    def __init__(
        self,
        experiment: MeasurerExperiment,
        device: torch.device,
        batch_size: int,
        weights: torch.Generator,
        fresh: bool,
    ) -> None:
        """Build the task; see `Experiment.make_task`."""
        with use_generators(weights):
            network = Measurer(experiment.network)
        starts = experiment.training.starts
        self.untrained = warm_start(starts, network) if fresh and starts else ()
        self.network = network.to(device)
        self.device = device
        self.sizes = experiment.training.validation_sizes(batch_size)
        self.pool = _pool(experiment.pool, "pool", device)
        self.share = experiment.frames_share
        if experiment.frames is None:
            self.held_out = _pool(max(sum(self.sizes), 1), "validation patches", device)
            return
        own, held_out = load_patches(experiment.frames)
        draw = make_stream("validation rows", FIXED)
        rows = torch.randint(len(held_out), (max(sum(self.sizes), 1),), generator=draw)
        self.own, self.held_out = (_to(part, device) for part in (own.as_patches(), held_out.select(rows).as_patches()))

    def batch(self, count: int, generator: torch.Generator) -> PatchBatch:
        """Take patches of the pool, or of real frames, and give them light and noise."""
        host, pool = host_generator(generator), self.pool
        if self.own is not None and float(torch.rand((), generator=host)) < self.share:
            pool = self.own
        rows = torch.randint(len(pool.kind), (count,), generator=generator, device=self.device)
        return _expose(pool.select(rows), generator)

    def predict(self, network: nn.Module, batch: PatchBatch) -> Measured:
        """Measure the markers."""
        return network(batch.patches, batch.radius)

    def loss(self, answer: Measured, batch: PatchBatch, step: int) -> Loss:
        """Error of the centres, their likelihood under the predicted sigma, and classification of the blobs."""
        seen = batch.seen.to(answer.offset.dtype)
        count = seen.sum().clamp(min=1)
        error = answer.offset - batch.offset
        # Quadratic near zero, where most of the information is; linear beyond, to limit hopeless patches.
        off = (
            functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.2, reduction="none").mean(-1) * seen
        ).sum()
        squared = error.detach().square().mean(-1)
        likelihood = (squared / 2 * (-2 * answer.log_sigma).exp() + answer.log_sigma) * seen
        verdict = functional.cross_entropy(answer.kind, batch.kind)
        total = (off + 0.2 * likelihood.sum()) / count + 0.3 * verdict
        rms = ((squared * seen).sum() / count).sqrt()
        return Loss(total, {"error_px": rms.detach(), "verdict": verdict.detach()})

    def validate(self, predict: Callable[[PatchBatch], Measured]) -> dict[str, float]:
        """Mean absolute error per axis and NEES of single markers, and wrong classifications, on fixed patches."""
        if not self.sizes:
            return {}
        generator = make_stream("validation light", FIXED, device=self.device)
        rows = torch.arange(sum(self.sizes), device=self.device).split(self.sizes)
        batches = [_expose(self.held_out.select(some), generator) for some in rows]
        answers = [predict(batch) for batch in batches]
        error = torch.cat([answer.offset - batch.offset for answer, batch in zip(answers, batches, strict=True)])
        sigma = torch.cat([answer.log_sigma for answer in answers]).exp()
        said, kind = torch.cat([a.kind for a in answers]).argmax(-1), torch.cat([b.kind for b in batches])
        seen = (kind == BlobKind.WHOLE) | (kind == BlobKind.PARTIAL)
        return {
            "validation_error_px": float(error[seen].abs().mean()),
            "validation_median_px": float(error[seen].norm(dim=-1).median()),
            "validation_nees": float((error.square().mean(-1) / sigma.square())[seen].mean()),
            "validation_wrong_verdicts": float((said != kind).double().mean()),
        }

    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> MeasurerCheckpoint:
        """Return weights and configuration."""
        assert isinstance(network, Measurer)  # `self.network`, or its running mean
        return MeasurerCheckpoint(network, metrics)


@lru_cache(maxsize=4)
def _pool(count: int, purpose: str, device: torch.device) -> Patches:
    """Render a fixed set of patches, once for all trainings of a process."""
    with torch.no_grad():
        return render_patches(count, make_stream(purpose, FIXED, device=device))


def _to(patches: Patches, device: torch.device) -> Patches:
    return Patches(*(getattr(patches, field.name).to(device) for field in fields(Patches)))


def _expose(patches: Patches, generator: torch.Generator) -> PatchBatch:
    grey, radius, offset = expose_patches(patches, generator)
    return PatchBatch(normalize_crops(grey), radius, offset, patches.kind)
