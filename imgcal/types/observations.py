"""`Observations`: what the cameras saw of the labelled fiducials, dense."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.messages import brief_repr


@dataclass(frozen=True)
class Observations:
    """Labelled fiducials, dense: what each camera saw of each fiducial in each snapshot.

    Examples:
        >>> snapshots, cameras, fiducials = 3, 10, 8
        >>> uv = torch.zeros(snapshots, cameras, fiducials, 2)
        >>> seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
        >>> Observations(uv, torch.full(seen.shape, 0.1), seen).seen.shape
        torch.Size([3, 10, 8])
    """

    uv: Tensor  # (*B, S, C, N, 2) pixels; any finite value where not seen
    sigma: Tensor  # (*B, S, C, N) pixels, one standard deviation of each axis
    seen: Tensor  # (*B, S, C, N) bool
    shake: Tensor | None = None  # (*B, S, C) pixels, sd of a shift that all points of an image share (`absorb` only)

    __repr__ = brief_repr

    def of_snapshots(self, rows: Tensor | Sequence[int] | int) -> Observations:
        """Keep some entries of the first axis, by mask or indices: snapshots (S,), or captures of a batch."""
        shake = None if self.shake is None else self.shake[rows]
        return Observations(self.uv[rows], self.sigma[rows], self.seen[rows], shake)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Observations:
        """Change the floating-point type, move to a device, or both."""
        return Observations(
            self.uv.to(dtype=dtype, device=device),
            self.sigma.to(dtype=dtype, device=device),
            self.seen.to(device=device),
            None if self.shake is None else self.shake.to(dtype=dtype, device=device),
        )
