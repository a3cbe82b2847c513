"""Snapshots of an object at rest count less and less: errors that are the same while nothing moves do not average.

Where a marker's image lies in the grid of pixels, half of it hidden or unevenly lit, its blob is off by the same in all
snapshots of a rest. With the share q of the blobs' variance that differs from one to the next, n of them are worth

    w(n) = n / (n (1 - q) + q)

single ones (Kish, Survey Sampling, 1965), and the n-th adds w(n) - w(n - 1). After a number of them, nothing more is
learned until something moves: they would only drive those of other places out of the memory. `pipeline/rests.py` does
the same with whole captures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.medians import MEDIAN_SQUARED, RELATIVE_DEVIATION, median
from imgcal.types import Observations

LEAST_MOTION = 0.1
"""Pixels by which blobs may differ, beyond their noise, in snapshots of one rest."""
REST_SIGMAS = 4.0
"""Standard deviations by which this median may exceed its expectation."""
MOST_ALLOWED = MEDIAN_SQUARED * (1 + REST_SIGMAS * RELATIVE_DEVIATION)
"""Largest squared distance, in units of the variance, that any number of blobs allows."""
LEAST_FLICKER, MOST_FLICKER = 1e-9, 0.9
"""Least and largest share of the variance that may average out: a rest is worth ten snapshots at most, and six if
`MOST_LEARNT` count."""
SMOOTHING = 0.05
"""Weight of the latest snapshot in the running mean of this share."""
MOST_LEARNT, LEAST_WEIGHT = 16, 1e-4
"""Number of snapshots of a rest that count, and the weight of those after them."""
LONGEST = 10.0
"""Seconds of a rest after which a snapshot is learned from, so that drift counts, too."""

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def show_the_same(
    apart: Floats, variance: Floats, both: Flags, most: NDArray[np.int64], sigmas: float = REST_SIGMAS
) -> Flags:
    """Tell which pairs of snapshots show the same within the noise: half of the labels of every camera, at least.

    Args:
        apart: (..., C, N) px^2, squared distances of blobs with the same label.
        variance: (..., C, N) px^2, sums of both variances.
        both: (..., C, N) seen in both.
        most: (...) labels in the snapshot of a pair that has more of them.
        sigmas: standard deviations by which the median may exceed its expectation.
    """
    count = both.sum(-1)
    allowed = MEDIAN_SQUARED * (1 + sigmas * RELATIVE_DEVIATION / np.sqrt(np.maximum(count, 1)))
    near = both & (apart <= allowed[..., None] * variance + LEAST_MOTION**2)
    enough = 2 * count.sum(-1) >= np.maximum(most, 1)
    return np.asarray(enough & (2 * near.sum(-1) >= count).all(-1))


def count_independent(frames: Floats, share: float) -> Floats:
    """Count the independent snapshots that those of a rest are worth, if `share` of the variance differs in it."""
    return np.asarray(frames / (frames * (1 - share) + share))


@dataclass
class Rest:
    """Where the object was in the latest snapshots, and for how many of them.

    Examples:
        >>> import torch
        >>> still = Observations(torch.zeros(1, 2, 4, 2), torch.ones(1, 2, 4), torch.ones(1, 2, 4, dtype=torch.bool))
        >>> rest = Rest()
        >>> [float(rest.widen(still)[0]) < 1.01 for _ in range(3)], rest.frames
        ([True, False, False], [3, 3, 3, 3])
    """

    first: Observations | None = None  # (1, C, N) at the beginning of the rest
    latest: Observations | None = None
    frames: list[int] = field(default_factory=list)  # (N,) snapshots of the present rest
    flicker: float = MOST_FLICKER  # share of the variance that differs from snapshot to snapshot
    measured: int = 0  # snapshots that have shown it
    unused: float = 0.0  # s since a snapshot was learned from

    @property
    def _shortest(self) -> int:
        """Snapshots of the shortest rest among the fiducials that the latest one shows."""
        shown = [] if self.latest is None else self.latest.seen[0].any(0).tolist()
        return min((count for count, seen in zip(self.frames, shown, strict=True) if seen), default=1)

    def says_nothing(self, seconds: float, horizon: int | None) -> bool:
        """Count the seconds since the snapshot before, and tell whether to learn nothing; `horizon` as for `widen`."""
        rested = self._shortest > MOST_LEARNT and (horizon is None or horizon > MOST_LEARNT)
        self.unused += seconds
        return rested and self.unused < LONGEST

    def pause(self) -> float:
        """Return the seconds since a snapshot was learned from, and begin anew."""
        unused, self.unused = self.unused, 0.0
        return unused

    @property
    def began(self) -> bool:
        """Tell whether the latest snapshot shows something of the object elsewhere than the one before."""
        return self._shortest == 1

    def widen(self, observations: Observations, single: bool = True, horizon: int | None = None) -> Tensor:
        """Take a snapshot, and tell by what factor its standard deviations grow because it repeats what was known.

        Args:
            observations: (1, C, N).
            single: the fiducials move together; otherwise, each for itself.
            horizon: number of latest snapshots that count; None = all.

        Returns:
            (N,) factors of 1 or more.
        """
        first, latest, count = self.first, self.latest, observations.seen.shape[-1]
        now = self.latest = replace(observations, shake=None)
        still = np.zeros(count, dtype=np.bool_)
        if first is not None and latest is not None and latest.seen.shape == now.seen.shape:
            still = _are_still(latest, now, single)
            if still.any():
                still &= _are_still(first, now, single)
        if first is None or latest is None or not still.any():
            self.first, self.frames = now, count * [1]
            return torch.ones(count, dtype=now.uv.dtype)
        self._measure(latest, now, still)
        frames = np.where(still, np.add(self.frames, 1), 1)
        news, self.first = torch.from_numpy(~still) | ~first.seen, _copy(first)
        for own, new in zip(_parts(self.first), _parts(now), strict=True):
            own[news] = new[news]
        self.frames = frames.tolist()
        return torch.from_numpy(self._weight(frames.astype(np.float64), horizon) ** -0.5).to(now.uv.dtype)

    def _measure(self, before: Observations, now: Observations, still: Flags) -> None:
        """Follow the share of the variance that differs between two snapshots of a rest."""
        apart, variance, both = _compare(before, now)
        both &= still
        if not both.any():
            return
        self.measured += 1
        share = min(1.0, median((apart / variance)[both]) / MEDIAN_SQUARED)
        self.flicker += max(SMOOTHING, 1 / (self.measured + 1)) * (share - self.flicker)

    def _weight(self, frames: Floats, horizon: int | None) -> Floats:
        """How many independent snapshots the latest one of a rest is worth, by its number in the rest: (N,)."""
        share = min(max(self.flicker, LEAST_FLICKER), MOST_FLICKER)
        if horizon is not None:  # none is older than the horizon, so that they share what they are worth
            frames = np.minimum(frames, horizon)
            return count_independent(frames, share) / frames
        added = count_independent(frames, share) - count_independent(frames - 1, share)
        return np.where(frames > MOST_LEARNT, LEAST_WEIGHT, np.maximum(added, LEAST_WEIGHT))


def _are_still(before: Observations, now: Observations, single: bool) -> Flags:
    """Tell which fiducials (N,) are where they were."""
    apart, variance, both = _compare(before, now)
    near = both & (apart <= variance * MOST_ALLOWED + LEAST_MOTION**2)
    if not near.any() or (single and 2 * np.count_nonzero(near) < np.count_nonzero(both)):
        return np.zeros(both.shape[1], dtype=np.bool_)  # soon said of what moves
    most = np.maximum(now.seen[0].sum(0).numpy(), before.seen[0].sum(0).numpy())
    if single:
        return np.full(both.shape[1], show_the_same(apart, variance, both, most.sum()))
    return show_the_same(apart.T[..., None], variance.T[..., None], both.T[..., None], most)


def _compare(before: Observations, now: Observations) -> tuple[Floats, Floats, Flags]:
    """Squared distances and sums of variances (px^2), and what was seen in both: (C, N)."""
    uv, sigma, seen = (part[0].numpy() for part in _parts(now))
    uv_before, sigma_before, seen_before = (part[0].numpy() for part in _parts(before))
    return np.square(uv - uv_before).sum(-1), np.square(sigma) + np.square(sigma_before), seen & seen_before


def _parts(observations: Observations) -> tuple[Tensor, Tensor, Tensor]:
    return observations.uv, observations.sigma, observations.seen


def _copy(observations: Observations) -> Observations:
    return Observations(*(part.clone() for part in _parts(observations)))
