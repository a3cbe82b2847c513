"""Follow how long the errors of each camera last, so that evidence counts by its effective sample size.

Errors of real cameras are correlated in time: a marker that is half hidden stays so for some frames, a lens error
belongs to a place in the image. Snapshots that repeat an error bring no new evidence. With a correlation time of tau
snapshots, n of them say as much as n / tau independent ones: each is given tau times its variance. A shift of a whole
image that lasts may also be mistaken for a small move. It is expected to come back, so a change of a camera must move
the image by clearly more than that.

Such errors also have heavy tails: an image that is off by far more than usual for half a second, at the edge of a lens
or behind somebody's arm. An image that was off in the snapshot before will be off again, so its labels count by the
precision that Student's t distribution, of which the shifts are taken to be drawn, gives them (the scale mixture of
Lange, Little and Taylor, "Robust statistical modeling using the t distribution", JASA 1989).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import correlation_time
from imgcal.monitoring.change_test import MODEL_ERROR
from imgcal.monitoring.shaking import shared_shifts
from imgcal.types import Observations

MEMORY = 1024
"""Latest snapshots from which correlation times are measured ..."""
FIRST_MEASUREMENTS, MEASUREMENT_INTERVAL = (48, 64, 96), 128
"""... after the first of them, and again after as many more."""
USUAL, USUAL_SECONDS, USUAL_SNAPSHOTS = 0.4, 0.1, 256
"""Autocorrelation of the errors of infrared cameras at short intervals, the time (s) after which it has fallen by a
factor e, and the snapshots up to which no less is assumed of a rig that has been calibrated: few cannot tell."""
FASTEST, SLOWEST = 1 / 60, 1.0
"""Seconds between snapshots, before anything is known of their rate; longer ones are pauses."""
PAUSE = 2.5
"""Intervals between snapshots after which the last one does not say any more how far an image is off."""
SMOOTHING = 0.1
"""Weight of the latest interval between snapshots in their average."""
EPISODE, EPISODE_SECONDS = 2.0, 0.4
"""Correlation times that a passing error may last, and the seconds that it may last at least: a target at the edge of
an image, behind somebody's arm, or under wrong labels stays there for so long, and may seem to be shifted by pixels."""
LARGEST = 10.0
"""Times the usual size of lasting errors from which one lasts no longer than that."""
LEAST_LASTING = 0.05
"""Pixels: errors that last are at least so large, by what ten well calibrated infrared cameras show."""
LEAST_SHIFT = 6.0
"""Times the usual size of lasting errors by which a change must shift an image."""
TAIL, TAIL_SIGMAS = 0.99, 3.03
"""Part of the shifts that the tail leaves out, and how far it begins where they are normal, in standard deviations."""
SETTLING_SNAPSHOTS = 64
"""After a change of a camera, while it is learnt anew: what it leaves then follows from how little is known of it."""
LEAST_POINTS = 2
"""Labels of a camera from which the shift of its image counts."""
FREEDOM, MEDIAN = 4.0, 1.29
"""Degrees of freedom of the shifts' t distribution, and the median length of such a shift in units of its scale."""
FREEDOM_OF_SHIFT = 2.0
"""Coordinates of a shift: its expected square, in units of its scale, where nothing else is known."""
LEAST_WEIGHT = 1 / 16
"""Of a camera whose image is off: one that has moved must still be noticed."""


