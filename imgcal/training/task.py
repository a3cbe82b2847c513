"""What a network is trained for: the engine knows tasks, and nothing of rigs, images or frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn


class Batch(Protocol):
    """What a network sees, and what it should say."""

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, to be saved where a loss is not finite."""


class Result(Protocol):
    """A trained network that can be written: `imgcal.networks.Checkpoint`, for example."""

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Results to keep with it; plain values."""

    def save(self, path: str | Path) -> None:
        """Write it in one step."""


@dataclass(frozen=True)
class Loss:
    """What is minimized, and the numbers that people read."""

    total: Tensor  # () with its graph
    means: Mapping[str, Tensor]  # () each, without graph, on the same device: means over the batch, by name


SomeBatch = TypeVar("SomeBatch", bound=Batch)
Answer = TypeVar("Answer")


class Task(ABC, Generic[SomeBatch, Answer]):
    """A network, what it is shown, and how its answers are judged.

    The engine moves no data: a task makes its batches where its network is. The engine calls `predict` under autocast
    and everything else in full precision; it owns the optimizer, the running mean of the weights, and the random
    numbers, so that a run goes on exactly where it was: a batch must depend on the generator alone.
    """

    unit: ClassVar[str]  # what a batch counts: "rigs", "images"
    judged: ClassVar[str]  # which number of `validate` tells the best weights; the smaller, the better
    headline: ClassVar[Mapping[str, str]] = {}  # what a line of progress shows, and how: {"re_px": "RE {:.3g} px"}
    network: nn.Module  # on its device, in training mode
    untrained: tuple[str, ...] = ()  # parameters that a warm start did not find
    files: Mapping[str, str] = MappingProxyType({})  # by key, content of files that a continuation must find unchanged

    @abstractmethod
    def batch(self, count: int, generator: torch.Generator) -> SomeBatch:
        """Make something new to learn from; the generator is on the network's device. Valid until the next call."""

    @abstractmethod
    def predict(self, network: nn.Module, batch: SomeBatch) -> Answer:
        """Ask `network`, which is this task's own, wrapped or averaged: by calling it, once."""

    @abstractmethod
    def loss(self, answer: Answer, batch: SomeBatch, step: int) -> Loss:
        """Judge an answer; `step` counts the steps already taken."""

    @abstractmethod
    def validate(self, predict: Callable[[SomeBatch], Answer]) -> dict[str, float]:
        """Judge a network on what is always the same: `validation_...` by name, nothing where there is nothing.

        Args:
            predict: this task's `predict` of a network in evaluation mode, without gradient.
        """

    @abstractmethod
    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> Result:
        """What a file holds of a trained network of this kind."""
