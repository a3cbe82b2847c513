"""A training under way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn

from imgcal.training.experiment import Experiment
from imgcal.training.optimization import Schedule
from imgcal.training.task import Loss, Task


@dataclass
class Pending:
    """A step whose numbers were not checked yet."""

    step: int  # steps taken, this one included
    generators: list[Tensor]  # states of the data's generator before each part of its batch
    numbers: Tensor  # losses of the parts, norm of the gradient


@dataclass
class Best:
    """The weights that did best in validation, where `training.patience` asks for them."""

    network: nn.Module
    metrics: dict[str, Any]  # `Run.own_metrics` when they were validated
    error: float  # that of the task's `judged`
    since: int = 0  # validations that were no better


@dataclass
class Run:
    """A training under way."""

    experiment: Experiment
    accelerator: Accelerator
    task: Task[Any, Any]
    network: nn.Module  # as it is trained: wrapped when there are several processes
    judge: Callable[[Any, Any, int], Loss]  # the task's loss, compiled where that was asked for
    plain: nn.Module  # the task's own, without the wrapping
    optimizer: torch.optim.Optimizer
    schedule: Schedule
    average: nn.Module | None  # running mean of the weights
    generator: torch.Generator  # of this process's data
    dropout: tuple[torch.Generator, ...]  # what its layers draw from: one on the CPU, one on another device
    batch_size: int  # of this process, at once
    step: int = 0
    elapsed: float = 0.0  # s, of all sessions until this one began
    began: float = field(default_factory=lambda: monotonic())
    judged: Tensor | None = None  # (2,) sum of losses and their number since the schedule last judged
    window: list[dict[str, Tensor]] = field(default_factory=list)  # loss and means of each step since the last log
    metrics: dict[str, Any] = field(default_factory=dict)  # the latest of each name that were due
    latest: dict[str, Any] = field(default_factory=dict)  # the latest of each name
    told: dict[str, Any] = field(default_factory=dict)  # all of one step, the last of which something was told
    pending: list[Pending] = field(default_factory=list)
    best: Best | None = None  # of the validations that were due
    closing: Best | None = None  # as the run ends, where that is better still

    @property
    def seconds(self) -> float:
        """Time spent on the training, all sessions together."""
        return self.elapsed + monotonic() - self.began

    @property
    def candidate(self) -> nn.Module:
        """The network as it is judged: the running mean where there is one."""
        return self.plain if self.average is None else self.average

    @property
    def own_metrics(self) -> dict[str, Any]:
        """What is known of the weights as they are now: nothing of earlier steps, which had others."""
        told = self.told if self.told.get("step") == self.step else {}
        own = {name: value for name, value in told.items() if name != "lr"}
        return own | {"step": self.step, "seconds": self.seconds}

    @property
    def chosen(self) -> tuple[nn.Module, dict[str, Any]]:
        """The network as it would be the result now, and its metrics."""
        best = self.closing or self.best
        return (self.candidate, self.own_metrics) if best is None else (best.network, best.metrics)
