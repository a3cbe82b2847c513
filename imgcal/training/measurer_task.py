"""The task of measuring: patches in, the centres of their markers out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from imgcal.networks import (
    Measured,
    Measurer,
    MeasurerCheckpoint,
    MeasurerConfig,
    drawing_from,
    load_measurer,
    normalized,
)
from imgcal.synthesis import sample_patches
from imgcal.training.experiment import Experiment
from imgcal.training.task import Loss, Task

VALIDATION_SEED = 20_000_003


class MeasurerExperiment(Experiment):
    """A network that measures markers in patches."""

    task: Literal["measurer"] = "measurer"
    network: MeasurerConfig = MeasurerConfig()

    def make_task(self, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool) -> MeasurerTask:
        """Build the network and its source of patches; see `Experiment.make_task`."""
        return MeasurerTask(self, device, batch_size, weights, fresh)


@dataclass(frozen=True)
class PatchBatch:
    """Patches and what is in them: M."""

    patches: Tensor  # (M, 24, 24), normalized
    radius: Tensor  # (M,) patch pixels, expected
    offset: Tensor  # (M, 2) patch pixels, the truth
    seen: Tensor  # (M,) bool

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return dict(vars(self))


class MeasurerTask(Task[PatchBatch, Measured]):
    """Random markers: whole, half hidden, smeared, merged, half lit, in any noise."""

    unit = "patches"
    judged = "validation_error_px"
    headline: ClassVar = {"error_px": "error {:.3g} px", "validation_error_px": "validation error {:.3g} px"}
    network: Measurer

    def __init__(
        self,
        experiment: MeasurerExperiment,
        device: torch.device,
        batch_size: int,
        weights: torch.Generator,
        fresh: bool,
    ) -> None:
        """Build it; see `Experiment.make_task`."""
        start = experiment.training.init_from
        with drawing_from(weights):
            network = Measurer(experiment.network)
        for path in [start] if isinstance(start, str) else start or []:
            if fresh:
                network.load_state_dict(load_measurer(path).network.state_dict())
        self.network = network.to(device)
        self.device = device
        count = experiment.training.validation_rigs
        self.sizes = [min(batch_size, count - first) for first in range(0, count, batch_size)]

    def batch(self, count: int, generator: torch.Generator) -> PatchBatch:
        """Make random patches."""
        made = sample_patches(count, generator)
        return PatchBatch(normalized(made.images), made.radius, made.offset, made.seen)

    def predict(self, network: nn.Module, batch: PatchBatch) -> Measured:
        """Measure."""
        return network(batch.patches, batch.radius)

    def loss(self, answer: Measured, batch: PatchBatch, step: int) -> Loss:
        """Error of the centres, their likelihood under the predicted sigma, and whether there is a marker."""
        seen = batch.seen.to(answer.offset.dtype)
        count = seen.sum().clamp(min=1)
        error = answer.offset - batch.offset
        # A square near zero, where most of the information is, and no pull of hopeless patches.
        off = (
            functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.2, reduction="none").mean(-1) * seen
        ).sum()
        squared = error.detach().square().mean(-1)
        likelihood = (squared / 2 * (-2 * answer.log_sigma).exp() + answer.log_sigma) * seen
        verdict = functional.binary_cross_entropy_with_logits(answer.valid, seen)
        total = (off + 0.2 * likelihood.sum()) / count + 0.3 * verdict
        rms = ((squared * seen).sum() / count).sqrt()
        return Loss(total, {"error_px": rms.detach(), "verdict": verdict.detach()})

    def validate(self, predict: Callable[[PatchBatch], Measured]) -> dict[str, float]:
        """Mean absolute error of an axis, NEES, and wrong verdicts, on patches that are always the same."""
        if not self.sizes:
            return {}
        generator = torch.Generator(self.device).manual_seed(VALIDATION_SEED)
        batches = [self.batch(size, generator) for size in self.sizes]
        answers = [predict(batch) for batch in batches]
        error = torch.cat([answer.offset - batch.offset for answer, batch in zip(answers, batches, strict=True)])
        sigma = torch.cat([answer.log_sigma for answer in answers]).exp()
        valid, seen = (torch.cat(parts) for parts in ([a.valid for a in answers], [b.seen for b in batches]))
        return {
            "validation_error_px": float(error[seen].abs().mean()),
            "validation_median_px": float(error[seen].norm(dim=-1).median()),
            "validation_nees": float((error.square().mean(-1) / sigma.square())[seen].mean()),
            "validation_wrong_verdicts": float(((valid > 0) != seen).double().mean()),
        }

    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> MeasurerCheckpoint:
        """Weights and configuration."""
        assert isinstance(network, Measurer)  # `self.network`, or the mean of what it was
        return MeasurerCheckpoint(network, metrics)
