"""Lenses to try: coefficients of real cameras' size, and how far from the axis they are good."""

import math

import torch
from torch import Tensor

LENSES = {
    "brown_conrady": ([-0.28, 0.09, 4e-3, -3e-3, -0.01], 0.75),
    "rational": ([0.9, 0.12, 4e-3, -3e-3, 0.004, 1.2, 0.35, 0.02], 1.4),
    "equidistant": ([0.02, -0.011, 0.004, -0.001], math.tan(math.radians(80))),
}
"""Coefficients, and a radius on the z = 1 plane."""


def coefficients(name: str) -> Tensor:
    """(1, D) of one camera."""
    return torch.tensor([LENSES[name][0]], dtype=torch.float64)


def points(name: str, count: int = 200, seed: int = 0) -> Tensor:
    """(1, N, 2) within the radius, some very near the axis, and one on it."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand(1, count, generator=generator, dtype=torch.float64)
    radius = LENSES[name][1] * torch.rand(1, count, generator=generator, dtype=torch.float64).sqrt()
    radius[:, :4] = torch.tensor([0.0, 1e-12, 1e-7, 1e-4], dtype=torch.float64)
    return torch.stack((radius * angle.cos(), radius * angle.sin()), dim=-1)


def mixed() -> tuple[tuple[str, ...], Tensor]:
    """Models of four cameras, two of them alike, and their coefficients (4, 8)."""
    models = ("equidistant", "brown_conrady", "rational", "equidistant")
    rows = torch.zeros(4, 8, dtype=torch.float64)
    for row, name in zip(rows, models, strict=True):
        row[: len(LENSES[name][0])] = coefficients(name)[0]
    rows[3, 0] = 0.05
    return models, rows
