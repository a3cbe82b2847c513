"""Robust losses on squared whitened residuals d^2 of any shape.

Each returns the loss and its derivative by d^2, both of that shape, without unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

LossName = Literal["squared", "huber", "cauchy", "geman_mcclure"]
RobustKernel = Callable[[Tensor], tuple[Tensor, Tensor]]


def squared(d2: Tensor) -> tuple[Tensor, Tensor]:
    """Plain least squares: the loss is d^2 (any shape), and its derivative one."""
    return d2, torch.ones_like(d2)


def huber(d2: Tensor, threshold: float = 3.0) -> tuple[Tensor, Tensor]:
    """Quadratic up to `threshold` standard deviations, linear beyond (Huber 1964)."""
    distance = d2.clamp_min(threshold**2).sqrt()
    far = d2 > threshold**2
    return torch.where(far, 2 * threshold * distance - threshold**2, d2), torch.where(far, threshold / distance, 1.0)


def cauchy(d2: Tensor, threshold: float = 3.0) -> tuple[Tensor, Tensor]:
    """Loss and derivative at d^2 (any shape): logarithmic beyond about `threshold` standard deviations."""
    ratio = d2 / threshold**2
    return threshold**2 * torch.log1p(ratio), 1 / (1 + ratio)


def geman_mcclure(d2: Tensor, threshold: float = 3.0) -> tuple[Tensor, Tensor]:
    """Bounded loss: an outlier far beyond `threshold` standard deviations costs a constant."""
    share = threshold**2 / (threshold**2 + d2)
    return d2 * share, share.square()


LOSSES: dict[str, RobustKernel] = {"squared": squared, "huber": huber, "cauchy": cauchy, "geman_mcclure": geman_mcclure}


@dataclass(frozen=True)
class NamedLoss:
    """A robust loss by name, for tensors and for compiled loops."""

    name: LossName
    threshold: float = 3.0  # standard deviations, where it stops being quadratic

    def __call__(self, d2: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss and its derivative."""
        loss = LOSSES[self.name]
        return loss(d2) if self.name == "squared" else loss(d2, self.threshold)  # type: ignore[call-arg]
