"""Random numbers for rendering, on the device of their generator."""

from __future__ import annotations

import zlib

import torch
from torch import Tensor
from torch.nn import functional


def host_generator(generator: torch.Generator) -> torch.Generator:
    """Random numbers on the host, seeded by another generator: asking a device would block.

    Examples:
        >>> first, second = (host_generator(torch.Generator().manual_seed(3)) for _ in range(2))
        >>> bool(torch.rand((), generator=first) == torch.rand((), generator=second))
        True
    """
    return torch.Generator().manual_seed(zlib.crc32(generator.get_state().numpy().data))


class Draw:
    """Random numbers of a generator, float32, on its device."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def unit(self, *shape: int) -> Tensor:
        """Uniform in [0, 1)."""
        return torch.rand(shape, generator=self.generator, device=self.generator.device)

    def between(self, low: float, high: float, *shape: int) -> Tensor:
        """Uniform between two numbers."""
        return low + (high - low) * self.unit(*shape)

    def normal(self, *shape: int) -> Tensor:
        """Of mean 0 and standard deviation 1."""
        return torch.randn(shape, generator=self.generator, device=self.generator.device)

    def zeros(self, *shape: int) -> Tensor:
        """Zeros, to put beside the others."""
        return torch.zeros(shape, device=self.generator.device)

    def sometimes(self, share: float, largest: float, *shape: int) -> Tensor:
        """Zero in most draws; in a share of them uniform up to the largest."""
        return torch.where(self.unit(*shape) < share, self.between(0, largest, *shape), 0.0)

    def direction(self, *shape: int, of: int = 3) -> Tensor:
        """Unit vectors."""
        return functional.normalize(self.normal(*shape, of), dim=-1)
