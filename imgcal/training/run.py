"""A training under way."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn

from imgcal.training.experiment import Experiment
from imgcal.training.optimization import Schedule
from imgcal.training.task import Task


@dataclass
class Pending:
    """A step whose numbers nobody has looked at."""

    step: int  # steps taken, this one included
    generator: Tensor  # state of the data's generator before it
    numbers: Tensor  # (2,) loss, norm of its gradient


@dataclass
class Run:
    """A training under way."""

    experiment: Experiment
    accelerator: Accelerator
    task: Task[Any, Any]
    network: nn.Module  # as it is trained: wrapped when there are several processes
    plain: nn.Module  # the task's own, without the wrapping
    optimizer: torch.optim.Optimizer
    schedule: Schedule
    average: nn.Module | None  # running mean of the weights
    generator: torch.Generator  # of this process's data
    dropout: tuple[torch.Generator, ...]  # what its layers draw from: one on the CPU, one on another device
    batch_size: int  # of this process
    step: int = 0
    elapsed: float = 0.0  # s, of all sessions until this one began
    began: float = field(default_factory=lambda: monotonic())
    judged: Tensor | None = None  # (2,) sum of losses and their number since the schedule last judged
    window: list[dict[str, Tensor]] = field(default_factory=list)  # loss and means of each step since the last log
    metrics: dict[str, Any] = field(default_factory=dict)  # the latest of each name that were due
    latest: dict[str, Any] = field(default_factory=dict)  # the latest of each name
    pending: list[Pending] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Time spent on the training, all sessions together."""
        return self.elapsed + monotonic() - self.began

    @property
    def best_weights(self) -> nn.Module:
        """The network that is the result: the running mean where there is one."""
        return self.plain if self.average is None else self.average
