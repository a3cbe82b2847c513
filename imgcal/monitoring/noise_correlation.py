"""Measure how long the errors of each camera persist, so that evidence counts by its effective sample size.

Errors of real cameras are correlated in time: a half-hidden marker stays half hidden for some frames, and a lens error
belongs to a place in the image. Snapshots that repeat an error add no new evidence. With a correlation time of tau
snapshots, n of them are worth n / tau independent ones, so their variance is multiplied by tau. A persistent shift of a
whole image may also be mistaken for a small move. Such a shift is expected to go away, so a change of a camera must
move the image by clearly more than that.

Such errors also have heavy tails. An image may be shifted by far more than usual for half a second, at the edge of a
lens or behind somebody's arm. An image that was off in the previous snapshot will be off in the next one. Its labels
are therefore weighted by the precision that Student's t distribution of the shifts implies (the scale mixture of
Lange, Little and Taylor, "Robust statistical modeling using the t distribution", JASA 1989).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import correlation_time
from imgcal.medians import median_of_known, quantile_of_known
from imgcal.monitoring.change_test import MODEL_ERROR
from imgcal.monitoring.shaking import shared_shifts
from imgcal.types import Observations

# Correlation times.
MEMORY_SNAPSHOTS = 1024
"""Number of latest snapshots used to measure correlation times ..."""
FIRST_MEASUREMENTS, MEASUREMENT_INTERVAL, MEASUREMENT_OFFSET = (48, 64, 96), 128, 4
"""... counts of snapshots at which they are first measured, and the interval after that with its offset, so that no
snapshot waits for a slow test for changes (`change_search.SLOW_TESTS`), too."""
WITHHELD_SECONDS, MOST_WITHHELD = 2.0, 0.25
"""Seconds of latest snapshots that are left out, but at most this share of all: until a change of a camera has been
found, the shift of its image would pass for a persistent error that hides it."""
USUAL, USUAL_SECONDS = 0.4, 0.1
"""Autocorrelation of the errors of infrared cameras at short intervals, and its decay time (s, to 1/e)."""
USUAL_SNAPSHOTS, USUAL_UNCALIBRATED = 256, 512
"""Numbers of snapshots until which a calibrated rig and another one are assumed to have no less."""
INDEPENDENT, LEAST_JUDGED = 0.5, 128
"""Share of the usual autocorrelation from one snapshot to the next below which the measured one must be, by two
standard deviations, for the errors of an uncalibrated rig to seem independent, and the least number of snapshots to
tell: the estimate follows the errors of the first ones, so that they seem independent."""

# Time between snapshots.
FASTEST, SLOWEST = 1 / 60, 1.0
"""Seconds between snapshots while their rate is unknown; the longest interval that is not a pause."""
PAUSE = 2.5
"""Number of intervals between snapshots after which the previous shift of an image says nothing about the next one."""
SMOOTHING = 0.1
"""Weight of the latest interval in the running mean of intervals."""

# Persistent and passing errors.
EPISODE, EPISODE_SECONDS = 2.0, 1.0
"""How long a passing error may last: correlation times, and at least this many seconds. On the recorded wand, the mean
shift of a camera over 0.8 s reaches 6 times its usual persistent error, and 3.5 times over 1.5 s."""
LARGEST, LARGE_EPISODE_SECONDS = 10.0, 0.4
"""Errors larger than this many times the usual persistent error last no longer than those seconds. A target at the edge
of an image, behind somebody's arm, or with wrong labels stays so for a while, and may seem to be shifted by pixels."""
LEAST_LASTING = 0.05
"""Pixels: least size of persistent errors, as measured on ten well calibrated infrared cameras."""
LEAST_SHIFT = 6.0
"""Minimum image shift of a change, relative to the usual size of persistent errors."""
TAIL, TAIL_SIGMAS = 0.99, 3.03
"""Quantile of the shifts that is compared, and its distance from the mean in standard deviations for normal shifts."""

# Shifts of images.
SETTLING_SNAPSHOTS = 64
"""Snapshots to leave out after a camera has changed: their errors come from how little is known about it."""
LEAST_POINTS = 2
"""Minimum number of labels of a camera for the shift of its image to count."""
FREEDOM, MEDIAN = 4.0, 1.29
"""Degrees of freedom of the shifts' t distribution, and the median length of such a shift in units of its scale."""
FREEDOM_OF_SHIFT = 2.0
"""Coordinates of a shift: the expected squared shift, in units of its scale, without further knowledge."""
LEAST_WEIGHT = 1 / 16
"""Minimum weight of a camera whose image is off: a camera that has moved must still be noticed."""


