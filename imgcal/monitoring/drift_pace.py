"""Test whether a camera drifts faster than assumed, by what each stretch of snapshots leaves unexplained.

A filter that assumes too low a drift rate lags behind without knowing it. While the rate is right, what successive
stretches leave unexplained (`ChangeTest`) is independent; a camera that creeps adds the same to each. The latest one,
two, ... sixteen stretches are therefore tested together: did a value of a camera drift steadily in one direction, at
one of several speeds (a generalized likelihood ratio of a ramp)? The variance to believe is a mean over the speeds,
weighted by their probabilities: a random walk that goes as far as the ramp within the filter's learning time. A creep
is found within minutes, and forgotten as quickly.

Source: Willsky and Jones, see `change_test.py`; Magill, "Optimal Adaptive Estimation of Sampled Stochastic Processes",
1965.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from imgcal.estimation import error_between
from imgcal.monitoring.change_test import (
    CHANGES,
    MODEL_ERROR,
    ChangeTest,
    Comparison,
    OwnTest,
    camera_change_errors,
    pixel_changes,
)
from imgcal.monitoring.recent_snapshots import RecentSnapshots
from imgcal.monitoring.rig_belief import RigBelief, age_belief, widen
from imgcal.monitoring.rig_filter import RigFilter
from imgcal.types import DriftRate

STRETCH_SECONDS = 20.0
"""Duration of a stretch."""
WINDOWS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Numbers of latest stretches that are tested together."""
SPEEDS = torch.tensor((1.0, 2.0, 4.0, 8.0), dtype=torch.float64)
"""Drift of a value in each stretch, in standard deviations of a stretch's random walk at the assumed rate."""
PACE_DOUBT = 6.0
"""Prior log odds against each speed."""
LEARNING_SECONDS = 133.0
"""Time in which a random walk goes as far as the ramp that it replaces."""
ADDED_TOGETHER = 32
"""Snapshots whose information is summed in one go; one more where the last of them has other work."""


@dataclass
class Stretch:
    """What some snapshots say about the belief before them."""

    before: RigBelief
    brought: Tensor  # (D, D) information
    pull: Tensor  # (D,) gradient at the rig of `before`
    seconds: float = 0.0
    lasting: Tensor | float = MODEL_ERROR  # (C,) px, see `NoiseCorrelation.model_error`

    @classmethod
    def after(cls, before: RigBelief, seconds: float = 0.0, lasting: Tensor | float = MODEL_ERROR) -> Stretch:
        """Start without snapshots; `seconds` of the stretch have passed already."""
        none = before.factor.new_zeros(len(before.factor))
        return cls(before, torch.zeros_like(before.factor), none, seconds, lasting)

    def add(self, belief: RigBelief, brought: Tensor, pull: Tensor) -> None:
        """Add snapshots.

        Args:
            belief: the current belief.
            brought: (D, D) information of the snapshots.
            pull: (D,) their gradient at the rig of `belief`.
        """
        error = (error_between(belief.rig, self.before.rig) / self.before.unit).flatten()
        distance = torch.cat((error, belief.object_offset - self.before.object_offset))
        self.brought, self.pull = self.brought + brought, self.pull + pull + brought @ distance

    def test(self, rate: DriftRate | Tensor) -> ChangeTest:
        """Test for changes during the stretch, beyond a random walk at the given rate."""
        before = self.before
        known = age_belief(before, self.seconds, rate).information
        change = camera_change_errors(before.rig, before.unit)
        found = Comparison(known, self.brought, self.pull, change, pixel_changes(before.rig), self.lasting)
        return found.test_together()


