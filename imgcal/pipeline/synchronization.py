"""Detect cameras that are not synchronized, such as webcams: moving points then fit no rig, the faster the worse.

Each image by itself is correct. Relative to the other cameras it is shifted as a whole, by the object's motion between
their exposures, in varying directions from snapshot to snapshot. Wrong lenses, wrong objects and noise do not depend on
the speed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import Associations, accepted_observations
from imgcal.estimation import estimate
from imgcal.types import CalibrationObject, CameraRig, Detections

LEAST_VIEWS = 40
"""Minimum number of images with a known speed."""
LEAST_POINTS = 3
CHANCE = 1e-4
"""Probability of such a rank correlation between shift and speed by chance."""
FASTER = 1.4
"""Minimum ratio of shifts of the fastest third of the images to the slowest third."""
LEAST_SHIFT = 0.3
"""Minimum RMS shift (px) of the fastest third."""
NOTICEABLE = 0.25
"""Additive noise (px) at which a successful calibration is tested, too."""


@dataclass(frozen=True)
class Unsynchronized:
    """Cameras that expose at different times."""

    share: float  # RMS difference of exposure times, as a share of the snapshot interval; a lower bound
    still: float  # px, RMS shift of an image of an object at rest
    slow: float  # px, RMS shift of the slow third of the images
    fast: float  # the same of the fast third
    speed: float  # px from snapshot to snapshot, of the fast third

    def __str__(self) -> str:
        """Describe it in words."""
        return (
            "the cameras are not synchronized: whole images are shifted against the other cameras, by "
            f"{self.slow:.2g} px (RMS) where the object moves slowly and {self.fast:.2g} px where it moves fast "
            f"({self.speed:.2g} px from snapshot to snapshot), as if exposures were about {self.share:.2g} snapshots "
            "apart; the remaining error is timing, not image noise: trigger the cameras together, or hold the "
            "object still for each snapshot"
        )

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        return vars(self) | {"note": str(self)}


def find_unsynchronized(
    labelled: Associations, rig: CameraRig, obj: CalibrationObject
) -> tuple[Unsynchronized, Detections] | None:
    """Test, with labelled snapshots, whether the cameras expose together.

    Args:
        labelled: all snapshots.
        rig: what is known before, float64.
        obj: the calibration object.

    Returns:
        The finding, and the detections with sigmas increased by the time differences, so that an estimate from them has
        the right uncertainty; None if the cameras are synchronized, or the data cannot tell.
    """
    if rig.num_cameras < 2:
        return None
    observations, poses = accepted_observations(labelled, rig, obj)
    even = replace(observations, sigma=torch.ones_like(observations.sigma))
    fit = estimate(even, rig, obj.as_exact(), poses)
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
    # All points of an image are shifted alike, so N of them are worth one.
    return found, _add_variance(labelled, (count * added / 2).numpy())


def _verdict(
    speed: NDArray[np.float64], shift: NDArray[np.float64], scatter: NDArray[np.float64]
) -> Unsynchronized | None:
    """Compare images (K,) by speed (px per snapshot), shift (px) and the scatter of their points (px^2)."""
    from scipy.stats import spearmanr  # slow to import, and rarely needed

    grows, order = spearmanr(speed, shift), np.argsort(speed)
    slow, fast = order[: len(order) // 3], order[-(len(order) // 3) :]
    low, high = (float(np.sqrt(np.square(shift[part]).mean())) for part in (slow, fast))
    if not (grows.pvalue < CHANCE and grows.statistic > 0) or high < max(FASTER * low, LEAST_SHIFT):
        return None
    # Motion blur adds noise to single points rather than to their common shift.
    if high**2 - low**2 < 2 * float(scatter[fast].mean() - scatter[slow].mean()):
        return None
    before, after = float(np.square(speed[slow]).mean()), float(np.square(speed[fast]).mean())
    share = ((high**2 - low**2) / (after - before)) ** 0.5
    still = max(low**2 - share**2 * before, 0.0) ** 0.5
    return Unsynchronized(share, still, low, high, after**0.5)


def _speed(uv: Tensor, seen: Tensor, before: NDArray[np.int64]) -> Tensor:
    """RMS motion of the points in an image from snapshot to snapshot: (S, C) pixels, nan = unknown.

    `before`: see `Associations.before_rows`.
    """
    rows = torch.from_numpy(np.flatnonzero(before >= 0))
    earlier = torch.from_numpy(before)[rows]
    step = (uv[rows] - uv[earlier]).square().sum(-1)
    squared = uv.new_full((2, *uv.shape[:-1]), torch.nan)
    squared[0, rows], squared[1, earlier] = step, step
    return (torch.where(seen, squared.nanmean(0), 0.0).sum(-1) / seen.sum(-1)).sqrt()


def _add_variance(labelled: Associations, added: NDArray[np.float64]) -> Detections:
    """The detections with added variance (px^2 per axis) by image (S, C) of the used snapshots."""
    detections = labelled.detections
    mine = labelled.used_rows[detections.snapshot]
    more = np.where(mine >= 0, added[mine, detections.camera], 0.0)
    return replace(detections, sigma=np.sqrt(np.square(detections.sigma) + more))