@dataclass
class NoiseCorrelation:
    """How long the errors of each camera persist, measured by the image shifts that snapshots leave as residuals.

    Examples:
        >>> NoiseCorrelation(2).time
        tensor([1., 1.], dtype=torch.float64)
    """

    cameras: int
    time: Tensor = field(init=False)  # (C,) correlation time in snapshots; 1 = independent
    lasting: Tensor = field(init=False)  # (C,) px, one standard deviation of a persistent image shift
    shifts: deque[NDArray[np.float64]] = field(default_factory=lambda: deque(maxlen=MEMORY_SNAPSHOTS))  # (C, 2) px
    taken: int = 0  # snapshots
    usual: float = 1.0  # least correlation time until enough snapshots are taken, see `expect_usual`
    calibrated: bool = field(default=True, metadata={"saved": False})  # it started with a calibration's result
    interval: float = 0.0  # s between snapshots; 0 = unknown
    settled_at: dict[int, int] = field(default_factory=dict)  # snapshot number from which a changed camera counts again
    scale: Tensor = field(init=False)  # (C,) px, scale of the shifts' t distribution
    off: Tensor = field(init=False)  # (C,) squared shift in the last snapshot, in units of the scale; nan = unknown

    def __post_init__(self) -> None:
        """Start with errors that are independent from snapshot to snapshot."""
        self.time = torch.ones(self.cameras, dtype=torch.float64)
        self.lasting = torch.zeros(self.cameras, dtype=torch.float64)
        self.scale = torch.full_like(self.time, LEAST_LASTING)
        self.off = torch.full_like(self.time, math.nan)

    def pass_time(self, seconds: float) -> None:
        """Note the time since the previous snapshot."""
        if 0 < seconds <= SLOWEST:
            self.interval += (SMOOTHING if self.interval else 1.0) * (seconds - self.interval)
        if seconds > PAUSE * (self.interval or FASTEST):
            self.off = torch.full_like(self.off, math.nan)

    def expect_usual(self, calibrated: bool = True) -> None:
        """Assume the usual correlation at this rate until enough snapshots have been taken.

        For an uncalibrated rig, this holds for the weights of snapshots alone, which must not seem to teach too much
        too early; its cameras are tested for changes as before. It ends when errors seem to be independent.
        """
        self.calibrated = calibrated
        if not calibrated and (not self.interval or (self.usual == 1.0 and self.taken >= FIRST_MEASUREMENTS[0])):
            return
        most = USUAL_SNAPSHOTS if calibrated else USUAL_UNCALIBRATED
        self.usual = usual_time(self.interval) if self.taken < most else 1.0
        if calibrated and self.taken < FIRST_MEASUREMENTS[0]:
            self.time = torch.full_like(self.time, self.usual)

    @property
    def assumed_time(self) -> Tensor:
        """Correlation time by which snapshots are weighed: (C,) snapshots."""
        return self.time.clamp_min(self.usual)

    @property
    def model_error(self) -> Tensor:
        """Persistent error of each camera's image without any change: (C,) px."""
        return torch.where(self.time > 1, self.lasting.clamp_min(LEAST_LASTING), MODEL_ERROR)

    def episode(self, camera: int, shift: float) -> int:
        """Number of successive snapshots that a camera's error may last that shifts the image so far (px)."""
        usual = self.episodes[camera]
        large = shift > LARGEST * float(self.model_error[camera])
        return min(usual, self._count(LARGE_EPISODE_SECONDS)) if large else usual

    @property
    def persistent(self) -> Tensor:
        """Noise (px) of each camera's whole image in a snapshot, as if independent of other snapshots: (C,)."""
        return torch.where(self.time > 1, self.model_error * self.time.sqrt(), 0.0)

    @property
    def correlated(self) -> Tensor | None:
        """`model_error`, or None if the errors of all cameras are independent: (C,) px."""
        return self.model_error if bool((self.time > 1).any()) else None

    @property
    def episodes(self) -> list[int]:
        """Number of successive snapshots that a passing error of each camera may last."""
        least = self._count(EPISODE_SECONDS)
        return [1 if time <= 1 else max(math.ceil(EPISODE * time), least) for time in self.time.tolist()]

    def _count(self, seconds: float) -> int:
        """Number of snapshots within some seconds."""
        return math.ceil(seconds / (self.interval or FASTEST))

    @property
    def _withheld(self) -> int:
        """Number of latest snapshots that may show a change that has not been found yet."""
        return min(self._count(WITHHELD_SECONDS), int(MOST_WITHHELD * len(self.shifts)))

    @property
    def least_shifts(self) -> list[float]:
        """Minimum image shift (px) of each camera that counts as a change: less may be a persistent error."""
        return torch.where(self.time > 1, LEAST_SHIFT * self.model_error, 0.0).tolist()

    def weigh(self, observations: Observations, least: Tensor) -> Observations:
        """Scale the variance of observations (S, C, N) so that they count by their effective sample size.

        Images that were off in the last snapshot get a larger variance; each snapshot is used once for that.

        Args:
            observations: of a snapshot.
            least: (N,) factors on the standard deviations because of an object at rest, see `Rest`.
        """
        time = self.assumed_time
        if not bool((time > 1).any() or (least > 1).any()):
            return observations
        root = (time / self._weight).sqrt()[:, None]
        self.off = torch.full_like(self.off, math.nan)
        shake = None if observations.shake is None else observations.shake * root.maximum(least.min())[:, 0]
        return replace(observations, sigma=observations.sigma * root.maximum(least), shake=shake)

    @property
    def _weight(self) -> Tensor:
        """Precision (C,) of the next snapshot over the usual one, given how far each image was off in the last one."""
        lasts = ((self.time - 1) / (self.time + 1)).square()  # the part of a squared shift that is expected to remain
        expected = torch.where(self.off.isnan(), FREEDOM_OF_SHIFT, lasts * self.off + (1 - lasts) * FREEDOM_OF_SHIFT)
        weight = (FREEDOM + FREEDOM_OF_SHIFT) / (FREEDOM + expected)
        return torch.where(self.time > 1, weight.clamp_min(LEAST_WEIGHT), 1.0)

    def settle(self, cameras: Collection[int]) -> None:
        """Ignore the latest and the next snapshots of cameras that have changed."""
        if not cameras:
            return
        for shift in islice(reversed(self.shifts), self._withheld):
            shift[list(cameras)] = np.nan
        self.settled_at |= dict.fromkeys(cameras, self.taken + SETTLING_SNAPSHOTS)

    def add(self, observations: Observations, residual: Tensor) -> None:
        """Add the residuals of a snapshot without suspicion.

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
        later = self.taken > FIRST_MEASUREMENTS[-1] and self.taken % MEASUREMENT_INTERVAL == MEASUREMENT_OFFSET
        if later or self.taken in FIRST_MEASUREMENTS:
            self._measure()

    def _measure(self) -> None:
        """Measure each camera alone and all together: cameras with few snapshots are assumed to be like the others."""
        series = np.concatenate(self.shifts).reshape(-1, self.cameras, 2)[: len(self.shifts) - self._withheld]
        seen = np.isfinite(series[..., 0])
        variance = np.nansum(np.square(series), axis=(0, 2)) / (2 * np.maximum(seen.sum(0), 1))
        whitened = series / np.sqrt(np.maximum(variance, 1e-12))[:, None]
        if not self.calibrated and self.taken >= LEAST_JUDGED and self._seem_independent(whitened):
            self.usual = 1.0
        together = float(correlation_time(whitened[:, None])[0])
        time = np.maximum(correlation_time(series), max(together, self.usual if self.calibrated else 1.0))
        self.time = torch.from_numpy(time)
        # A passing error is rare and large: the tail of the distribution shows it better than the variance.
        length = np.where(seen, np.linalg.norm(series, axis=-1), np.nan)
        tail = np.nan_to_num(quantile_of_known(length, TAIL))
        self.lasting = torch.from_numpy(np.where(time > 1, tail / TAIL_SIGMAS, 0.0))
        usual = np.nan_to_num(median_of_known(length))
        self.scale = torch.from_numpy(np.maximum(usual / MEDIAN, LEAST_LASTING))

    def _seem_independent(self, whitened: NDArray[np.float64]) -> bool:
        """Tell whether successive shifts (T, C, 2) of all cameras are clearly less alike than usual errors."""
        products = whitened[1:] * whitened[:-1]
        count = int(np.isfinite(products).sum())
        usual = USUAL * math.exp(-(self.interval or FASTEST) / USUAL_SECONDS)
        return count > 0 and float(np.nanmean(products)) + 2 / math.sqrt(count) < INDEPENDENT * usual


def usual_time(seconds: float) -> float:
    """Correlation time, in snapshots, of usual errors for snapshots that are `seconds` apart.

    Examples:
        >>> [round(usual_time(seconds), 2) for seconds in (1 / 60, 0.1, 1.0)]
        [5.41, 1.47, 1.0]
    """
    return 1 + 2 * USUAL / math.expm1(min((seconds or FASTEST) / USUAL_SECONDS, 50.0))
