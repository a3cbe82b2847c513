"""Elementary functions for lens formulas: the same source works on tensors and, in compiled code, on scalars."""

# Numba infers types from arguments, and requires overloads to have the same signature.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
import torch
from numba.extending import overload
from torch import Tensor


def sqrt(x: Tensor) -> Tensor:
    """Square root."""
    return torch.sqrt(x) if isinstance(x, Tensor) else np.sqrt(x)


def arctan(x: Tensor) -> Tensor:
    """Arctangent, rad."""
    return torch.arctan(x) if isinstance(x, Tensor) else np.arctan(x)


def tan(x: Tensor) -> Tensor:
    """Tangent of an angle in rad."""
    return torch.tan(x) if isinstance(x, Tensor) else np.tan(x)


def minimum(x: Tensor, limit: float) -> Tensor:
    """The smaller of the two."""
    return x.clamp_max(limit) if isinstance(x, Tensor) else min(x, limit)


@overload(sqrt)
def _sqrt(x):
    return lambda x: np.sqrt(x)


@overload(arctan)
def _arctan(x):
    return lambda x: np.arctan(x)


@overload(tan)
def _tan(x):
    return lambda x: np.tan(x)


@overload(minimum)
def _minimum(x, limit):
    return lambda x, limit: min(x, limit)
