"""Track a rig in constant memory: `RigFilter`. `measurement_update.py` updates it with a snapshot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.horizon import Horizon
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief, age_belief
from imgcal.types import CalibrationObject, CameraRig, DriftRate, Observations

TOGETHER = (*range(2, 17), 20, 25, 32, 40, 50, 64, 80, 100, 128, 200, 320, 512)
"""Numbers of first snapshots at which all so far are absorbed together again ..."""
FIRST_OF_CAMERA = frozenset((2, 4, 8, 16, 32))
"""... and numbers of snapshots of any one camera: the less is known about it, the less linear are its equations."""
LEAST_MEMORY, MEMORY, MOST_LABELS = 128, TOGETHER[-1], 2**15
"""Number of first snapshots that are kept: the second one of a rig that was not calibrated and has so few labels. At
60 Hz, a hand-held object shows too little in two seconds for linear equations."""
YOUNG_SECONDS = 60.0
"""Time for which a rig may be assumed to stand still: its drift is far below the noise of a snapshot."""
LEAST_AGING_SECONDS = 1.0
"""Minimum time worth an inversion of the information."""


class RigFilter:
    """Tracks a rig in constant memory, snapshot by snapshot.

    The first snapshots are kept and absorbed together again as their number grows: this removes errors of early
    linearizations far from the truth.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> follows, seen = RigFilter(factory, obj), torch.ones(1, 4, 8, dtype=torch.bool)
        >>> for s in range(5):
        ...     there = Observations(truth.uv[[s]], torch.full(seen.shape, 0.05), seen)
        ...     result = follows.update(there, truth.rig_from_object[[s]], seconds=1 / 60)
        >>> follows.belief.std()[0, 6] < 0.1 * 0.02 * factory.focal_length[0, 0]  # the factory knew it to 2 %
        tensor(True)
    """

    STATE: ClassVar = {
        "rate": ("rate", DriftRate),
        "calibrated": ("calibrated", bool),
        "belief": ("belief", RigBelief),
        "count": ("count", int),
        "shown": ("shown", Tensor),
        "young": ("_young", bool),
        "pace": ("pace", Tensor),
        "horizon": ("horizon", Horizon | None),
        "first_belief": ("_first", RigBelief),
        "kept_snapshots": ("_early", list[tuple[Observations, RigidTransform]]),
        "span_seconds": ("_span", float),
        "waited_seconds": ("_waited", float),
    }

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        rate: DriftRate | None = None,
        options: EstimationOptions = EstimationOptions(),
        prior_std: Tensor | None = None,
        start: tuple[RigBelief, int] | None = None,
        horizon: int | None = None,
    ) -> None:
        """Start with the factory calibration.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object.
            rate: drift rate of the rig; None = as in the rig.
            options: how to minimize.
            prior_std: (C, K) standard deviations of the factory values; None = as in the rig.
            start: a calibration's result, and its number of snapshots; None = nothing.
            horizon: number of latest snapshots that count beside the factory calibration; None = all. With a horizon,
                the rig is assumed to stand still within it, and not to drift.
        """
        self.rate, self.options = rate or rig.drift_rate or DriftRate(), options
        self.calibrated = start is not None  # it started with a calibration's result
        self.belief, self.count = start or (RigBelief.of_prior(rig, obj, prior_std), 0)  # and snapshots absorbed
        self.shown = torch.zeros(rig.num_cameras, dtype=torch.int64)  # (C,) absorbed snapshots that a camera has seen
        self._young = start is None  # the first snapshots are still kept
        self.pace = torch.ones_like(self.belief.unit)  # (C, K) believed drift relative to `rate`
        self.horizon = None if horizon is None else Horizon(horizon, self.belief)
        self._first = self.belief
        self._early: list[tuple[Observations, RigidTransform]] = []
        self._span = self._waited = 0.0  # s since the first snapshot; the part not yet aged by

    @property
    def walk(self) -> Tensor:
        """Believed drift of every value in an hour, one standard deviation: (C, K)."""
        return self.rate.std(self.belief.rig) * self.pace

    @property
    def young(self) -> bool:
        """Tell whether the first snapshots are still kept, to be absorbed again."""
        return self._young

    @property
    def waited(self) -> float:
        """Time (s) for which the belief has not been aged yet."""
        return self._waited

    def update(
        self, observations: Observations, rig_from_object: RigidTransform, seconds: float = 0.0
    ) -> MeasurementUpdate:
        """Learn from a snapshot; a refused one teaches nothing, and its time counts for the next one.

        Args:
            observations: (1, C, N).
            rig_from_object: (1,) first guess of the object's pose.
            seconds: since the previous update.

        Raises:
            RefusedError: see `absorb`.
        """
        result = self.follow(observations, rig_from_object, seconds)
        return self.relinearize() if self.due else result

    def follow(
        self, observations: Observations, rig_from_object: RigidTransform, seconds: float = 0.0
    ) -> MeasurementUpdate:
        """Do the work of `update`, except that the caller must call `relinearize` when `due`; arguments as for it."""
        horizon, alone = self.horizon, None
        if horizon is not None and horizon.snapshots == 1 and self._early:
            alone = horizon.remove(self.belief, seen_cameras(self._early), observations.seen[0].any(-1), self._first)
        passed = max(seconds, 0.0) if self.count and self.horizon is None else 0.0
        self._span, self._waited = self._span + passed, self._waited + passed
        due = self._waited if self._waited >= LEAST_AGING_SECONDS else 0.0
        belief = age_belief(self.belief, due, self.walk) if alone is None else alone.first
        start = None if alone is None else self.belief
        result = absorb(belief, observations, rig_from_object, self.options, start)
        if alone is not None and horizon is not None:
            self._first, horizon.away, self._early = alone.first, alone.away, []
        self.belief, self._waited, self.count = result.belief, self._waited - due, self.count + 1
        still = self._span <= YOUNG_SECONDS or not any(vars(self.rate).values())  # a steady rig never moves
        self.shown += observations.seen[0].any(-1)
        most = LEAST_MEMORY if self.calibrated else max(LEAST_MEMORY, MOST_LABELS // observations.seen.numel())
        few = len(self._early) < min(most, MEMORY)
        self._young = self._young and (self.horizon is not None or (few and still))
        if self._young:
            self._early.append((observations, result.rig_from_object))
        else:
            self._early.clear()
        return result

    def rescale(self, ratio: Tensor) -> None:
        """Scale the standard deviations of the kept snapshots by a factor (C,) for each camera."""
        self._early = [
            (replace(observations, sigma=observations.sigma * ratio[:, None]), pose)
            for observations, pose in self._early
        ]

    @property
    def due(self) -> bool:
        """Tell whether to absorb the kept snapshots together now."""
        count, horizon = len(self._early), self.horizon
        if horizon is not None and count > horizon.snapshots:
            return count > horizon.most
        if count in TOGETHER or horizon is not None or self.calibrated or not count:
            return count in TOGETHER
        shown = self.shown[self._early[-1][0].seen[0].any(-1)].tolist()
        return not FIRST_OF_CAMERA.isdisjoint(shown)

    def learnt_since(self, number: int) -> int:
        """Number of snapshots from number `number` on that the belief rests on."""
        count = self.count - number
        return count if self.horizon is None else min(count, self.horizon.snapshots)

    def relinearize(self) -> MeasurementUpdate:
        """Absorb the kept snapshots again, all together, and forget those beyond the horizon.

        Returns:
            The joint update; `rig_from_object` and `residual` are those of the last one.
        """
        horizon, start = self.horizon, None
        if horizon is not None:
            start, forgotten = self.belief, self._early[: -horizon.snapshots]
            if len(self._early) > horizon.most:
                self._early = self._early[-horizon.snapshots :]
                left = horizon.remove(self.belief, seen_cameras(forgotten), seen_cameras(self._early), self._first)
                self._first, horizon.away = left.first, left.away
        result = absorb(self._first, *stack_snapshots(self._early), self.options, start)
        return self.begin_with(self._first, result)

    def restart(
        self, first: RigBelief, snapshots: Sequence[tuple[Observations, RigidTransform]], new: int = 0
    ) -> MeasurementUpdate:
        """Restart with an earlier belief and the snapshots since.

        Args:
            first: the belief before the snapshots.
            snapshots: observations (1, C, N) and the object's pose (1,) of each.
            new: how many of them have not been absorbed before.

        Raises:
            RefusedError: see `absorb`; the filter stays as it was.
        """
        result = absorb(first, *stack_snapshots(snapshots), self.options)
        self.belief, self._first, self._early = result.belief, first, list(snapshots)
        self._young, self._span, self._waited = True, 0.0, 0.0
        self.count += new
        for observations, _ in self._early[len(self._early) - new :]:
            self.shown += observations.seen[0].any(-1)
        return result

    def absorb_kept(self, first: RigBelief) -> MeasurementUpdate:
        """Absorb the kept snapshots with another belief before the first of them; the filter stays as it is.

        Raises:
            RefusedError: see `absorb`.
        """
        return absorb(first, *stack_snapshots(self._early), self.options)

    def begin_with(self, first: RigBelief, result: MeasurementUpdate) -> MeasurementUpdate:
        """Continue from the kept snapshots' joint update; returns it with the pose and residual of the last one."""
        self._first, self.belief, self._waited = first, age_belief(result.belief, self._span, self.walk), 0.0
        return replace(result.of_last(), belief=self.belief)

    def replace_beliefs(self, first: RigBelief, belief: RigBelief) -> None:
        """Replace the beliefs: before the first kept snapshot, and now."""
        self._first, self.belief, self._waited = first, belief, 0.0


def seen_cameras(snapshots: Sequence[tuple[Observations, RigidTransform]]) -> Tensor:
    """Return which cameras see the object in some snapshots: (C,) bool."""
    return torch.cat([observations.seen for observations, _ in snapshots]).any(0).any(-1)
