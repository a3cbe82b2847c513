"""Shaking cameras (a fan, a floor, trigger jitter): all blobs of a camera share one random shift per snapshot.

Such noise does not average out over the points of a snapshot. If it is treated as independent noise of each point, the
cameras seem to move over and over, and the rig's uncertainty is underestimated.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.medians import median_of_known
from imgcal.monitoring.case import Case, Explained, Explanation, Finding, Start, Variant
from imgcal.monitoring.measurement_update import stack_snapshots
from imgcal.monitoring.rig_belief import MeasurementUpdate
from imgcal.types import Observations

SHAKES = (0.15, 0.5, 1.5)
"""Pixels, one standard deviation: candidate shake levels. A camera that shakes more than that counts as moved."""
SHAKE_SNAPSHOTS = 64
"""Number of snapshots between estimates of the level."""
DIFFERENT_VARIANCE = 2.0
"""Minimum ratio of variances that counts as different; 1.3 occurs by chance."""
LEAST_POINTS = 3
"""Minimum number of points in a camera that show a shared shift."""
LEAST_SHIFTS, SMOOTH = 4, 0.7
"""Number of snapshots that show whether shifts are smooth, as with a clock offset, and the upper limit of von Neumann's
ratio (2 for independent shifts) for that."""


class Shaking(Explanation):
    """All cameras shake, or the suspected ones, by each of `SHAKES`."""

    name = "shaking"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Allow a shared shift of a camera's blobs in each snapshot."""
        every = tuple(range(case.before.rig.num_cameras))
        sets = dict.fromkeys((every, tuple(sorted(case.cameras)) or every))
        return [
            partial(shake_cameras, start, cameras, size) for start in case.starts for cameras in sets for size in SHAKES
        ]

    def premature(self, case: Case, found: Explained) -> str | None:
        """Wait for several shifts: the same shift twice is not random, and a late clock shifts smoothly."""
        if case.count < LEAST_SHIFTS:
            return "too few snapshots to call their shifts random"
        return "too little was seen before to exclude a late clock" if case.too_early else None


def shake_cameras(start: Start, cameras: Sequence[int], size: float) -> Variant:
    """Let cameras shake by this many pixels, or by more if they are known to."""
    snapshots = []
    for one, pose in start.snapshots:
        shake = torch.zeros(1, one.seen.shape[1], dtype=torch.float64) if one.shake is None else one.shake.clone()
        shake[:, list(cameras)] = shake[:, list(cameras)].clamp_min(size)
        snapshots.append((replace(one, shake=shake), pose))
    observations, _ = stack_snapshots(snapshots)

    def find(result: MeasurementUpdate) -> Finding:
        if _smooth(shared_shifts(observations, result.residual)[0][:, shake[0].numpy() > 0]):
            raise RefusedError("the shifts are smooth, like those of a late clock")
        return Finding(shake=shake[0])

    return Variant(start.before, snapshots, start.log_prior, find=find)


def shared_shifts(observations: Observations, residual: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shared shift of a camera's blobs in a snapshot, and its variance by noise.

    Args:
        observations: (S, C, N).
        residual: (S, C, N, 2) pixels.

    Returns:
        Weighted means (S, C, 2) of the residuals, and the variance (S, C) of each of their axes by noise.
    """
    weight = np.where(observations.seen.numpy(), observations.sigma.numpy() ** -2.0, 0.0)
    total = np.maximum(weight.sum(-1), 1e-12)
    return np.einsum("scn,scni->sci", weight, residual.numpy()) / total[..., None], 1 / total


def _smooth(shifts: NDArray[np.float64]) -> bool:
    """Tell whether successive shifts (S, C, 2) are smooth."""
    if len(shifts) < LEAST_SHIFTS:
        return False
    about = np.square(shifts - shifts.mean(0)).sum()
    return bool(np.square(np.diff(shifts, axis=0)).sum() < SMOOTH * about)


@dataclass
class ShakeLevel:
    """How much each camera shakes, estimated from the residuals of single snapshots.

    Examples:
        >>> level = ShakeLevel(2)
        >>> level.shake
        tensor([0., 0.], dtype=torch.float64)
    """

    cameras: int
    shake: Tensor = field(init=False)  # (C,) px, one standard deviation of each axis
    latest: deque[NDArray[np.float64]] = field(default_factory=lambda: deque(maxlen=SHAKE_SNAPSHOTS))  # (3, C)

    def __post_init__(self) -> None:
        """Start with cameras that stand still."""
        self.shake = torch.zeros(self.cameras, dtype=torch.float64)

    def apply_to(self, observations: Observations) -> Observations:
        """Add the shake levels to observations (1, C, N)."""
        return replace(observations, shake=self.shake[None]) if bool(self.shake.any()) else observations

    def believe(self, shake: Tensor) -> None:
        """Restart with levels (C,) in pixels from another source."""
        self.shake = shake
        self.latest.clear()

    def observe(self, observations: Observations, residual: Tensor) -> None:
        """Take the residuals of a snapshot without suspicion: (1, C, N) and pixels (1, C, N, 2)."""
        (shift,), (variance,) = shared_shifts(observations, residual)
        both = np.concatenate((shift.T, variance[None]))
        both[:, observations.seen[0].sum(1).numpy() < LEAST_POINTS] = np.nan
        self.latest.append(both)
        if len(self.latest) == SHAKE_SNAPSHOTS:
            self._ask()

    def _ask(self) -> None:
        """Estimate the levels by comparing shifts with those expected from noise."""
        known = np.stack(self.latest)
        self.latest.clear()
        often = np.isfinite(known[:, 0]).sum(0) > SHAKE_SNAPSHOTS // 2
        if not often.any():
            return
        found, expected = np.full((2, self.cameras), np.nan)
        # The mean square of two coordinates has an exponential distribution. The object's pose absorbs a part of the
        # shifts. A constant shift is not shaking.
        free = max(1 - 1.5 / self.cameras, 0.25)
        shifts = known[:, :2, often] - median_of_known(known[:, :2, often])
        found[often] = median_of_known(np.square(shifts).mean(1)) / (math.log(2) * free)
        expected[often] = median_of_known(known[:, 2, often])
        before = self.shake.numpy()
        ratio = found / (expected + before**2)
        other = often & ((ratio > DIFFERENT_VARIANCE) | (ratio < 1 / DIFFERENT_VARIANCE))
        variance = np.where(found > DIFFERENT_VARIANCE * expected, found - expected, 0.0)
        self.shake = torch.from_numpy(np.where(other, np.sqrt(np.maximum(variance, 0.0)), before))
