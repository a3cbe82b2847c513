"""Definition of a lens model: a radial profile, and the decentering that models share."""

# The same functions work on tensors and, once compiled, on scalars.
# mypy: allow-untyped-defs

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

Formula = Callable[..., Any]


@dataclass(frozen=True)
class LensModel:
    """A lens: it maps a point (x, y) of the z = 1 plane to (x, y) g(x^2 + y^2), plus the decentering by p1 and p2.

    The formulas are plain arithmetic (and functions of `elementary`), for tensors and, once compiled, scalars. Each
    takes `one`, a squared radius s, and k, the coefficients in the order of `coefficients`. `one` is 1 in the
    floating-point type of the arithmetic: a literal would turn single precision into double.
    """

    name: str  # in rig files
    coefficients: tuple[str, ...]  # those named p1 and p2 are Brown's decentering
    radial: Formula  # (one, s, k) -> g
    growth: Formula  # (one, s, k) -> 2 dg/ds
    by_coefficients: Formula  # (one, s, k) -> dg/dk of each coefficient, anything for p1 and p2
    kornia: Callable[[Tensor, Tensor], Tensor]  # (B, N, 2), (B, coefficients) -> (B, N, 2), through kornia's function
    inverse: Formula | None = None  # (one, squared distorted radius, k) -> 1 / g; None = by iteration
    # Tensors (s, k) -> whether the distorted radius increases up to s; compiled (k) -> squared radius beyond which
    # every point is past the fold, whatever its slope. None = from samples.
    is_before_fold: Callable[[Tensor, tuple[Tensor, ...]], Tensor] | None = None
    blind_from: Formula | None = None

    @property
    def decentering(self) -> tuple[int, int] | None:
        """Indices of p1 and p2 among the coefficients; None = no decentering."""
        return (self.coefficients.index("p1"), self.coefficients.index("p2")) if "p1" in self.coefficients else None
