"""The data of a running training."""

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
    """A step whose numbers have not been checked yet."""

    step: int  # steps taken, including this one
    generators: list[Tensor]  # states of the data's generator before each part of its batch
    numbers: Tensor  # losses of the parts, norm of the gradient


@dataclass
class Best:
    """The weights with the best validation, if `training.patience` is set."""

    network: nn.Module
    metrics: dict[str, Any]  # `Run.own_metrics` at their validation
    error: float  # of the task's `judged`
    since: int = 0  # later validations without improvement


@dataclass
class Run:
    """A running training."""

    experiment: Experiment
    accelerator: Accelerator
    task: Task[Any, Any]
    network: nn.Module  # in training: wrapped if there are several processes
    judge: Callable[[Any, Any, int], Loss]  # the task's loss, compiled if requested
    plain: nn.Module  # the task's own, without wrapping
    optimizer: torch.optim.Optimizer
    schedule: Schedule
    average: nn.Module | None  # running mean of the weights
    generator: torch.Generator  # of this process's data
    dropout: tuple[torch.Generator, ...]  # generators of its layers: one on the CPU, one on another device
    batch_size: int  # of this process, at once
    step: int = 0
    elapsed: float = 0.0  # s, in all earlier sessions
    began: float = field(default_factory=lambda: monotonic())
    judged: Tensor | None = None  # (2,) sum and number of losses since the schedule's last check
    window: list[dict[str, Tensor]] = field(default_factory=list)  # loss and means of each step since the last log
    metrics: dict[str, Any] = field(default_factory=dict)  # latest value by name, of regular rows
    latest: dict[str, Any] = field(default_factory=dict)  # latest value by name
    told: dict[str, Any] = field(default_factory=dict)  # all values of the last step with a report
    pending: list[Pending] = field(default_factory=list)
    best: Best | None = None  # of the regular validations
    closing: Best | None = None  # of the last, extra validation, if it is better

    @property
    def seconds(self) -> float:
        """Time spent on the training, in all sessions."""
        return self.elapsed + monotonic() - self.began

    @property
    def candidate(self) -> nn.Module:
        """The network for validation: the running mean if there is one."""
        return self.plain if self.average is None else self.average

    @property
    def own_metrics(self) -> dict[str, Any]:
        """Metrics of the current weights; metrics of earlier steps are excluded."""
        told = self.told if self.told.get("step") == self.step else {}
        own = {name: value for name, value in told.items() if name != "lr"}
        return own | {"step": self.step, "seconds": self.seconds}

    @property
    def chosen(self) -> tuple[nn.Module, dict[str, Any]]:
        """The current result network and its metrics."""
        best = self.closing or self.best
        return (self.candidate, self.own_metrics) if best is None else (best.network, best.metrics)
