"""Whether cameras expose at moments of their own, as webcams do: what moves fits no rig then, the faster the worse.

Each image by itself is sound. Against the other cameras it is shifted as a whole, by as much as the object moved
between their exposures, this way in one snapshot and that way in the next. Wrong lenses, objects and noise know no
speed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr
from torch import Tensor

from imgcal.association import Associations, accepted_observations
from imgcal.estimation import estimate
from imgcal.types import CalibrationObject, CameraRig, Detections

LEAST_VIEWS = 40
"""Images with a speed, on which the verdict rests."""
LEAST_POINTS = 3
CHANCE = 1e-4
"""Probability of such a rank correlation between shift and speed where there is none."""
FASTER = 1.4
"""Times the shift of the slow third of the images, that of the fast third must be at least."""
LEAST_SHIFT = 0.3
"""Pixels, RMS, that the fast third must be shifted by."""
NOTICEABLE = 0.25
"""Pixels of additive noise from which a calibration that succeeded is looked at."""


@dataclass(frozen=True)
class Unsynchronized:
    """Cameras whose exposures are apart in time."""

    share: float  # of the time between snapshots, RMS: how far their moments are apart, at least
    still: float  # px, RMS shift of an image of an object at rest
    slow: float  # px, RMS shift of the slow third of the images
    fast: float  # the same of the fast third
    speed: float  # px from snapshot to snapshot, of the fast third

    def __str__(self) -> str:
        """Say it in words."""
        return (
            "the cameras are not synchronized: whole images are shifted against the other cameras, by "
            f"{self.slow:.2g} px (RMS) where the object moves slowly and {self.fast:.2g} px where it moves fast "
            f"({self.speed:.2g} px from snapshot to snapshot), as if exposures were about {self.share:.2g} snapshots "
            "apart; the error that is left is time, not noise of the images: trigger the cameras together, or hold the "
            "object still for each snapshot"
        )

    @property
    def values(self) -> dict[str, Any]:
        """The form that scripts read."""
        return vars(self) | {"note": str(self)}


def find_unsynchronized(
    labelled: Associations, rig: CameraRig, obj: CalibrationObject
) -> tuple[Unsynchronized, Detections] | None:
    """Ask labelled snapshots whether the cameras expose together.

    Args:
        labelled: all snapshots.
        rig: what is known before, float64.
        obj: the calibration object.

    Returns:
        What was found, and the detections with as much sigma as their moments add, so that an estimate of them is as
        uncertain as it should be; None where the cameras are synchronized, or nothing can be said.
    """
    if rig.num_cameras < 2:
        return None
    observations, poses = accepted_observations(labelled, rig, obj)
    even = replace(observations, sigma=torch.ones_like(observations.sigma))
    fit = estimate(even, rig, obj.taken_as_exact(), poses)
    if not bool(fit.converged):
        return None
    points = fit.rig_from_object.apply(fit.points_object)
    uv = fit.rig.expand(len(points)).project_values(points, obj.radius).uv
    seen, count = observations.seen, observations.seen.sum(-1)
    speed = _speed(uv, seen, labelled.before_rows)
    shift = torch.where(seen[..., None], fit.residual, 0.0).sum(2) / count.clamp_min(1)[..., None]
    inside = torch.where(seen[..., None], fit.residual - shift[:, :, None], 0.0).square().sum((-1, -2))
    known = (count >= LEAST_POINTS) & speed.isfinite() & (seen.any(-1).sum(1, keepdim=True) >= 2)
    if int(known.sum()) < LEAST_VIEWS:
        return None
    moved, shifted = speed[known].numpy(), shift.norm(dim=-1)[known].numpy()
    scatter = (inside / count.clamp_min(1))[known].numpy()
    found = _verdict(moved, shifted, scatter)
    if found is None:
        return None
    usual = float(np.median(moved))
    added = found.still**2 + (found.share * torch.where(speed.isfinite(), speed, usual)) ** 2
    # All points of an image are shifted alike: that of N of them says no more than that of one.
    return found, _add_variance(labelled, (count * added / 2).numpy())


def _verdict(
    speed: NDArray[np.float64], shift: NDArray[np.float64], scatter: NDArray[np.float64]
) -> Unsynchronized | None:
    """Compare images (K,) by speed (px a snapshot), shift (px) and the scatter of their points (px^2)."""
    grows, order = spearmanr(speed, shift), np.argsort(speed)
    slow, fast = order[: len(order) // 3], order[-(len(order) // 3) :]
    low, high = (float(np.sqrt(np.square(shift[part]).mean())) for part in (slow, fast))
    if not (grows.pvalue < CHANCE and grows.statistic > 0) or high < max(FASTER * low, LEAST_SHIFT):
        return None
    # Motion blur makes single points worse, and what they have in common less so.
    if high**2 - low**2 < 2 * float(scatter[fast].mean() - scatter[slow].mean()):
        return None
    before, after = float(np.square(speed[slow]).mean()), float(np.square(speed[fast]).mean())
    share = ((high**2 - low**2) / (after - before)) ** 0.5
    still = max(low**2 - share**2 * before, 0.0) ** 0.5
    return Unsynchronized(share, still, low, high, after**0.5)


def _speed(uv: Tensor, seen: Tensor, before: NDArray[np.int64]) -> Tensor:
    """How far the points that an image shows move from snapshot to snapshot, RMS: (S, C) pixels, nan = unknown.

    `before`: see `Associations.before_rows`.
    """
    rows = torch.from_numpy(np.flatnonzero(before >= 0))
    earlier = torch.from_numpy(before)[rows]
    step = (uv[rows] - uv[earlier]).square().sum(-1)
    squared = uv.new_full((2, *uv.shape[:-1]), torch.nan)
    squared[0, rows], squared[1, earlier] = step, step
    return (torch.where(seen, squared.nanmean(0), 0.0).sum(-1) / seen.sum(-1)).sqrt()


def _add_variance(labelled: Associations, added: NDArray[np.float64]) -> Detections:
    """The detections with more variance (px^2 of each axis) by image (S, C) of the used snapshots."""
    detections = labelled.detections
    row = np.full(len(labelled.snapshots), -1)
    row[labelled.used] = np.arange(len(labelled.used))
    mine = row[detections.snapshot]
    more = np.where(mine >= 0, added[mine, detections.camera], 0.0)
    return replace(detections, sigma=np.sqrt(np.square(detections.sigma) + more))
