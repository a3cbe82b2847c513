"""Value types of blobs: ellipses, the look of their surfaces, and their smear while the shutter is open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Surface:
    """Uneven brightness of blobs, and the parts that are cut away.

    Surface coordinates (x, y) = L^-1 (p - uv), with A = L L^T and L upper triangular: the outline is the unit circle.
    For a disc, x points right and y down.
    """

    cuts: Tensor  # (*B, N, Q, 3) unit normal n and offset o (px): keeps n (p - uv) <= o; an infinite o cuts nothing
    limb: Tensor | None = None  # (*B, N) darkening towards the limb: brightness 1 - limb (1 - sqrt(1 - x^2 - y^2))
    bumps: Tensor | None = None  # (*B, N, D, 4) x, y, radius r, gain g: factors 1 + g exp(-d^2 / 2 r^2); g < 0 is dirt


@dataclass(frozen=True)
class Smear:
    """Spread of the light of blobs besides the lens blur. Invisible blobs may hold NaN."""

    path: Tensor  # (*B, N, 2) px, straight path during the exposure; its midpoint is the blob's `uv`
    defocus: Tensor  # (*B, N) px, radius of the disc of confusion


@dataclass(frozen=True)
class Spots:
    """Ellipses in pixels; of uniform brightness and at rest by default."""

    uv: Tensor  # (*B, N, 2) px, centres
    shape: Tensor  # (*B, N, 2, 2) px^2, A of the boundary (x - uv)^T A^-1 (x - uv) = 1
    intensity: Tensor  # (*B, N), 1 is the sensor's contrast, 0 is a dark body that hides what lies behind
    visible: Tensor  # (*B, N) bool
    depth: Tensor  # (*B, N), smaller is nearer
    surface: Surface | None = None
    smear: Smear | None = None

    def of_each(self, change: Callable[[Tensor], Tensor]) -> Spots:
        """Apply a function to every tensor, including those of the surface and the smear.

        Examples:
            >>> one = torch.ones(5, 1)
            >>> spots = Spots(torch.zeros(5, 1, 2), torch.eye(2).expand(5, 1, 2, 2), one, one > 0, one)
            >>> spots.of_each(lambda values: values[:2]).shape.shape
            torch.Size([2, 1, 2, 2])
        """
        return _apply(self, change)


def roll_rows(spots: Spots, speed: Tensor, reference_row: float) -> Spots:
    """Apply a rolling shutter: moving spots are sheared, and seen where they are when their own rows are exposed.

    Args:
        spots: as they are when the reference row is exposed.
        speed: (*B, N, 2) px, displacement from one row to the next, below 1 along v.
        reference_row: row at whose exposure the spots are given.

    Returns:
        Spots as a rolling shutter shows them, which are exactly ellipses again. A point p that moves by s per row is
        exposed at p' = p + s (p'_v - reference), a linear equation for p'.
    """
    along = 1 / (1 - speed[..., 1])
    zero, one = torch.zeros_like(along), torch.ones_like(along)
    shear = torch.stack([one, speed[..., 0] * along, zero, along], dim=-1).unflatten(-1, (2, 2))
    start = spots.uv.new_tensor([0.0, reference_row])
    uv = start + (shear @ (spots.uv - start)[..., None])[..., 0]
    return replace(spots, uv=uv, shape=shear @ spots.shape @ shear.mT)


def in_crop(spots: Spots, centre: Tensor, scale: float, size: tuple[int, int]) -> Spots:
    """Describe spots in the pixels of crops, each of which averages `scale` x `scale` pixels of the frame.

    Args:
        spots: (B, N) in pixels of the frame.
        centre: (B, 2) px of the frame, the middle of each crop.
        scale: Pixels of the frame per pixel of the crop.
        size: height and width of the crops.
    """
    by = 1 / scale
    middle = spots.uv.new_tensor([(size[1] - 1) / 2, (size[0] - 1) / 2])
    surface, smear = spots.surface, spots.smear
    if surface is not None:
        cuts = torch.cat([surface.cuts[..., :2], surface.cuts[..., 2:] * by], dim=-1)
        surface = replace(surface, cuts=cuts)
    if smear is not None:
        smear = Smear(smear.path * by, smear.defocus * by)
    return replace(
        spots,
        uv=(spots.uv - centre[:, None]) * by + middle,
        shape=spots.shape * by**2,
        surface=surface,
        smear=smear,
    )


def _apply(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Apply a function to every tensor of nested value types."""
    parts = {field.name: getattr(value, field.name) for field in fields(value)}
    return replace(
        value,
        **{
            name: change(part) if isinstance(part, Tensor) else _apply(part, change)
            for name, part in parts.items()
            if part is not None
        },
    )
