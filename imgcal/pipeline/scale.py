"""What the scale of a recalibrated rig is based on, and the effect of an error in the object's file.

Images alone do not determine lengths. The scale comes from the object's file, unless its tolerances let the cameras'
factory positions know it better. Residuals cannot show its error, so predicted errors include no more of it than the
tolerances allow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from imgcal.estimation import (
    Estimate,
    FiducialOffset,
    WorkingVolume,
    camera_covariance,
    object_covariance,
    predicted_error,
    scale_response,
)
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
    sigma: float  # relative, one standard deviation; zero for an object that is exact
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
        added = self._error(PERCENT)
        if self.sigma:
            known = f"scale is known to {100 * self.sigma:.2g} % from the object file and its tolerance"
            words = f"{known}, {self._error(self.sigma)} of this; 1 % more error in the file adds {added}"
        else:
            words = f"scale comes from the object file: 1 % error in it adds {added} to this"
        if self.noticed_from is None:
            return f"{words}; such an error cannot be noticed"
        return f"{words}; the cameras' factory positions would reveal errors above {100 * self.noticed_from:.2g} %"

    def _error(self, relative: float) -> str:
        """Effect of an error of the scale, in words."""
        per_percent = ((self.mm_per_percent, "mm"), (self.px_per_percent, "px"))
        return ", ".join(f"{value * relative / PERCENT:.2g} {unit}" for value, unit in per_percent if value)

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        return {
            "from": self.source,
            "sigma_percent": finite(100 * self.sigma),
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
    response = scale_response(estimate) * PERCENT
    effect = predicted_error(estimate, volume=volume, covariance=response[:, None] * response)
    granted, sigma = _object_sigmas(estimate)
    noticed = NOTICED * math.hypot(scale_sigma or math.inf, obj.scale_tolerance)
    return Scale(
        source="cameras" if 2 * sigma**2 < granted**2 else "object",
        sigma=sigma,
        noticed_from=noticed if noticed < MOST_NOTICED else None,
        px_per_percent=finite(effect.median_px),
        mm_per_percent=finite(effect.median_mm),
    )


def _object_sigmas(estimate: Estimate) -> tuple[float, float]:
    """Relative standard deviation of the object's size, by its tolerances and in the estimate."""
    problem = estimate.problem
    if problem.object_prior_std is None:
        return 0.0, 0.0
    away = _from_centroids(estimate).flatten()
    along, tolerance = away / away.square().sum(), problem.object_prior_std[0]
    by_tolerance = float((along * tolerance[:-1]).square().sum() + tolerance[-1] ** 2)
    estimated = float(along @ object_covariance(estimate, curved=False) @ along)
    return math.sqrt(by_tolerance), math.sqrt(max(estimated, 0.0))


def _from_centroids(estimate: Estimate) -> Tensor:
    """Fiducials (N, 3) mm relative to the centroid of their object."""
    problem = estimate.problem
    centroids = torch.stack([points.mean(0) for points in problem.points_of_parts()])
    return problem.points - (centroids if problem.part_of is None else centroids[problem.part_of])


def remaining_tolerance(estimate: Estimate, shape: Sequence[FiducialOffset]) -> Tensor | None:
    """Tolerance (N,) mm with which an estimated object is as uncertain as it is, in shape and in size.

    A file states the fiducials' errors as independent. Those of an estimated object mostly are a common error of its
    size, much larger than the average of independent ones, so that the size alone requires its own tolerance.

    Args:
        estimate: without batch axes.
        shape: the estimated offset of each fiducial.

    Returns:
        None for an object that was taken as exact.
    """
    if estimate.problem.object_prior_std is None:
        return None
    by_size = _object_sigmas(estimate)[1] * float(_from_centroids(estimate).norm())
    own = estimate.problem.points.new_tensor([offset.sigma for offset in shape])
    return own.clamp_min(by_size)


def _position_sigma(estimate: Estimate) -> float:
    """Relative standard deviation of the rig's size in the estimate."""
    parts = estimate.problem.prior_std.shape[1:]
    covariance = camera_covariance(estimate, curved=False).unflatten(0, parts).unflatten(-1, parts)
    away = estimate.rig.positions - estimate.rig.positions.mean(0)
    variance = torch.einsum("ci,cidj,dj->", away, covariance[:, 3:6, :, 3:6], away)
    return float(variance.clamp_min(0).sqrt() / away.square().sum())


def finite(value: float) -> float | None:
    """None for an unknown value."""
    return value if math.isfinite(value) else None
