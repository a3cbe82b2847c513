"""Have cameras moved, or have their clocks slipped? All that may be is supposed of the same snapshots, and compared.

Cameras have moved; or their clocks have slipped by some time, where it is known how the object moves; or they see the
object at moments of their own, nobody knows which (`unsynchronized.py`); or they shake (`shaking.py`); or nothing has
happened.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.change_test import JUMPS
from imgcal.monitoring.clock_slip import Slipped, slipped
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_change import changed_object
from imgcal.monitoring.pending_change import free_cameras
from imgcal.monitoring.rig_belief import RigBelief
from imgcal.monitoring.shaking import LEAST_SHIFTS, Shaken, shaken
from imgcal.monitoring.unsynchronized import unsynchronized_evidence
from imgcal.types import Observations

SLIP_ODDS = 5.0
"""Log odds from which it is a clock that has slipped, not a camera that has moved, or the other way round ..."""
SLIP_PATIENCE = 16
"""... and the snapshots for which that is waited for, before it is what is more probable."""
LEAST_SNAPSHOTS = 2
"""Snapshots that tell a camera that has moved from one with moments of its own: one explains any pose of the object."""
LEAST_WIDE = 5e-4
"""Seconds, one standard deviation, to which a slip must be known of a camera of which hardly anything else is."""
LEAST_EARLIER, LEAST_SECONDS = 12, 1.0
"""Snapshots before a change, or seconds since the beginning, from which a camera that moves is told from one that has
exposed late from the first snapshot on: within less, an object moves steadily, and both shift an image alike."""
LEAST_MOTION = 5.0
"""Standard deviations by which the blobs of an object that moves go along an axis, in the median."""


@dataclass(frozen=True)
class Suspicion:
    """Cameras that seem to have moved before some snapshots."""

    before: RigBelief  # what was believed before them
    snapshots: list[tuple[Observations, RigidTransform]]  # and earlier ones, which say how the object moves
    pauses: list[float]  # s before each
    count: int  # of those since then
    cameras: Mapping[int, str | None]  # the surest first
    first: RigBelief | None = None  # what was believed before all of them, where that is what the factory says
    wide: bool = False  # it is hardly known where these cameras are
    held: bool = False  # nothing has been learnt of these cameras since then

    def clocks(self, options: EstimationOptions) -> tuple[float, Slipped | None]:
        """Suppose that it is the clocks of all these cameras that have slipped, or of the first alone.

        Returns:
            Log odds of slips against moves, and the slips, where there is an earlier belief also of ones before
            everything; -inf and None = no slips explain what was seen.
        """
        some = [tuple(self.cameras)[:1], tuple(self.cameras)]
        moved, found = self.evidence_of_moves(options), list[tuple[float, Slipped]]()
        for cameras in dict.fromkeys(some):
            with contextlib.suppress(RefusedError):
                late = slipped(self.before, self.snapshots, self.pauses, self.count, cameras, options, self.wide)
                if late is not None:
                    found.append((late.evidence - moved, late))
        if (earlier := self._earlier(options)) is not None and self.first is not None:
            count = len(self.snapshots)
            with contextlib.suppress(RefusedError):
                late = slipped(self.first, self.snapshots, self.pauses, count, some[0], options, wide=True)
                if late is not None:
                    found.append((late.evidence - earlier - moved, late))
        return max(found, key=lambda one: one[0], default=(-math.inf, None))

    @property
    def too_early(self) -> bool:
        """Tell whether hardly anything had been seen before, of an object that moves: else no clock shows."""
        new = self.first is not None and len(self.snapshots) - self.count < LEAST_EARLIER
        return new and sum(self.pauses) < LEAST_SECONDS and self._object_moves

    @property
    def _object_moves(self) -> bool:
        """Tell whether blobs went elsewhere in the snapshots before."""
        seen = [(one.seen[0], one.uv[0], one.sigma[0]) for one, _ in self.snapshots[: -self.count]]
        if not seen:
            return True
        there, uv, sigma = (torch.stack(parts) for parts in zip(*seen, strict=True))  # (S, C, N), (S, C, N, 2)
        last = torch.where(there[..., None], uv, -torch.inf).amax(0)
        first = torch.where(there[..., None], uv, torch.inf).amin(0)
        went = (last - first).amax(-1)[there.sum(0) > 1]
        return not len(went) or bool(went.median() > LEAST_MOTION * sigma[there].median())

    def apart(self, options: EstimationOptions) -> float:
        """Log odds that all these cameras, or the first alone, see the object at moments of their own, against moves.

        Where there is an earlier belief, also that it has been so before everything.
        """
        since, moved, found = (
            stack_snapshots(self.snapshots[-self.count :]),
            self.evidence_of_moves(options),
            [-math.inf],
        )
        for cameras in dict.fromkeys((tuple(self.cameras)[:1], tuple(self.cameras))):
            with contextlib.suppress(RefusedError):
                found.append(unsynchronized_evidence(self.before, *since, cameras, options) - moved)
        if (earlier := self._earlier(options)) is not None and self.first is not None:
            with contextlib.suppress(RefusedError):
                every = unsynchronized_evidence(
                    self.first, *stack_snapshots(self.snapshots), tuple(self.cameras), options
                )
                found.append(every - earlier - moved)
        return max(found)

    def shaken(self, options: EstimationOptions) -> tuple[float, Shaken | None]:
        """Log odds that cameras shake, against moves; where there is an earlier belief, also that they always have."""
        since, moved = self.snapshots[-self.count :], self.evidence_of_moves(options)
        best = shaken(self.before, since, self.cameras, options)
        odds = -math.inf if best is None else best.evidence - moved
        if (earlier := self._earlier(options)) is not None and self.first is not None:
            always = shaken(self.first, self.snapshots, self.cameras, options)
            if always is not None and always.evidence - earlier - moved > odds:
                return always.evidence - earlier - moved, always
        return odds, best

    def steady(self, options: EstimationOptions) -> float:
        """Log odds that nothing has happened, against moves."""
        with contextlib.suppress(RefusedError):
            result = absorb(self.before, *stack_snapshots(self.snapshots[-self.count :]), options)
            return result.evidence - self.evidence_of_moves(options)
        return -math.inf

    def _earlier(self, options: EstimationOptions) -> float | None:
        """Log probability of the snapshots before, nothing having happened in them; None = they are not all."""
        if self.first is None or self.count >= len(self.snapshots):
            return None
        with contextlib.suppress(RefusedError):
            return absorb(self.first, *stack_snapshots(self.snapshots[: -self.count]), options).evidence
        return None

    def evidence_of_moves(self, options: EstimationOptions) -> float:
        """Log probability of the snapshots since, the cameras having moved."""
        found = []
        for jump in JUMPS:
            with contextlib.suppress(RefusedError):
                free = free_cameras(self.before, self.cameras, jump)
                found.append(absorb(free, *stack_snapshots(self.snapshots[-self.count :]), options).evidence)
        return float(np.logaddexp.reduce(found)) - math.log(len(JUMPS)) if found else -math.inf


@dataclass(frozen=True)
class Answer:
    """What has happened to cameras that seem to have moved."""

    kind: Literal["moved", "slipped", "apart", "shaken", "steady"]
    odds: float  # log odds against the next best
    slipped: Slipped | None = None
    shaken: Shaken | None = None


@dataclass
class ExplanationSearch:
    """Asks of each suspicion what has happened, and waits for a while where that cannot be told."""

    unsure: int = 0  # answers in a row that could not be told

    def ask(self, suspicion: Suspicion, since: int, options: EstimationOptions, patient: bool) -> Answer:
        """Ask what has happened to cameras that seem to have moved.

        Args:
            suspicion: which, and what was seen.
            since: number of the first snapshot since then.
            options: how to minimize.
            patient: it may be waited for.

        Raises:
            RefusedError: it cannot be told yet.
        """
        slip_odds, found = suspicion.clocks(options)
        odds = {"moved": 0.0, "slipped": slip_odds}
        if suspicion.count >= LEAST_SNAPSHOTS:
            odds["apart"] = suspicion.apart(options)
        shaking: Shaken | None = None
        if suspicion.held:
            odds["steady"] = suspicion.steady(options)
        else:
            odds["shaken"], shaking = suspicion.shaken(options)
        best, second = sorted(odds, key=lambda kind: -odds[kind])[:2]
        lead = odds[best] - odds[second]
        early = best in ("moved", "shaken") and suspicion.too_early
        early |= best == "shaken" and suspicion.count < LEAST_SHIFTS  # one shift twice is no random one
        early |= best == "moved" and suspicion.held and suspicion.count < LEAST_SNAPSHOTS
        vague = best == "slipped" and found is not None and _too_vague(found, suspicion)
        self.unsure = self.unsure + 1 if lead < SLIP_ODDS else 0
        if early or vague or (0 < self.unsure <= SLIP_PATIENCE and patient):
            raise RefusedError("estimation: it cannot be told yet whether a camera has moved, or its clock slipped")
        self.unsure = 0
        if best != "slipped" or found is None:
            return Answer(cast(Any, best), lead, shaken=shaking if best == "shaken" else None)
        since -= len(found.snapshots) - suspicion.count
        slips = tuple(replace(slip, since=since, odds=lead) for slip in found.slips)
        return Answer("slipped", lead, replace(found, slips=slips))


def doubtful_cameras(
    before: RigBelief, snapshots: Sequence[tuple[Observations, RigidTransform]], options: EstimationOptions
) -> tuple[tuple[int, ...], bool]:
    """Find the cameras, half of them at most, that explain snapshots which fit nowhere.

    Args:
        before: what was believed before them.
        snapshots: observations (1, C, N) and the object's pose (1,) of each.
        options: how to minimize.

    Returns:
        Cameras that have moved, or have moments of their own; none where a change of the object is as probable. And
        whether it is surely moments of their own.
    """
    observations, poses = stack_snapshots(snapshots)
    count, found, apart = observations.seen.shape[1], tuple[int, ...](), -math.inf
    while 2 * len(found) + 2 <= count:
        odds = {}
        for camera in set(range(count)) - set(found):
            with contextlib.suppress(RefusedError):
                odds[camera] = unsynchronized_evidence(before, observations, poses, (*found, camera), options)
        best = max(odds, key=lambda one: odds[one], default=None)
        if best is None or odds[best] < apart + SLIP_ODDS:
            break
        found, apart = (*found, best), odds[best]
    if not found:
        return (), False
    moved = Suspicion(before, list(snapshots), [], len(snapshots), dict.fromkeys(found)).evidence_of_moves(options)
    explained = max(apart, moved) >= _unexplained(before, snapshots, options) + SLIP_ODDS
    return (found, apart >= moved + SLIP_ODDS) if explained else ((), False)


def _unexplained(
    before: RigBelief, snapshots: Sequence[tuple[Observations, RigidTransform]], options: EstimationOptions
) -> float:
    """Log probability of snapshots where all cameras stand still and are in time; the object may have changed."""
    with contextlib.suppress(RefusedError):
        steady = absorb(before, *stack_snapshots(snapshots), options)
        changed = changed_object(before, snapshots, options, steady)
        return steady.evidence + (0.0 if changed is None else changed[0].odds)
    return -math.inf


def _too_vague(found: Slipped, suspicion: Suspicion) -> bool:
    """Tell whether a slip of cameras that are hardly known is itself hardly known."""
    wide = suspicion.wide or len(found.snapshots) > suspicion.count
    return wide and any(slip.sigma > LEAST_WIDE for slip in found.slips)
