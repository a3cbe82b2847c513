"""The interface between the engine and what it trains: the engine knows tasks, but no rigs, images or frames."""

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
    """Inputs of a network, and their ground truth."""

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, saved when a loss is not finite."""


class Result(Protocol):
    """A trained network that can be saved, for example `imgcal.networks.Checkpoint`."""

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Results to store with the network; plain values."""

    def save(self, path: str | Path) -> None:
        """Write the file in one step."""


@dataclass(frozen=True)
class Loss:
    """The quantity to minimize, and numbers for the log."""

    total: Tensor  # () with its graph
    means: Mapping[str, Tensor]  # () each, without graph, on the same device: means over the batch, by name


SomeBatch = TypeVar("SomeBatch", bound=Batch)
Answer = TypeVar("Answer")


class Task(ABC, Generic[SomeBatch, Answer]):
    """A network, its data, and its loss and validation.

    The engine moves no data: a task makes its batches on its network's device. The engine calls `predict` under
    autocast and everything else in full precision. It owns the optimizer, the running mean of the weights and the
    random numbers, so that a run can be resumed exactly: a batch must depend on the generator alone.
    """

    unit: ClassVar[str]  # what a batch consists of: "rigs", "images"
    judged: ClassVar[str]  # number from `validate` that determines the best weights; smaller is better
    headline: ClassVar[Mapping[str, str]] = {}  # numbers of a progress line with formats: {"re_px": "RE {:.3g} px"}
    network: nn.Module  # on its device, in training mode
    untrained: tuple[str, ...] = ()  # weights that a warm start did not find
    files: Mapping[str, str] = MappingProxyType({})  # by key, content of files that must not change before a resume

    @abstractmethod
    def batch(self, count: int, generator: torch.Generator) -> SomeBatch:
        """Make a new batch; the generator is on the network's device. Valid until the next call."""

    @abstractmethod
    def predict(self, network: nn.Module, batch: SomeBatch) -> Answer:
        """Call `network`, which is this task's own, wrapped or averaged, exactly once."""

    @abstractmethod
    def loss(self, answer: Answer, batch: SomeBatch, step: int) -> Loss:
        """Compute the loss; `step` counts the steps already taken."""

    @abstractmethod
    def validate(self, predict: Callable[[SomeBatch], Answer]) -> dict[str, float]:
        """Validate a network on fixed data: `validation_...` by name; empty if there is no data.

        Args:
            predict: this task's `predict` of a network in evaluation mode, without gradient.
        """

    @abstractmethod
    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> Result:
        """Return a trained network of this kind for saving."""
