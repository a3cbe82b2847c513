"""The task of infrared crops: from crops to fiducial positions, for any rig and any object."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.networks import (
    Evidence,
    InfraredCheckpoint,
    InfraredConfig,
    InfraredNetwork,
    Queries,
    normalize_crops,
    use_generators,
    warm_start,
)
from imgcal.synthesis import degrade_crops, host_generator, render_crops, sample_scenes, second_look
from imgcal.training.experiment import Experiment, Fraction
from imgcal.training.frame_dataset import FrameDataset, expect_elsewhere, load_splits, thin, turn
from imgcal.training.infrared import evidence_at_best, make_queries, query_losses
from imgcal.training.random_streams import FIXED, make_stream
from imgcal.training.task import Loss, Task
from imgcal.types import CROP_SIZE

SECOND_LOOKS = 0.5  # share of the batches that simulate a second look, after a rig was fitted to a first one
CAMERAS = 2  # crops per rig: more rigs and objects instead of more cameras
FIDUCIALS = (5, 12)  # of the objects
FIDUCIALS_AT_ONCE = 16  # that are asked for in a crop of a real frame
NEAR = 2.0  # crop pixels within which a place is right


class InfraredExperiment(Experiment):
    """A network that finds fiducials in monochrome crops, for any rig and object, so the file names neither."""

    task: Literal["infrared"] = "infrared"
    network: InfraredConfig = InfraredConfig()
    frames: Annotated[str, Field(min_length=1)] | None = None  # folder from `imgcal harvest`: your own frames
    frames_share: Fraction = 0.5  # share of the batches from these frames, made harder; the others are rendered

    @model_validator(mode="after")
    def _check_crop(self) -> InfraredExperiment:
        if self.network.crop != CROP_SIZE:
            raise ValueError(
                f"found network.crop {self.network.crop}, expected {CROP_SIZE}, the size of rendered crops"
            )
        return self

    def make_task(self, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool) -> InfraredTask:
        """Build the network and its source of crops; see `Experiment.make_task`."""
        return InfraredTask(self, device, batch_size, weights, fresh)


@dataclass(frozen=True)
class CropBatch:
    """Crops, queries and the truth: P = rigs times cameras, N fiducials."""

    crops: Tensor  # (P, S, S), normalized
    queries: Queries  # (P, N)
    place: Tensor  # (P, N, 2) crop pixels
    seen: Tensor  # (P, N) bool
    window: int | None = None  # cells; None = the network's own

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        asked = {f"queries.{field.name}": getattr(self.queries, field.name) for field in fields(Queries)}
        return {"crops": self.crops, "place": self.place, "seen": self.seen, **asked}


class InfraredTask(Task[CropBatch, Evidence]):
    """Random rigs and random objects, in crops with the defects of real cameras."""

    unit = "crops"
    judged = "validation_missed"
    headline: ClassVar = {
        "right": "{:.1%} right",
        "wrong": "{:.1%} wrong",
        "validation_missed": "validation missed {:.3f}",
    }
    network: InfraredNetwork
    own: FrameDataset | None = None  # crops of real frames for training
    held_out: FrameDataset | None = None  # crops of other snapshots, for validation

    def __init__(
        self,
        experiment: InfraredExperiment,
        device: torch.device,
        batch_size: int,
        weights: torch.Generator,
        fresh: bool,
    ) -> None:
        """Build the task; see `Experiment.make_task`.

        Raises:
            InputError: a batch or a validation that is no whole number of rigs, or initial weights that cannot be used.
        """
        counts = {"batch_size": batch_size, "validation_rigs": experiment.training.validation_rigs}
        if wrong := [name for name, count in counts.items() if count % CAMERAS]:
            found = f"{counts[wrong[0]]} crops{' at once' if wrong[0] == 'batch_size' else ''}"
            raise InputError(
                f"training: {wrong[0]}: found {found}, expected a multiple of the {CAMERAS} cameras of a rig"
            )
        with use_generators(weights):
            network = InfraredNetwork(experiment.network)
        starts = experiment.training.starts
        self.untrained = warm_start(starts, network) if fresh and starts else ()
        self.network = network.to(device)
        self.device = device
        self.sizes = experiment.training.validation_sizes(batch_size)
        self.share = experiment.frames_share
        if experiment.frames is not None:
            self.own, self.held_out = (part.to(device) for part in load_splits(experiment.frames))
            self._check_size(experiment.frames)

    def _check_size(self, folder: str) -> None:
        """Raise `InputError` if the crops of a dataset do not have the network's size."""
        assert self.own is not None
        found, expected = self.own.crops.shape[-1], self.network.config.crop
        if found != expected:
            raise InputError(f"{folder}: found crops of {found} pixels, expected {expected} for this network")

    def batch(self, count: int, generator: torch.Generator) -> CropBatch:
        """Make crops of random rigs and objects; all objects of a batch have the same number of fiducials."""
        low, high = FIDUCIALS
        host = host_generator(generator)
        if self.own is not None and float(torch.rand((), generator=host)) < self.share:
            rows = torch.randint(len(self.own), (count,), generator=generator, device=self.device)
            return self._batch_of_frames(self.own.select(rows), generator)
        fiducials = int(torch.randint(low, high + 1, (), generator=host))
        second = float(torch.rand((), generator=host)) < SECOND_LOOKS
        truth = render_crops(sample_scenes(max(count // CAMERAS, 1), CAMERAS, fiducials, generator), generator)
        truth = second_look(truth, generator) if second else truth
        crops, place, seen = (part.flatten(0, 1) for part in (truth.crops, truth.place, truth.seen))
        window = self.network.config.close_window if second else None
        return CropBatch(normalize_crops(crops), make_queries(truth), place, seen, window)

    def _batch_of_frames(self, crops: FrameDataset, generator: torch.Generator) -> CropBatch:
        """Make crops of real frames harder, and ask for their fiducials from elsewhere."""
        crops = thin(turn(crops, generator), FIDUCIALS_AT_ONCE, generator)
        light, seen = degrade_crops(crops.crops.float(), crops.place, crops.radius, crops.seen, generator)
        second = float(torch.rand((), generator=host_generator(generator))) < SECOND_LOOKS
        window = self.network.config.close_window if second else None
        queries = expect_elsewhere(crops, generator, near=second)
        return CropBatch(normalize_crops(light), queries, crops.place, seen, window)

    def predict(self, network: nn.Module, batch: CropBatch) -> Evidence:
        """Locate the fiducials."""
        return network(batch.crops, batch.queries, batch.window)

    def loss(self, answer: Evidence, batch: CropBatch, step: int) -> Loss:
        """Compare the evidence with the truth."""
        parts = query_losses(answer, batch.queries.asked, batch.place, batch.seen)
        right, wrong, _ = _shares(_counts(answer, batch))
        means = {
            "cell": parts.cell,
            "offset_px": parts.offset,
            "presence": parts.presence,
            "right": right,
            "wrong": wrong,
        }
        return Loss(parts.total, {name: value.detach() for name, value in means.items()})

    def validate(self, predict: Callable[[CropBatch], Evidence]) -> dict[str, float]:
        """Correct share of the visible, wrong share of the claimed, and the offsets' NEES, on fixed crops."""
        if not self.sizes:
            return {}
        generator = make_stream("validation", FIXED, device=self.device)
        counts = torch.stack([_counts(predict(batch), batch) for batch in self._validation(generator)]).sum(0)
        right, wrong, nees = torch.stack(_shares(counts)).tolist()
        return {
            "validation_missed": 1 - right + wrong,
            "validation_right": right,
            "validation_wrong": wrong,
            "validation_nees": nees,
        }

    def _validation(self, generator: torch.Generator) -> Iterator[CropBatch]:
        """Make validation crops: from held-out frames, made harder, if there are any; otherwise rendered ones."""
        for size in self.sizes:
            if self.held_out is None:
                yield self.batch(size, generator)
            else:
                rows = torch.randint(len(self.held_out), (size,), generator=generator, device=self.device)
                yield self._batch_of_frames(self.held_out.select(rows), generator)

    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> InfraredCheckpoint:
        """Return weights and configuration."""
        assert isinstance(network, InfraredNetwork)  # `self.network`, or its running mean
        return InfraredCheckpoint(network, metrics)


def _counts(answer: Evidence, batch: CropBatch) -> Tensor:
    """Count correct, visible, wrongly claimed and claimed fiducials, and sum the NEES of the correct ones: (5,).

    These are sums, so that those of several batches can be added.
    """
    place, sigma, probability = evidence_at_best(answer)
    squared = (place - batch.place).square().sum(-1)
    visible, claimed = batch.queries.asked & batch.seen, batch.queries.asked & (probability > 0.5)
    right = claimed & visible & (squared < NEAR**2)
    nees = torch.where(right, squared / sigma.square(), 0.0)
    return torch.stack([part.sum().to(nees.dtype) for part in (right, visible, claimed & ~right, claimed, nees)])


def _shares(counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Correct share of the visible, wrong share of the claimed, and mean NEES of the correct ones: () each."""
    right, visible, wrong, claimed, nees = counts.unbind()
    return right / visible.clamp(min=1), wrong / claimed.clamp(min=1), nees / (2 * right).clamp(min=1)
