"""A training under way."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn

from imgcal.networks import Network
from imgcal.synthesis import Snapshots
from imgcal.training.data import Batch, Source
from imgcal.training.experiment import Experiment
from imgcal.training.optimization import Schedule
from imgcal.types import CalibrationObject, CameraRig


@dataclass
class Run:
    """A training under way."""

    experiment: Experiment
    accelerator: Accelerator
    factory: CameraRig  # float64
    obj: CalibrationObject  # float64
    network: nn.Module  # as it is trained: wrapped when there are several processes
    plain: Network  # the same without the wrapping
    optimizer: torch.optim.Optimizer
    schedule: Schedule
    average: Network | None  # running mean of the weights
    source: Source
    prior_std: Tensor  # (C, 15) of the drift
    generator: torch.Generator  # of this process's data
    dropout: tuple[torch.Generator, ...]  # what its layers draw from: one on the CPU, one on another device
    validation: list[Snapshots]
    batch_size: int  # of this process
    untrained: tuple[str, ...]  # parameters that a warm start did not find
    step: int = 0
    elapsed: float = 0.0  # s, of all sessions until this one began
    began: float = field(default_factory=lambda: monotonic())
    judged: Tensor | None = None  # (2,) sum of losses and their number since the schedule last judged
    window: list[tuple[Tensor, Tensor]] = field(default_factory=list)  # losses and mean RE of passes since the last log
    metrics: dict[str, Any] = field(default_factory=dict)  # the latest of each name that were due
    latest: dict[str, Any] = field(default_factory=dict)  # the latest of each name
    pending: tuple[Batch, Tensor] | None = None  # last batch, its (2,) loss and gradient norm: not yet looked at

    @property
    def seconds(self) -> float:
        """Time spent on the training, all sessions together."""
        return self.elapsed + monotonic() - self.began

    @property
    def best_weights(self) -> Network:
        """The network that is the result: the running mean where there is one."""
        return self.plain if self.average is None else self.average
