"""A filter that notices when a camera changes, says how, and learns that camera anew while it keeps the others."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.monitoring.change_search import (
    NEARBY,
    changed_before,
    changed_cameras,
    contradicting,
    likeliest_age,
    surest,
)
from imgcal.monitoring.change_test import JUMPS
from imgcal.monitoring.clock_slip import ClockSlip
from imgcal.monitoring.drift_learning import DriftLearning
from imgcal.monitoring.drift_pace import DriftPaces
from imgcal.monitoring.explanations import ExplanationSearch, Suspicion, doubtful_cameras
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_change import ObjectChange, changed_object
from imgcal.monitoring.object_question import Misfit, never_fitted, object_explains
from imgcal.monitoring.pending_change import Change, PendingChange, free_cameras
from imgcal.monitoring.quarantine import Quarantine
from imgcal.monitoring.recent_snapshots import RecentSnapshots
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief, age_belief
from imgcal.monitoring.rig_filter import RigFilter
from imgcal.monitoring.shaking import ShakeLevel
from imgcal.monitoring.unsynchronized import without
from imgcal.types import Observations

FEW = 16
"""Snapshots up to which what was known before a change is too little to go by: it bends, within what it leaves open, by
more than it says, and others would be blamed. What came before is then forgotten ..."""
UNSURE = 8
"""... and of the object nothing is asked before so many have been learnt."""
DOUBT = 16
"""Snapshots for which a camera is in doubt that seemed to have moved, and of which nothing could be told."""


@dataclass(frozen=True)
class MonitorUpdate:
    """What a snapshot taught, and what became known with it."""

    update: MeasurementUpdate  # with the pose (1,) and the residual (1, C, N, 2) of the latest snapshot
    changes: tuple[Change, ...] = ()  # of cameras: first that there is one, then of which kind it is
    slips: tuple[ClockSlip, ...] = ()
    unsynchronized: tuple[int, ...] = ()  # cameras that see the object at moments of their own
    object_change: ObjectChange | None = None
    restarted: bool = False  # nothing that was known before a change counts any more


class RigMonitor:
    """A `RigFilter` whose cameras may be bumped.

    Examples:
        >>> import imgcal
        >>> monitor = RigMonitor(RigFilter(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")))
        >>> monitor.filter.count, monitor.open
        (0, {})
    """

    def __init__(self, rig_filter: RigFilter) -> None:
        """Watch over a filter, which is to be updated by this monitor alone from now on."""
        self.filter = rig_filter
        self.open: dict[int, Change] = {}  # changes whose kind is not decided yet, by camera
        self.undecided: dict[int, int] = {}  # cameras that seem to have moved, and for how many snapshots yet
        self._clocks = ExplanationSearch()
        self.held = Quarantine()  # of which nothing is learnt until it is known why they see the object elsewhere
        self.shaking = ShakeLevel(rig_filter.belief.rig.num_cameras)
        self._misfit = Misfit()
        self._recent = RecentSnapshots(rig_filter.belief, rig_filter.walk)
        self._drifting = DriftLearning(DriftPaces(rig_filter.belief.rig.num_cameras))
        self._since: PendingChange | None = None
        self._prior = rig_filter.belief
        self.known_since = 0  # number of the first snapshot that what is known rests on
        self._moved_early: set[int] = set()  # cameras of which the factory knows nothing more
        self._suspect: int | None = None  # the camera without which the last snapshot would not have been refused

    def update(
        self,
        observations: Observations,
        rig_from_object: RigidTransform,
        seconds: float = 0.0,
        moved: Collection[int] = (),
    ) -> MonitorUpdate:
        """Learn from a snapshot.

        Args:
            observations: (1, C, N).
            rig_from_object: (1,) first guess of the object's pose.
            seconds: since the update before.
            moved: cameras that are known to have moved before this snapshot, how far they may.

        Returns:
            What was learnt, and what became known.

        Raises:
            RefusedError: see `absorb`. What no minimum is found for, but for one camera, is refused once; if the next
                snapshot says the same, that camera has moved.
        """
        self.undecided = {camera: left - 1 for camera, left in self.undecided.items() if left > 1}
        observations = self.shaking.of(observations)
        new = [camera for camera in moved if camera not in self.held.cameras]
        if new:
            self.held.hold(new, self.filter.count - self.known_since < FEW)
        known_since = self.known_since
        learn = self._beside_held if self.held.cameras else self._followed
        found = learn(observations, rig_from_object, seconds)
        return replace(found, update=found.update.of_last(), restarted=self.known_since != known_since)

    def _followed(self, observations: Observations, rig_from_object: RigidTransform, seconds: float) -> MonitorUpdate:
        """Learn from a snapshot of which nobody knows that something has moved before it."""
        try:
            result = self.filter.follow(observations, rig_from_object, seconds)
        except RefusedError:
            last, belief = self._suspect, self.filter.belief
            self._suspect = contradicting(belief, observations, rig_from_object, self.filter.options)
            if last is None or last != self._suspect:
                raise
            self.held.hold((last,), self.filter.count - self.known_since < FEW)
            self._suspect = None
            return self._beside_held(observations, rig_from_object, seconds)
        self._suspect = None
        self._recent.append(result, observations, seconds)
        if self._since is not None:
            self._since.take(result, seconds)
        found = changed_before(self._recent, self.filter.count)
        misfit = self._misfit.take(result.chi2, result.dof)
        if found is None and misfit and self._since is None:
            anew = self._learnt_object(misfit)
            if anew is not None:
                return anew
        if found is not None:
            with contextlib.suppress(RefusedError):  # what cannot be told or learnt is tested with the next snapshot
                told = self._alarmed(found)
                self.undecided = {}
                return told
        if self.filter.due:
            result = self.filter.relinearize()
            self._recent.relinearized(result)
            if (anew := self._learnt_first_object(result)) is not None:
                return anew
            if self._since is not None:
                self._since = PendingChange.of(result, self._since.before, self._since.seconds, self._since.kinds)
        if self._since is None:
            self.shaking.take(observations, result.residual[-1:])
        self._drifting.take(self.filter, self._recent, seconds, quiet=self._since is None and found is None)
        if self._since is not None and self._since.due:
            return MonitorUpdate(result, self._judged(self._since.late))
        return MonitorUpdate(result)

    def _beside_held(
        self, observations: Observations, rig_from_object: RigidTransform, seconds: float
    ) -> MonitorUpdate:
        """Learn from a snapshot without the cameras that are held, and ask what has happened to these."""
        held, cameras = self.held, set(self.held.cameras)
        found = self._followed(without(observations, cameras), rig_from_object, seconds)
        if not held.cameras or held.cameras != cameras:  # those that are new have taken it already
            return found
        if held.take(observations, seconds):
            with contextlib.suppress(RefusedError):  # not yet
                found = self._asked_held(found)
        return replace(found, unsynchronized=held.tell())

    def _asked_held(self, found: MonitorUpdate) -> MonitorUpdate:
        """Ask what has happened to the cameras that are held; what was learnt anew where they have moved.

        Raises:
            RefusedError: it cannot be told yet, or they do not see enough.
        """
        held, suspicion = self.held, self.held.suspicion(self._recent)
        since, patient = self.filter.count - suspicion.count, self._since is None
        held.apart = False
        answer = self._clocks.ask(suspicion, since, self.filter.options, patient)
        held.apart = answer.kind == "apart"
        if held.apart:
            return found
        held.release()
        if answer.kind == "moved":
            anew = self._restarted(suspicion, self._judged(last=True))
            return replace(anew, changes=(*found.changes, *anew.changes))
        return found if answer.slipped is None else replace(found, slips=answer.slipped.slips)

    def _restarted(self, moved: Suspicion, told: Sequence[Change]) -> MonitorUpdate:
        """Learn the latest snapshots, which the filter has absorbed otherwise, with cameras that have moved before.

        Raises:
            RefusedError: see `absorb`.
        """
        count, free = moved.count, dict(moved.cameras)
        snapshots, pauses = moved.snapshots[-count:], moved.pauses[-count:]
        if self.filter.count - count - self.known_since < FEW:
            return self._begin_again(free, snapshots, pauses, {}, told)
        result = self.filter.restart(free_cameras(moved.before, free, JUMPS[-1]), snapshots)
        self._recent.took(snapshots, pauses, result)
        return MonitorUpdate(result, (*told, *self._begin(free, result, moved.before, sum(pauses))))

    def _begin_again(
        self,
        free: Mapping[int, str | None],
        snapshots: Sequence[tuple[Observations, RigidTransform]],
        pauses: Sequence[float],
        evidence: Mapping[int, float],
        told: Sequence[Change],
    ) -> MonitorUpdate:
        """Learn from the snapshots since a change alone: before it, hardly anything had been learnt.

        Raises:
            RefusedError: see `absorb`; the monitor stays as it was.
        """
        self._moved_early |= free.keys()
        prior = free_cameras(self._prior, dict.fromkeys(sorted(self._moved_early)), JUMPS[-1])
        result = self.filter.restart(prior, snapshots)
        self._recent = RecentSnapshots(result.belief, self.filter.walk)
        self._recent.took(snapshots, pauses, result)
        self.known_since = self.filter.count - len(snapshots)
        nan, number = float("nan"), self.known_since
        since = {camera: self.open[camera].since if camera in self.open else number for camera in free}
        new = [Change(c, since[c], "unknown", nan, nan, True, evidence.get(c, nan)) for c in free]
        self.open, self._since, self._suspect = {}, None, None
        return MonitorUpdate(result, (*told, *new))

    def _begin(
        self,
        free: dict[int, str | None],
        result: MeasurementUpdate,
        before: RigBelief,
        seconds: float,
        evidence: Mapping[int, float] = MappingProxyType({}),
    ) -> list[Change]:
        """Open changes of cameras, and return those that are new."""
        told, nan = [], float("nan")
        for camera, kind in free.items():
            if kind is None and camera not in self.open:
                number = self.filter.count - len(result.brought)
                self.open[camera] = Change(camera, number, "unknown", nan, nan, evidence=evidence.get(camera, nan))
                told.append(self.open[camera])
        self._since = PendingChange.of(result, before, seconds, free)
        return told

    def _alarmed(self, age: int) -> MonitorUpdate:
        """Let cameras free that have changed, the surest first, until what has been seen since then is explained."""
        told: list[Change] = []
        free: dict[int, str | None] = {}
        since, test = self._since, self._recent.test(age)
        age = likeliest_age(self._recent, surest(test), age)
        if since is not None and age >= since.count - NEARBY:  # it was then that the open ones changed
            again = surest(self._recent.test(age)) in since.kinds
            # Again: the first snapshots were from the old place.
            age = age if again else min(since.count, len(self._recent))
            before, seconds, free = since.before, since.seconds, dict(since.kinds)
        else:
            told = list(self._judged(last=True))
            before, seconds = self._recent.belief_before(age), self._recent.seconds(age)
        known = since is not None and bool(free)
        free, evidence = changed_cameras(self._recent.test(age), free)
        self.undecided |= dict.fromkeys(free, DOUBT)
        snapshots = self._recent.snapshots(age)
        if (in_time := self._in_time_since(before, age, free)) is not None:
            return replace(in_time, changes=tuple(told))
        if self.filter.count - age - self.known_since < FEW:
            return self._begin_again(free, snapshots, self._recent.pauses(age), evidence, told)
        moved = absorb(free_cameras(before, free), *stack_snapshots(snapshots), self.filter.options)
        if not known and (found := changed_object(before, snapshots, self.filter.options, moved)) is not None:
            return replace(self._learn_object(*found, snapshots, self._recent.pauses(age)), changes=tuple(told))
        result = self.filter.restart(free_cameras(before, free), snapshots)
        self._recent.restarted(result, age)
        return MonitorUpdate(result, (*told, *self._begin(free, result, before, seconds, evidence)))

    def _in_time_since(self, before: RigBelief, age: int, cameras: Mapping[int, str | None]) -> MonitorUpdate | None:
        """Learn the latest snapshots anew as cameras had seen them in time, or at rest, or without them.

        Returns:
            What was learnt; None = they have moved.

        Raises:
            RefusedError: it cannot be told yet.
        """
        count = len(self._recent)
        snapshots, pauses = self._recent.snapshots(count), self._recent.pauses(count)
        everything = self.filter.count - self.known_since == count
        first = free_cameras(self._prior, dict.fromkeys(sorted(self._moved_early)), JUMPS[-1]) if everything else None
        suspicion = Suspicion(before, snapshots, pauses, age, cameras, first)
        answer = self._clocks.ask(suspicion, self.filter.count - age, self.filter.options, self._since is None)
        if answer.kind == "moved":
            return None
        slips = () if answer.slipped is None else answer.slipped.slips
        if answer.slipped is not None:
            before, snapshots = answer.slipped.before, answer.slipped.snapshots
        elif answer.shaken is not None:
            self.shaking.believe(answer.shaken.shake)
            before, snapshots = answer.shaken.before, answer.shaken.snapshots
        else:
            before, snapshots = (before, snapshots[-age:]) if first is None else (first, snapshots)
            few = self.filter.count - age - self.known_since < FEW
            snapshots = self.held.hold_since(snapshots, pauses[-len(snapshots) :], cameras, few)
        result = self.filter.restart(before, snapshots)
        self._recent = RecentSnapshots(result.belief, self.filter.walk)
        self._recent.took(snapshots, pauses[-len(snapshots) :], result)
        self.open, self._since = {}, None
        return MonitorUpdate(result, slips=slips)

    def _learnt_object(self, age: int) -> MonitorUpdate | None:
        """Learn the object anew where snapshots fit worse because it has changed."""
        age = min(age, len(self._recent))
        if self.filter.count - age - self.known_since < UNSURE:
            return None
        with contextlib.suppress(RefusedError):
            before = self._recent.belief_before(age)
            return self._asked_object(before, self._recent.snapshots(age), self._recent.pauses(age))
        return None

    def _learnt_first_object(self, result: MeasurementUpdate) -> MonitorUpdate | None:
        """Learn the object anew where it never was as its file says, and so the first snapshots do not fit."""
        count = self.filter.count
        asked = not self.known_since and self._since is None and len(self._recent) == count
        if not asked or not never_fitted(result, count):
            return None
        with contextlib.suppress(RefusedError):
            return self._asked_object(self._prior, self._recent.snapshots(count), self._recent.pauses(count))
        return None

    def ask_object(
        self, snapshots: Sequence[tuple[Observations, RigidTransform]], pauses: Sequence[float], learnt: bool
    ) -> MonitorUpdate | None:
        """Ask whether it is the object that has changed where labels do not fit.

        Args:
            snapshots: observations (1, C, N), with those labels, and poses (1,): the latest ones.
            pauses: s before each of them.
            learnt: they have been learnt without those labels; else not at all.

        Returns:
            What they taught, and how it has changed; None = the object is as it was.
        """
        if self._since is not None or (learnt and len(self._recent) < len(snapshots)):
            return None
        with contextlib.suppress(RefusedError):
            if learnt:
                before = self._recent.belief_before(len(snapshots))
            else:
                before = age_belief(self.filter.belief, self.filter.waited + pauses[0], self.filter.walk)
            found = self._asked_object(before, snapshots, pauses, new=not learnt)
            return None if found is None else replace(found, update=found.update.of_last())
        return None

    def ask_clocks(
        self, snapshots: Sequence[tuple[Observations, RigidTransform]], pauses: Sequence[float]
    ) -> tuple[int, ...]:
        """Ask which cameras are to be doubted where labels fit in most cameras no more; they are held then.

        Args:
            snapshots: observations (1, C, N), with those labels, and poses (1,): of the latest ones, not learnt.
            pauses: s before each of them.

        Returns:
            Those that have not been held before.
        """
        if self._since is not None:
            return ()
        before = age_belief(self.filter.belief, self.filter.waited + pauses[0], self.filter.walk)
        found, sure = doubtful_cameras(before, snapshots, self.filter.options)
        new = tuple(sorted(set(found) - self.held.cameras))
        if new:
            self.held.hold(new, self.filter.count - self.known_since < FEW)
            self.held.apart, self.held.seconds = sure, sum(pauses[1:])
        return new

    def _asked_object(
        self,
        before: RigBelief,
        snapshots: Sequence[tuple[Observations, RigidTransform]],
        pauses: Sequence[float],
        new: bool = False,
    ) -> MonitorUpdate | None:
        """Learn the object anew where that explains some snapshots, which the filter has absorbed or are new to it.

        Raises:
            RefusedError: see `absorb`.
        """
        found = object_explains(before, snapshots, self.filter.options)
        return None if found is None else self._learn_object(*found, snapshots, pauses, new)

    def _learn_object(
        self,
        change: ObjectChange,
        before: RigBelief,
        snapshots: Sequence[tuple[Observations, RigidTransform]],
        pauses: Sequence[float],
        new: bool = False,
    ) -> MonitorUpdate:
        """Go on with an object that is not as it was; its shape is learnt from now on."""
        result = self.filter.restart(before, snapshots, new=len(snapshots) if new else 0)
        self._recent = RecentSnapshots(result.belief, self.filter.walk)
        self._recent.took(snapshots, pauses, result)
        return MonitorUpdate(result, object_change=replace(change, since=self.filter.count - len(snapshots)))

    def _judged(self, last: bool) -> tuple[Change, ...]:
        """Decide what kind of change each open one is, where the snapshots since can tell, or it is time."""
        since = self._since
        if since is None:
            return ()
        test = since.test(self.filter.walk)
        told, kinds = since.judged(test, self.open, last)
        since.kinds.update(kinds)
        if any(kind is not None for kind in kinds.values()):
            first, belief, information = since.supposed(test)
            self.filter.suppose(first, age_belief(belief, since.seconds, self.filter.walk))
            self._recent.rebased(belief, information)
        self.open = {camera: change for camera, change in self.open.items() if camera not in kinds}
        if not self.open:
            self._since = None
        return told