class DriftPaces:
    """How many times faster than assumed each kind of value of each camera drifts.

    Examples:
        >>> paces = DriftPaces(4)
        >>> paces.of_parameters(15).shape, float(paces.squared.max())
        (torch.Size([4, 15]), 1.0)
    """

    STATE: ClassVar = {name: (name, Tensor) for name in ("information", "pull", "squared")}

    def __init__(self, cameras: int) -> None:
        """Start with the assumed rate."""
        shape = (WINDOWS[-1], cameras, len(CHANGES))
        self.information = torch.zeros(*shape, 3, 3, dtype=torch.float64)  # about speeds, latest stretches, ...
        self.pull = torch.zeros(*shape, 3, dtype=torch.float64)  # ... most recent first
        self.squared = torch.ones(shape[1:], dtype=torch.float64)  # (C, kinds) paces

    def of_parameters(self, width: int) -> Tensor:
        """The paces of all parameters: (C, K)."""
        pace = torch.ones(len(self.squared), width, dtype=torch.float64)
        for number, part in enumerate(CHANGES.values()):
            pace[:, part] = self.squared[:, number, None].sqrt()
        return pace

    def add_stretch(self, stretch: Stretch, walk: Tensor) -> Tensor:
        """Learn from a stretch.

        Args:
            stretch: the snapshots.
            walk: (C, K) standard deviation of an hour's drift at the assumed rate.

        Returns:
            (C, K) variance to add to the belief at its end: a drift found now has been going on for some time.
        """
        test = stretch.test(walk * self.of_parameters(walk.shape[1]))
        for kept in (self.information, self.pull):
            kept[1:] = kept[:-1].clone()
        self.information[0], self.pull[0] = self._measure_drift(test.each, walk, stretch.seconds)
        model = self._model(test.each, walk)
        leader = int(self._ratios(model).amax((0, 2, 3)).argmax())
        # A camera that creeps affects all others.
        rest = self._measure_drift(test.condition_on({leader: None}).each, walk, stretch.seconds)
        others = torch.arange(len(self.squared)) != leader
        self.information[0, others], self.pull[0, others] = rest[0][others], rest[1][others]
        ratios, was = self._ratios(model), self.squared
        best, window = ratios.amax(0).max(-1).values, ratios.amax(-1).argmax(0)
        weight = (ratios.amax(0) - PACE_DOUBT).exp()
        self.squared = 1 + (weight * SPEEDS.square()).sum(-1) / (1 + weight.sum(-1)) * (
            LEARNING_SECONDS / STRETCH_SECONDS
        )
        lasted = torch.where(best > 0, torch.tensor(WINDOWS)[window], 0)
        lacking = (self.squared - was).clamp_min(0) * lasted
        variance = torch.zeros_like(walk)
        for number, part in enumerate(CHANGES.values()):
            variance[:, part] = lacking[:, number, None] * walk[:, part].square() * (stretch.seconds / 3600)
        return variance

    def _measure_drift(self, test: OwnTest, walk: Tensor, seconds: float) -> tuple[Tensor, Tensor]:
        """Information (C, kinds, 3, 3) and gradient (C, kinds, 3) of each value's drift, in random walk steps."""
        information, pull = torch.zeros_like(self.information[0]), torch.zeros_like(self.pull[0])
        for number, (kind, part) in enumerate(CHANGES.items()):
            size = part.stop - part.start
            wandered = walk[:, part].square() * (seconds / 3600)
            found = test.change(kind, (1 - self.squared[:, number, None]) * wandered)
            step = walk[:, part] * (STRETCH_SECONDS / 3600) ** 0.5 * (seconds / STRETCH_SECONDS)
            information[:, number, :size, :size] = found[0] * step[:, :, None] * step[:, None, :]
            pull[:, number, :size] = found[1] * step
        return information, pull

    def _model(self, test: OwnTest, walk: Tensor) -> Tensor:
        """Variance (C, kinds, 3) of camera model errors, in steps of the walk; zero where nothing wanders."""
        variance = torch.zeros_like(self.pull[0])
        for number, (kind, part) in enumerate(CHANGES.items()):
            step = walk[:, part] * (STRETCH_SECONDS / 3600) ** 0.5
            error = (test.model_error(kind) / step.clamp_min(1e-30)).square()
            variance[:, number, : part.stop - part.start] = torch.where(step > 0, error, 0.0)
        return variance

    def _ratios(self, model: Tensor) -> Tensor:
        """Log likelihood ratio (windows, C, kinds, speeds) of a ramp against the assumed rate.

        Under both, the camera model has an error of variance (C, kinds, 3), constant within a window.
        """
        last = torch.tensor(WINDOWS)
        information, pull = self.information.cumsum(0)[last - 1], self.pull.cumsum(0)[last - 1]
        error = (model / last.square()[:, None, None, None])[..., None, :]  # in terms of a speed
        steady = _log_evidence(information, pull, error)
        return _log_evidence(information, pull, error + SPEEDS.square()[:, None]) - steady


@dataclass
class DriftLearning:
    """Learns how fast a filter's cameras drift during quiet times, and lowers its confidence in those that do."""

    paces: DriftPaces
    stretch: Stretch | None = None  # the snapshots so far ...
    waiting: int = 0  # ... and how many of the latest are not added yet

    def update(
        self, follows: RigFilter, recent: RecentSnapshots, seconds: float, quiet: bool, busy: bool = False
    ) -> None:
        """Take the latest snapshot, and update the filter's belief.

        Args:
            follows: the filter, which has absorbed this snapshot.
            recent: the latest snapshots, this one included.
            seconds: since the previous snapshot.
            quiet: no camera has changed recently.
            busy: work that can wait is left to the next snapshot.
        """
        if follows.young or not quiet:
            self.stretch = None
            return
        if self.stretch is None:
            self.stretch, self.waiting = Stretch.after(follows.belief, follows.waited, recent.lasting), 0
            return
        stretch = self.stretch
        stretch.seconds, self.waiting = stretch.seconds + seconds, self.waiting + 1
        done = stretch.seconds >= STRETCH_SECONDS
        if done or (self.waiting >= ADDED_TOGETHER and not busy):
            stretch.add(follows.belief, *recent.information(self.waiting))
            self.waiting = 0
        if done:
            lacking = self.paces.add_stretch(stretch, follows.rate.std(follows.belief.rig))
            follows.pace = self.paces.of_parameters(follows.pace.shape[1])
            recent.walk = follows.walk
            if bool(lacking.any()):
                follows.belief = widen(follows.belief, lacking)
            self.stretch = Stretch.after(follows.belief, follows.waited, recent.lasting)


def _log_evidence(information: Tensor, pull: Tensor, variance: Tensor) -> Tensor:
    """Log probability (*B, V) of measurements (*B, k, k) and (*B, k) of values with given variances (*B, V, k)."""
    std = variance.sqrt()
    covariance = (
        torch.eye(pull.shape[-1], dtype=pull.dtype) + std[..., None] * information[..., None, :, :] * std[..., None, :]
    )
    factor = torch.linalg.cholesky(covariance)
    along = torch.linalg.solve_triangular(factor, (std * pull[..., None, :])[..., None], upper=False)[..., 0]
    return 0.5 * along.square().sum(-1) - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
