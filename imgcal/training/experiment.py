"""The keys that all experiments share: length, optimizer, schedule. One file describes a whole run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator

from imgcal.io import StrictModel
from imgcal.training.task import Task

Spread = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=10**9)]
Rates = Annotated[dict[str, Positive], Field(max_length=64)]
Betas = Annotated[list[Annotated[float, Field(ge=0, lt=1)]], Field(min_length=2, max_length=2)]
Names = Annotated[list[str], Field(max_length=64)]


class PaperRow(StrictModel):
    """Table row of the paper for this experiment, and its result."""

    table: str  # of the paper: "1" or "ablation"
    row: Count  # of the table, from 1
    re_px: Positive | None = None  # the paper's result


class OptimizerConfig(StrictModel):
    """Adam or AdamW with a learning rate for each group of parameters."""

    kind: Literal["adam", "adamw"] = "adamw"  # the algorithm
    lr: Positive = 1e-3  # highest learning rate
    learning_rates: Rates = Field(default={})  # by group of the network (encoder, heads, trunk), instead of `lr`
    betas: Betas = Field(default=[0.9, 0.99])  # decays of the means of gradients and of their squares
    weight_decay: Spread = 0.0  # of matrices only
    clip: Positive | None = 1.0  # largest norm of the gradient
    ema: Annotated[float, Field(gt=0, lt=1)] | None = 0.999  # decay of the running mean of weights that is the result
    freeze: Names = Field(default=[])  # groups of the network whose weights stay fixed
    layer_decay: Annotated[float, Field(gt=0, le=1)] | None = None  # ratio of an encoder layer's rate to the next one's


class ScheduleConfig(StrictModel):
    """The schedule of the learning rates: warmup and cosine to zero over the whole run, plateau, or constant."""

    kind: Literal["cosine", "plateau", "constant"] = "cosine"  # of the rates; plateau: decrease when the loss stalls
    warmup: Fraction = 0.02  # cosine: share of the run
    final: Fraction = 0.0  # cosine: share of the learning rate that remains at the end
    every: Count = 100  # plateau: steps over which the loss is averaged before each check
    patience: Annotated[int, Field(ge=0, le=10**9)] = 10  # plateau: checks without improvement
    factor: Annotated[float, Field(gt=0, lt=1)] = 0.5  # plateau: multiplier of the learning rates
    threshold: Fraction = 1e-3  # plateau: smallest relative improvement that counts


class TrainingConfig(StrictModel):
    """Length, batch, precision and bookkeeping of a run."""

    steps: Count | None = None  # the run ends after this many steps ...
    minutes: Positive | None = None  # ... or minutes of training, whichever comes first
    batch_size: Annotated[int, Field(ge=1, le=2**16)] = 64  # rigs (images, ...) per step, over all processes
    accumulate: Count = 1  # parts into which a batch is split: less memory, gradients averaged
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # of weights, data and dropout
    precision: Literal["float32", "bf16"] = "float32"  # of the encoder and trunk; geometry is always float32
    device: Literal["auto", "cpu"] = "auto"  # auto: a GPU if there is one
    threads: Annotated[int, Field(ge=1, le=256)] | None = None  # of the CPU; null = the environment's setting
    compile: bool | Literal["graphs"] = False  # torch.compile of network and loss: fewer launches; graphs: CUDA's, too
    channels_last: bool = False  # memory order of convolutions' weights: faster on a GPU
    tf32: bool = False  # let a GPU round float32 matrix products to TF32
    init_from: str | list[str] | None = None  # initial weights: files, folders of runs, shipped names; the last wins
    log_every: Count = 50  # steps between two rows of metrics
    validate_every: Count = 500  # steps between two validations
    validation_rigs: Annotated[int, Field(ge=0, le=10**6)] = 512  # rigs (images, ...) to validate on; 0 = none
    patience: Count | None = None  # end the run after this many validations without improvement; the best is the result
    save_every: Count = 500  # steps between two states to resume from

    @model_validator(mode="after")
    def _check_limits(self) -> TrainingConfig:
        if self.steps is None and self.minutes is None:
            raise ValueError("found neither `steps` nor `minutes`, expected one of them")
        if self.patience is not None and not self.validation_rigs:
            raise ValueError(f"found patience {self.patience} and validation_rigs 0, expected at least 1 rig")
        return self

    @property
    def starts(self) -> tuple[str, ...]:
        """The networks of `init_from`, as a tuple."""
        return (self.init_from,) if isinstance(self.init_from, str) else tuple(self.init_from or ())

    def validation_sizes(self, batch_size: int) -> list[int]:
        """Split the validation into batches of at most `batch_size`."""
        count = self.validation_rigs
        return [min(batch_size, count - first) for first in range(0, count, batch_size)]


class Experiment(StrictModel, ABC):
    """Keys of every experiment file; subclasses add those of a task."""

    format: Literal["imgcal-experiment/1"]  # version of the file
    name: Annotated[str, Field(min_length=1, max_length=200)]  # of the experiment
    description: Annotated[str, Field(max_length=10_000)] = ""  # free text
    paper: PaperRow | None = None
    task: str  # what the network is trained for
    optimizer: OptimizerConfig = OptimizerConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    training: TrainingConfig

    @abstractmethod
    def make_task(self, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool) -> Task[Any, Any]:
        """Build the network and its source of data.

        Args:
            device: device of both.
            batch_size: samples that the network gets at once, also in validation.
            weights: generator for the initial weights, on the CPU.
            fresh: False = a state will replace the weights: read neither published ones nor `training.init_from`.

        Raises:
            InputError: unusable experiment.
        """
