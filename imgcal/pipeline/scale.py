"""What the scale of a recalibrated rig is based on, and the effect of an error in the object's file.

Images alone do not determine lengths. The scale comes from the object's file, unless the file gives it a tolerance and
the cameras' factory positions know it better. Residuals cannot show its error, so predicted errors do not include it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch

from imgcal.estimation import Estimate, WorkingVolume, camera_covariance, predicted_error, scale_response
from imgcal.types import CalibrationObject

NOTICED = 4.0
"""Significance, relative to the cameras' factory positions, at which an error of the object's scale is refused."""
MOST_NOTICED = 0.5
"""Relative error of the scale above which no statement is made about when it would be noticed."""
PERCENT = 0.01


@dataclass(frozen=True)
class KnownDistance:
    """The distance between two cameras that defines a rig's scale."""

    first: str  # camera
    second: str
    length: float  # mm
    is_given: bool  # it was measured; otherwise the scale is unknown

    @property
    def scale(self) -> Scale:
        """What the rig's scale is based on."""
        source: Literal["distance", "none"] = "distance" if self.is_given else "none"
        return Scale(source, 0.0 if self.is_given else math.inf, None, None, None, distance=self)

    def __str__(self) -> str:
        """Describe it in words."""
        if self.is_given:
            return f"scale rests on the distance of {self.first} and {self.second}, {self.length:g} mm, taken as exact"
        return (
            f"scale is unknown: {self.first} and {self.second} were put {self.length:g} mm apart, and all lengths are "
            "in this unit; --distance gives the true one"
        )


@dataclass(frozen=True)
class Scale:
    """The source of the scale, and its reliability."""

    source: Literal["object", "cameras", "distance", "none"]
    sigma: float  # relative, one standard deviation, given the tolerance of the object's file
    noticed_from: float | None  # relative error of the object's scale that would be noticed; None = none would
    px_per_percent: float | None  # median error over the working volume per 1 % of the object's scale; None = unknown
    mm_per_percent: float | None
    distance: KnownDistance | None = None  # between two cameras, without a factory calibration

    def __str__(self) -> str:
        """One sentence for people; empty if the cameras determine the scale: the predicted error then includes it."""
        if self.distance is not None:
            return str(self.distance)
        if self.source == "cameras" and self.px_per_percent is None:
            return f"scale rests on the cameras' factory positions alone, which know it to {100 * self.sigma:.2g} %"
        if self.source == "cameras" or not self.px_per_percent:
            return ""
        added = [f"{self.px_per_percent:.2g} px"]
        if self.mm_per_percent:
            added.insert(0, f"{self.mm_per_percent:.2g} mm")
        words = f"scale rests on the object file alone: 1 % error in it adds {', '.join(added)} to this"
        if self.noticed_from is None:
            return f"{words}; such an error cannot be noticed"
        return f"{words}; errors above {100 * self.noticed_from:.2g} % would be noticed"

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        return {
            "from": self.source,
            "sigma_percent": _finite(100 * self.sigma),
            "noticed_from_percent": None if self.noticed_from is None else 100 * self.noticed_from,
            "px_per_percent": self.px_per_percent,
            "mm_per_percent": self.mm_per_percent,
            "note": str(self),
        }


def find_scale(estimate: Estimate, obj: CalibrationObject, scale_sigma: float | None, volume: WorkingVolume) -> Scale:
    """Find the source of an estimate's scale.

    Args:
        estimate: without batch axes.
        obj: the object as in its file.
        scale_sigma: relative standard deviation of the object's scale by the factory positions; None = unknown.
        volume: where the rig is used.
    """
    if obj.pose_rank == 3:
        return Scale("cameras", _position_sigma(estimate), noticed_from=None, px_per_percent=None, mm_per_percent=None)
    granted, known = obj.scale_tolerance, scale_sigma or math.inf
    response = scale_response(estimate) * PERCENT
    effect = predicted_error(estimate, volume=volume, covariance=response[:, None] * response)
    noticed = NOTICED * math.hypot(known, granted)
    return Scale(
        source="cameras" if known < granted else "object",
        sigma=granted if math.isinf(known) else granted * known / (math.hypot(granted, known) or 1.0),
        noticed_from=noticed if noticed < MOST_NOTICED else None,
        px_per_percent=_finite(effect.median_px),
        mm_per_percent=_finite(effect.median_mm),
    )


def _position_sigma(estimate: Estimate) -> float:
    """Relative standard deviation of the rig's size in the estimate."""
    parts = estimate.problem.prior_std.shape[1:]
    covariance = camera_covariance(estimate, curved=False).unflatten(0, parts).unflatten(-1, parts)
    away = estimate.rig.positions - estimate.rig.positions.mean(0)
    variance = torch.einsum("ci,cidj,dj->", away, covariance[:, 3:6, :, 3:6], away)
    return float(variance.clamp_min(0).sqrt() / away.square().sum())


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