@dataclass
class NoiseCorrelation:
    """How long the errors of each camera last, measured by the shifts of its image that snapshots leave.

    Examples:
        >>> NoiseCorrelation(2).time
        tensor([1., 1.], dtype=torch.float64)
    """

    cameras: int
    time: Tensor = field(init=False)  # (C,) correlation time in snapshots; 1 = independent
    lasting: Tensor = field(init=False)  # (C,) px, one standard deviation of a shift of the image that lasts
    shifts: deque[NDArray[np.float64]] = field(default_factory=lambda: deque(maxlen=MEMORY))  # (C, 2) px
    taken: int = 0  # snapshots
    usual: float = 1.0  # least correlation time as long as too few have been taken
    interval: float = 0.0  # s between snapshots; 0 = not known
    settled_at: dict[int, int] = field(default_factory=dict)  # number of snapshots from which changed cameras count
    scale: Tensor = field(init=False)  # (C,) px, of the t distribution of the shifts
    off: Tensor = field(init=False)  # (C,) squared shift in the last snapshot, in units of the scale; nan = not known

    def __post_init__(self) -> None:
        """Begin with errors that are independent from snapshot to snapshot."""
        self.time = torch.ones(self.cameras, dtype=torch.float64)
        self.lasting = torch.zeros(self.cameras, dtype=torch.float64)
        self.scale = torch.full_like(self.time, LEAST_LASTING)
        self.off = torch.full_like(self.time, math.nan)

    def pass_time(self, seconds: float) -> None:
        """Note how long ago the last snapshot was."""
        if 0 < seconds <= SLOWEST:
            self.interval += (SMOOTHING if self.interval else 1.0) * (seconds - self.interval)
        if seconds > PAUSE * (self.interval or FASTEST):
            self.off = torch.full_like(self.off, math.nan)

    def expect_usual(self) -> None:
        """Assume the usual correlation of snapshots at this rate, until enough have been taken."""
        self.usual = usual_time(self.interval) if self.taken < USUAL_SNAPSHOTS else 1.0
        if self.taken < FIRST_MEASUREMENTS[0]:
            self.time = torch.full_like(self.time, self.usual)

    @property
    def model_error(self) -> Tensor:
        """By how much each camera's image may be off for a while where nothing has moved: (C,) px."""
        return torch.where(self.time > 1, self.lasting.clamp_min(LEAST_LASTING), MODEL_ERROR)

    def episode(self, camera: int, shift: float) -> int:
        """Successive snapshots that an error of a camera may last which shifts its image by so many pixels."""
        usual = self.episodes[camera]
        large = shift > LARGEST * float(self.model_error[camera])
        return min(usual, math.ceil(self._least_episode)) if large else usual

    @property
    def correlated(self) -> Tensor | None:
        """The same of cameras whose errors last: (C,) px; None = the errors of all are independent."""
        return self.model_error if bool((self.time > 1).any()) else None

    @property
    def episodes(self) -> list[int]:
        """Successive snapshots of each camera that one passing error may last."""
        least = self._least_episode
        return [1 if time <= 1 else math.ceil(max(EPISODE * time, least)) for time in self.time.tolist()]

    @property
    def _least_episode(self) -> float:
        return EPISODE_SECONDS / (self.interval or FASTEST)

    @property
    def least_shifts(self) -> list[float]:
        """Pixels by which a change must shift the image of each camera: less may be an error that lasts."""
        return torch.where(self.time > 1, LEAST_SHIFT * self.model_error, 0.0).tolist()

    def weigh(self, observations: Observations) -> Observations:
        """Give observations (S, C, N) the variance with which their number is an effective sample size.

        Images that were off in the last snapshot get more; each last snapshot counts once.
        """
        if not bool((self.time > 1).any()):
            return observations
        root = (self.time / self._weight).sqrt()
        self.off = torch.full_like(self.off, math.nan)
        shake = None if observations.shake is None else observations.shake * root
        return replace(observations, sigma=observations.sigma * root[:, None], shake=shake)

    @property
    def _weight(self) -> Tensor:
        """Precision (C,) of the next snapshot over the usual one, given how far each image was off in the last one."""
        lasts = ((self.time - 1) / (self.time + 1)).square()  # the part of a squared shift that is expected to remain
        expected = torch.where(self.off.isnan(), FREEDOM_OF_SHIFT, lasts * self.off + (1 - lasts) * FREEDOM_OF_SHIFT)
        weight = (FREEDOM + FREEDOM_OF_SHIFT) / (FREEDOM + expected)
        return torch.where(self.time > 1, weight.clamp_min(LEAST_WEIGHT), 1.0)

    def settle(self, cameras: Collection[int]) -> None:
        """Leave out the next snapshots of cameras that have changed."""
        self.settled_at |= dict.fromkeys(cameras, self.taken + SETTLING_SNAPSHOTS)

    def add(self, observations: Observations, residual: Tensor) -> None:
        """Add what is left of a snapshot in which nothing is wrong.

        Args:
            observations: (1, C, N).
            residual: (1, C, N, 2) pixels.
        """
        (shift,), (variance,) = shared_shifts(observations, residual)
        shift[observations.seen[0].sum(1).numpy() < LEAST_POINTS] = np.nan
        shift[[camera for camera, settled in self.settled_at.items() if self.taken < settled]] = np.nan
        self.shifts.append(shift)
        self.taken += 1
        scale = np.maximum(self.scale.numpy(), np.sqrt(variance))
        self.off = torch.from_numpy(np.square(shift / scale[:, None]).sum(1))
        if self.taken in FIRST_MEASUREMENTS or self.taken % MEASUREMENT_INTERVAL == 0:
            self._measure()

    def _measure(self) -> None:
        """Measure each camera by itself, and all together: those of which little was seen are taken to be alike."""
        series = np.stack(self.shifts)
        seen = np.isfinite(series[..., 0])
        variance = np.nansum(np.square(series), axis=(0, 2)) / (2 * np.maximum(seen.sum(0), 1))
        whitened = series / np.sqrt(np.maximum(variance, 1e-12))[:, None]
        together = float(correlation_time(whitened[:, None])[0])
        time = np.maximum(correlation_time(series), max(together, self.usual))
        self.time = torch.from_numpy(time)
        # A passing error is seldom, and large: the tail says more of it than the variance.
        length = np.where(seen, np.linalg.norm(series, axis=-1), np.nan)
        tail = np.array(
            [np.nanquantile(column, TAIL) if some.any() else 0.0 for column, some in zip(length.T, seen.T, strict=True)]
        )
        self.lasting = torch.from_numpy(np.where(time > 1, tail / TAIL_SIGMAS, 0.0))
        usual = np.array(
            [np.nanmedian(column) if some.any() else 0.0 for column, some in zip(length.T, seen.T, strict=True)]
        )
        self.scale = torch.from_numpy(np.maximum(usual / MEDIAN, LEAST_LASTING))


def usual_time(seconds: float) -> float:
    """Correlation time, in snapshots, of usual errors in snapshots that are so many seconds apart.

    Examples:
        >>> [round(usual_time(seconds), 2) for seconds in (1 / 60, 0.1, 1.0)]
        [5.41, 1.47, 1.0]
    """
    return 1 + 2 * USUAL / math.expm1(min((seconds or FASTEST) / USUAL_SECONDS, 50.0))
