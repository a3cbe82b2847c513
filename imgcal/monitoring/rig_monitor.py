"""A filter that detects changes, reports their kind, and relearns the camera concerned while it keeps the others."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from statistics import median_high, median_low
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import POSE_PARAMETERS
from imgcal.geometry import RigidTransform
from imgcal.monitoring.case import SHAPE, Case, ClockSlip, ObjectChange, Snapshot
from imgcal.monitoring.change_search import (
    NEARBY_SNAPSHOTS,
    changed_cameras,
    contradicting_camera,
    find_alarm,
    likeliest_age,
    likeliest_camera,
    slow_tests,
)
from imgcal.monitoring.change_test import JUMPS, LARGE
from imgcal.monitoring.clock_slip import project_fiducials
from imgcal.monitoring.drift_pace import DriftLearning, DriftPaces
from imgcal.monitoring.explanations import (
    Diagnosis,
    Moved,
    Steady,
    Verdict,
    doubtful_cameras,
    explained_by_moves,
    weigh,
)
from imgcal.monitoring.far_turns import have_turned_far, place_cameras, resect_cameras
from imgcal.monitoring.lens_misfit import LensMisfit
from imgcal.monitoring.lens_warming import Warmed
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.noise_correlation import NoiseCorrelation
from imgcal.monitoring.object_change import (
    ALL_MM,
    MISFIT_LEAD,
    PRINT_FIDUCIALS,
    Misfit,
    ObjectChanged,
    free_object,
    has_never_fitted,
    may_have_changed,
)
from imgcal.monitoring.pending_change import Change, PendingChange, free_cameras
from imgcal.monitoring.quarantine import Quarantine
from imgcal.monitoring.recent_snapshots import RecentSnapshots
from imgcal.monitoring.resting import Rest
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief, age_belief
from imgcal.monitoring.rig_filter import RigFilter
from imgcal.monitoring.shaking import ShakeLevel
from imgcal.monitoring.unsynchronized_cameras import drop_cameras
from imgcal.types import CameraRig, Observations

FEW_SNAPSHOTS = 16
"""With at most this many snapshots before a change, the earlier knowledge is unreliable: it bends by more than its
stated uncertainty, and the wrong camera would be blamed. It is then forgotten ..."""
OBJECT_SNAPSHOTS = 8
"""... and a change of the object is not considered before this many snapshots have been absorbed."""
LOOSENED, MOST_TESTED, LOOSE_ODDS = (16, 32, 64, 128, 200), 2**13, 5.0
"""Numbers of first snapshots after which an object is tested for errors that its file does not state, the largest
number of labels that they may have, and the log odds at which it has some."""
OTHER_WEIGHTS = 0.8
"""Ratio of the labels' standard deviations, after errors seem to be independent to before, below which the usual fit of
snapshots is measured anew."""
UNDECIDED_SNAPSHOTS = 16
"""Snapshots for which a camera stays in doubt that seemed to have moved without a decision."""
NEW_SHARE = 0.25
"""Share of the snapshots since a change that must be new before an undecided camera is weighed again."""
WRONG_LABEL, LEAST_BEFORE = 10.0, 2
"""Standard deviations beyond which a label is wrong, and fewest snapshots of a camera before its change: where hardly
anything is known yet, wrong labels in its first snapshots, for example of half-hidden markers, look like a move."""
RECENT_MOVE, LEAST_AGAIN = 16, 8
"""A second move of a camera within the first number of snapshots is doubted, and takes the second to decide: a late
camera seems to have moved in any two successive snapshots, but not in eight."""

FADED = 0.5
"""An image in quarantine that is off by less than this share of its first shift has an error that is passing. A camera
that rolled may be off by as little elsewhere in its image: this only delays the decision by an episode."""


@dataclass(frozen=True)
class MonitorUpdate:
    """The result of a snapshot's update, and the changes found with it."""

    update: MeasurementUpdate  # with the pose (1,) and the residual (1, C, N, 2) of the latest snapshot
    changes: tuple[Change, ...] = ()  # of cameras: first detected, later with their kind
    slips: tuple[ClockSlip, ...] = ()
    unsynchronized: tuple[int, ...] = ()  # unsynchronized cameras
    object_change: ObjectChange | None = None
    restarted: bool = False  # the knowledge before a change was discarded
    learnt: bool = True  # False: the object has rested for so long that the snapshot says nothing new


class RigMonitor:
    """A `RigFilter` whose cameras may be bumped.

    Examples:
        >>> import imgcal
        >>> monitor = RigMonitor(RigFilter(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")))
        >>> monitor.filter.count, monitor.open
        (0, {})
    """

    STATE: ClassVar = {
        "filter": ("filter", RigFilter),
        "open_changes": ("open", dict[int, Change]),
        "undecided": ("undecided", dict[int, int]),
        "quarantine": ("quarantine", Quarantine),
        "shaking": ("shaking", ShakeLevel),
        "known_since": ("known_since", int),
        "diagnosis": ("_diagnosis", Diagnosis),
        "misfit": ("_misfit", Misfit),
        "noise": ("noise", NoiseCorrelation),
        "rest": ("rest", Rest),
        "recent": ("_recent", RecentSnapshots),
        "drifting": ("_drifting", DriftLearning),
        "pending": ("_pending", PendingChange | None),
        "prior": ("_prior", RigBelief),
        "moved_early": ("_moved_early", set[int]),
        "moved_at": ("_moved_at", dict[int, int]),
        "suspect": ("_suspect", int | None),
    }

    def __init__(self, rig_filter: RigFilter) -> None:
        """Monitor a filter; from now on, only this monitor may update it."""
        self.filter = rig_filter
        self.open: dict[int, Change] = {}  # changes of a still undecided kind, by camera
        self.undecided: dict[int, int] = {}  # cameras in doubt, and their remaining snapshots
        self.quarantine = Quarantine()  # cameras that see the object in the wrong place
        self.shaking = ShakeLevel(rig_filter.belief.rig.num_cameras)
        self.known_since = 0  # number of the first snapshot that counts
        self._diagnosis = Diagnosis()
        self._misfit = Misfit()
        self.noise = NoiseCorrelation(rig_filter.belief.rig.num_cameras)
        self.rest = Rest()
        self._recent = RecentSnapshots(rig_filter.belief, rig_filter.walk)
        self._drifting = DriftLearning(DriftPaces(rig_filter.belief.rig.num_cameras))
        self._pending: PendingChange | None = None
        self._prior = rig_filter.belief
        self._moved_early: set[int] = set()  # cameras that have left their factory poses
        self._moved_at: dict[int, int] = {}  # filter count at the last reported move
        self._suspect: int | None = None  # the camera that caused the last snapshot to be refused

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
            seconds: since the previous update.
            moved: cameras that are known to have moved before this snapshot, by any distance.

        Returns:
            The update, and the changes found.

        Raises:
            RefusedError: see `absorb`. If a single camera prevents a minimum, the snapshot is refused once; if the next
                snapshot agrees, that camera has moved.
        """
        self.undecided = {camera: left - 1 for camera, left in self.undecided.items() if left > 1}
        given = observations
        self.noise.pass_time(seconds)
        horizon = None if self.filter.horizon is None else self.filter.horizon.snapshots
        least = self.rest.widen(observations, self.filter.belief.pose_freedom <= POSE_PARAMETERS, horizon)
        if self.rest.says_nothing(seconds, horizon) and not (moved or self.quarantine.cameras):
            result = absorb(self.filter.belief, observations, rig_from_object, self.filter.options)
            return MonitorUpdate(replace(result, belief=self.filter.belief), learnt=False)
        seconds = self.rest.pause()
        if self.filter.calibrated or horizon is None:  # within a horizon, errors do not add up
            self.noise.expect_usual(self.filter.calibrated)
        observations = self.noise.weigh(self.shaking.apply_to(observations), least)
        new = [camera for camera in moved if camera not in self.quarantine.cameras]
        if new:
            self.quarantine.add(new, self._is_new())
        known_since = self.known_since
        follow = self._follow_beside_quarantine if self.quarantine.cameras else self._follow
        found = follow(observations, rig_from_object, seconds)
        found = replace(found, update=found.update.of_last(), restarted=self.known_since != known_since)
        self.noise.settle({*(change.camera for change in found.changes), *(slip.camera for slip in found.slips)})
        if not (found.changes or self.open or found.slips or found.object_change):
            self._follow_noise(drop_cameras(given, self.quarantine.cameras), found.update.residual)
        return found

    def _follow_noise(self, observations: Observations, residual: Tensor) -> None:
        """Update shake levels and error correlation times from a snapshot without suspicion."""
        if not self.rest.began:  # the errors of a rest are not those of other snapshots
            return
        self.shaking.observe(observations, residual)
        before, assumed = self.noise.time, self.noise.assumed_time
        self.noise.add(observations, residual)
        if self.noise.time is not before:
            self._recent.lasting = self.noise.model_error
            ratio = (self.noise.assumed_time / assumed).sqrt()
            self.filter.rescale(ratio)
            if float(ratio.min()) < OTHER_WEIGHTS and not self.filter.calibrated:
                self._misfit = (
                    Misfit()
                )  # how well the earlier snapshots fitted is no measure for those with more weight

    def seen_points(self, camera: int) -> Tensor:
        """Where a camera has lately seen fiducials or lights: (P, 3) mm in the rig's frame."""
        latest, _ = self._recent.latest(len(self._recent))
        shown = [one for one in latest if bool(one[0].seen[0, camera].any())]
        belief = self.filter.belief
        found = [belief.points_at(pose)[0][seen.seen[0, camera]] for seen, pose in shown]
        return torch.cat(found) if found else belief.points_object[:0]

    def _is_new(self, age: int = 0) -> bool:
        """Tell whether hardly anything was known about the rig before the latest `age` snapshots."""
        return self.filter.learnt_since(self.known_since) - age < FEW_SNAPSHOTS

    def _follow(self, observations: Observations, rig_from_object: RigidTransform, seconds: float) -> MonitorUpdate:
        """Learn from a snapshot, and test for a change before it; raises as `update`."""
        try:
            result = self.filter.follow(observations, rig_from_object, seconds)
        except RefusedError:
            last, belief = self._suspect, self.filter.belief
            self._suspect = contradicting_camera(belief, observations, rig_from_object, self.filter.options)
            if last is None or last != self._suspect:
                raise
            self.quarantine.add((last,), self._is_new())
            self._suspect = None
            return self._follow_beside_quarantine(observations, rig_from_object, seconds)
        self._suspect = None
        if self.filter.horizon is not None and self.filter.horizon.snapshots == 1:
            self._recent.clear()
        self._recent.append(result, observations, seconds)
        if self._pending is not None:
            self._pending.add(result, seconds)
        alarm = find_alarm(self._recent, self.filter.count, self.noise.episode, self.noise.least_shifts)
        misfit = self._misfit.update(result.chi2, result.dof)
        if alarm is None and misfit and self._pending is None and (anew := self._diagnose_misfit(misfit)) is not None:
            return anew
        changes: list[Change] = []
        if alarm is not None:
            with contextlib.suppress(RefusedError):  # undecided: test again with the next snapshot
                anew = self._diagnose_alarm(alarm, changes)
                self.undecided = {}
                return replace(anew, changes=(*changes, *anew.changes))
        if self.filter.due:
            result = self.filter.relinearize()
            self._recent.relinearize(result)
            if (anew := self._diagnose_first_misfit(result)) is not None:
                return replace(anew, changes=tuple(changes))
            result = self._loosen_object(result)
            if self._pending is not None:
                self._begin_pending(result, self._pending.before, self._pending.seconds, self._pending.kinds)
        quiet, busy = self._pending is None and alarm is None, bool(slow_tests(self._recent, self.filter.count))
        self._drifting.update(self.filter, self._recent, seconds, quiet, busy)
        if self._pending is not None and self._pending.due:
            changes += self._decide_kinds(self._pending.overdue)
        return MonitorUpdate(result, tuple(changes))

    def _follow_beside_quarantine(
        self, observations: Observations, rig_from_object: RigidTransform, seconds: float
    ) -> MonitorUpdate:
        """Learn from a snapshot without the cameras in quarantine, and diagnose those.

        Raises:
            RefusedError: see `update`.
        """
        quarantine, cameras = self.quarantine, set(self.quarantine.cameras)
        found = self._follow(drop_cameras(observations, cameras), rig_from_object, seconds)
        if not quarantine.cameras or quarantine.cameras != cameras:  # new ones have seen it already
            return found
        snapshot, belief = (observations, found.update.rig_from_object[-1:]), found.update.belief
        shifts = {camera: _shift(belief, snapshot, camera) for camera in cameras}
        episode = min(self.noise.episode(camera, shift) for camera, shift in shifts.items())
        begins = any(self._error_begins(belief, camera, shift) for camera, shift in shifts.items())
        if begins or any(self._error_fades(belief, camera, shift, episode) for camera, shift in shifts.items()):
            quarantine.expect_passing()
        if quarantine.observe(observations, seconds, episode):
            with contextlib.suppress(RefusedError):  # undecided, or they do not see enough
                found = self._diagnose_quarantine(found)
        return replace(found, unsynchronized=quarantine.report_unsynchronized())

    def _error_begins(self, belief: RigBelief, camera: int, shift: float) -> bool:
        """Tell whether a camera in quarantine, `shift` pixels off now, saw the object in its place last time."""
        least = self.noise.least_shifts[camera]
        if shift < least:
            return False
        return any(earlier < least for earlier in self._earlier_shifts(belief, camera, 1))

    def _error_fades(self, belief: RigBelief, camera: int, shift: float, episode: int) -> bool:
        """Tell whether an image is off by much less than at first when an episode ends; a moved camera's stays off."""
        quarantine = self.quarantine
        if not quarantine.passing or quarantine.snapshots < episode or shift < self.noise.least_shifts[camera]:
            return False
        earlier = self._earlier_shifts(belief, camera, episode)
        return bool(earlier) and shift < FADED * median_high(earlier[len(earlier) // 2 :])

    def _earlier_shifts(self, belief: RigBelief, camera: int, most: int) -> list[float]:
        """Shifts (px) of a camera in quarantine when it last saw the object, the latest first."""
        poses = [pose for _, pose in self._recent.latest(len(self._recent))[0]]
        earlier = zip(reversed(self.quarantine.seen), reversed(poses[:-1]), strict=False)
        shown = (snapshot for snapshot in earlier if bool(snapshot[0].seen[0, camera].any()))
        return [_shift(belief, snapshot, camera) for snapshot in islice(shown, most)]

    def _shifted_cameras(self, case: Case, lasted: int) -> tuple[int, ...]:
        """Suspected cameras whose images are shifted by clearly more than errors that last for so many snapshots."""
        found, least = [], self.noise.least_shifts
        for camera in case.cameras:
            seen = [one for one in case.latest if bool(one[0].seen[0, camera].any())]
            shifts = [_shift(case.before, snapshot, camera) for snapshot in seen]
            shift = median_low(shifts) if shifts else 0.0  # of two, both must be shifted
            if shift >= least[camera] and self.noise.episode(camera, shift) <= max(lasted, 1):
                found.append(camera)
        return tuple(found)

    def _diagnose_quarantine(self, found: MonitorUpdate) -> MonitorUpdate:
        """Diagnose the cameras in quarantine, and relearn them if they have moved.

        Raises:
            RefusedError: the case cannot be decided yet, or the cameras do not see enough.
        """
        quarantine = self.quarantine
        case = quarantine.case(self._recent, self.filter.options, self.noise.correlated)
        case = replace(case, beginning=self._beginning)
        quarantine.unsynchronized = False
        verdict = self._diagnosis.decide(case, patient=self._pending is None)
        quarantine.unsynchronized = bool(verdict.best.finding.unsynchronized)
        if quarantine.unsynchronized:
            return found
        lasted = quarantine.snapshots
        quarantine.release()
        if verdict.harmless and self._pending is None:
            # The belief allows for it, so learn it like any other snapshot. Otherwise the question would never be
            # settled.
            quiet = verdict.explained[Steady.name]
            return MonitorUpdate(self._restart(quiet.before, quiet.snapshots, case.pauses[-case.count :]))
        shifted = self._shifted_cameras(case, lasted)
        if verdict.best.name == Moved.name and shifted:
            decided = self._decide_kinds(last=True)
            anew = self._learn_moved(case, dict.fromkeys(shifted), JUMPS[-1], sum(case.pauses[-case.count :]))
            return replace(anew, changes=(*found.changes, *decided, *anew.changes))
        if verdict.best.name == LensMisfit.name:
            best = verdict.best
            return MonitorUpdate(self._restart(best.before, best.snapshots, case.pauses[-case.count :]), found.changes)
        if verdict.best.finding.slips and len(verdict.best.snapshots) > case.count:  # late from the beginning
            return replace(self._adopt(case, verdict), changes=found.changes)
        return replace(found, slips=tuple(slip for slip in self._clock_slips(verdict) if slip.camera in shifted))

    def _diagnose_alarm(self, age: int, changes: list[Change]) -> MonitorUpdate:
        """Diagnose what has happened before the latest snapshots, since which cameras seem to have changed.

        Args:
            age: number of these snapshots.
            changes: changes decided on the way are appended.

        Raises:
            RefusedError: the case cannot be decided yet, or the snapshots cannot be learned.
        """
        free: dict[int, str | None] = {}
        pending, camera = self._pending, likeliest_camera(self._recent.test(age))
        new = UNDECIDED_SNAPSHOTS - self.undecided.get(camera, 0)  # snapshots since it was weighed
        if new < NEW_SHARE * age and self._diagnosis.skip():
            raise RefusedError("diagnosis: undecided, and little is new")
        age = likeliest_age(self._recent, camera, age)
        if pending is not None and age >= pending.count - NEARBY_SNAPSHOTS:  # the pending changes happened then
            again = likeliest_camera(self._recent.test(age)) in pending.kinds
            # A second change: the first snapshots were taken from the old pose.
            age = age if again else min(pending.count, len(self._recent))
            before, seconds, free = pending.before, pending.seconds, dict(pending.kinds)
        else:
            changes += self._decide_kinds(last=True)
            before, seconds = self._recent.belief_before(age), self._recent.seconds(age)
        excluded = {Steady.name: "a test of every camera has excluded it"}
        if pending is not None and free:
            excluded[ObjectChanged.name] = "a change of a camera is pending"
        free, evidence = changed_cameras(self._recent, age, free, self.noise.episode, self.noise.least_shifts)
        self.undecided |= dict.fromkeys(free, UNDECIDED_SNAPSHOTS)
        if self._is_new(age):
            excluded[ObjectChanged.name] = "too little was known before"
        case = self._case(before, age, tuple(free), excluded)
        verdict = self._diagnosis.decide(case, patient=self._pending is None)
        if verdict.best.name != Moved.name:
            return self._adopt(case, verdict)
        restless = [camera for camera in free if camera not in self.open and self._moved_lately(camera)]
        if restless and self._pending is None and self.filter.horizon is None:
            return self._doubt(case, restless)
        return self._learn_moved(case, free, LARGE, seconds, evidence)

    def _moved_lately(self, camera: int) -> bool:
        """Tell whether a move of a camera was reported recently."""
        return camera in self._moved_at and self.filter.count - self._moved_at[camera] < RECENT_MOVE

    def _doubt(self, case: Case, cameras: Sequence[int]) -> MonitorUpdate:
        """Quarantine cameras that seem to move again and again: two snapshots cannot tell why, eight can.

        Raises:
            RefusedError: see `absorb`; the monitor is unchanged.
        """
        new, pauses = self._is_new(case.count), case.pauses[-case.count :]
        anywhere = dict.fromkeys(cameras)
        before = free_cameras(case.before, anywhere, JUMPS[-1])
        if new:
            before = self._factory_with_free(self._moved_early | set(cameras))
        result = self._restart(before, [(drop_cameras(one, cameras), pose) for one, pose in case.latest], pauses)
        if new:
            self.known_since = self.filter.count - case.count
        self.quarantine.add_unsynchronized(case.latest, pauses, cameras, uncertain=True, least=LEAST_AGAIN)
        return MonitorUpdate(result)

    def _case(self, before: RigBelief, age: int, cameras: tuple[int, ...], excluded: Mapping[str, str]) -> Case:
        """Make a case of cameras that seem to have moved before the latest `age` snapshots."""
        return Case(
            before, *self._recent.latest(len(self._recent)), age, self.filter.options, cameras,
            lasting=self.noise.correlated, beginning=self._beginning, excluded=excluded,
        )  # fmt: skip

    @property
    def _beginning(self) -> RigBelief | None:
        """What the factory says, where the latest snapshots are all that is known beside it."""
        everything = self.filter.count - self.known_since == len(self._recent)
        return self._factory_with_free(self._moved_early) if everything else None

    def _adopt(self, case: Case, verdict: Verdict, new: bool = False) -> MonitorUpdate:
        """Learn a case's snapshots again by the best explanation; `new`: the filter has not absorbed them before.

        Raises:
            RefusedError: see `absorb`.
        """
        best, count = verdict.best, len(verdict.best.snapshots)
        pauses, finding = case.pauses[-count:], best.finding
        result = self._restart(best.before, best.snapshots, pauses, new)
        self.open, self._pending = {}, None
        if finding.shake is not None:
            self.shaking.believe(finding.shake)
        if finding.unsynchronized:
            snapshots, uncertain = case.snapshots[-count:], self._is_new(count)
            self.quarantine.add_unsynchronized(snapshots, pauses, finding.unsynchronized, uncertain)
        change = finding.object_change
        if change is not None:
            change = replace(change, since=self.filter.count - count, odds=verdict.lead)
        return MonitorUpdate(result, slips=self._clock_slips(verdict), object_change=change)

    def _clock_slips(self, verdict: Verdict) -> tuple[ClockSlip, ...]:
        """Clock slips that a verdict has found in the latest snapshots."""
        since = self.filter.count - len(verdict.best.snapshots)
        return tuple(replace(slip, since=since, odds=verdict.lead) for slip in verdict.best.finding.slips)

    def _learn_moved(
        self,
        case: Case,
        free: Mapping[int, str | None],
        jump: float,
        seconds: float,
        evidence: Mapping[int, float] = MappingProxyType({}),
    ) -> MonitorUpdate:
        """Learn a case's latest snapshots again, with cameras that moved before them.

        If hardly anything was known before, only the factory calibration is kept from that time, and a camera that saw
        too little then, or whose labels did not fit, has not moved, unless it is turned far. If that is true of all,
        only their earlier labels are forgotten.

        Args:
            case: the snapshots and the belief before them.
            free: the cameras, and how they moved (None = in any way).
            jump: pixels by which they may have moved.
            seconds: since the previous snapshot.
            evidence: chi-squared of "it has not moved", by camera.

        Raises:
            RefusedError: see `absorb`; the monitor is unchanged.
        """
        forget, nan, horizon = self._is_new(case.count), math.nan, self.filter.horizon
        anywhere = forget or jump == JUMPS[-1]
        placed = resect_cameras(case.before, case.latest, free) if anywhere else case.before.rig
        if forget and horizon is None and not self.filter.calibrated:
            far = have_turned_far(case.before.rig, placed)
            misfit = {camera for camera in _misfit_cameras(case) if not far[camera]}
            free = {camera: kind for camera, kind in free.items() if camera not in misfit}
            if not free and self._beginning is not None:  # nothing moved: forget the wrong labels only
                earlier = [(drop_cameras(one, misfit), pose) for one, pose in case.snapshots[: -case.count]]
                return MonitorUpdate(self._restart(self._beginning, [*earlier, *case.latest], case.pauses))
        early = self._moved_early | free.keys()
        before = place_cameras(case.before, placed, free)
        if not forget and (unknown := self._hardly_seen(case, free)):
            before = free_cameras(before, dict.fromkeys(unknown), JUMPS[-1])
            free = {camera: kind for camera, kind in free.items() if camera not in unknown}
            if not free:
                return MonitorUpdate(self._restart(before, case.latest, case.pauses[-case.count :]))
        before = self._factory_with_free(early, placed) if forget else free_cameras(before, free, jump)
        result = self._restart(before, case.latest, case.pauses[-case.count :])
        if horizon is not None:
            self._moved_early = early
            horizon.free(self._factory_with_free(early, placed), free)
        number, new = self.filter.count - case.count, dict[int, Change]()
        for camera, kind in free.items():
            if forget or (kind is None and camera not in self.open):
                since = self.open[camera].since if camera in self.open else number
                new[camera] = Change(camera, since, "unknown", nan, nan, forget, evidence.get(camera, nan))
        if forget:
            self._moved_early, self.known_since = early, number
            self.open, self._pending, self._suspect = {}, None, None
        else:
            self.open |= new
            self._begin_pending(result, case.before, seconds, dict(free))
        self._moved_at |= dict.fromkeys(new, self.filter.count)
        return MonitorUpdate(result, tuple(new.values()))

    def _hardly_seen(self, case: Case, cameras: Collection[int]) -> list[int]:
        """Cameras that saw the object before a case's latest snapshots for no longer than an error may last.

        Their first labels may have been off, so they need not have moved since. A calibrated rig's are known.
        """
        if self.filter.calibrated or self.filter.horizon is not None:
            return []
        shown = torch.stack([one.seen[0].any(-1) for one, _ in case.latest]).sum(0)
        before, episodes = (self.filter.shown - shown).tolist(), self.noise.episodes
        return [camera for camera in sorted(cameras) if episodes[camera] > 1 and before[camera] <= episodes[camera]]

    def _factory_with_free(self, cameras: Collection[int], rig: CameraRig | None = None) -> RigBelief:
        """The factory calibration with some cameras unconstrained, where they are turned far in a rig (None = now)."""
        placed = place_cameras(self._prior, self.filter.belief.rig if rig is None else rig, cameras)
        return free_cameras(placed, dict.fromkeys(sorted(cameras)), JUMPS[-1])

    def _begin_pending(
        self, result: MeasurementUpdate, before: RigBelief, seconds: float, kinds: dict[int, str | None]
    ) -> None:
        """Wait until the kinds of changes can be decided, but not beyond the horizon: no more evidence comes then."""
        self._pending = PendingChange.of(result, before, seconds, kinds)
        if self.filter.horizon is not None:
            self._pending.most = min(self._pending.most, self.filter.horizon.snapshots)

    def _restart(
        self, before: RigBelief, snapshots: Sequence[Snapshot], pauses: Sequence[float], new: bool = False
    ) -> MeasurementUpdate:
        """Restart the filter with its latest snapshots; `new`: it has not absorbed them before.

        Raises:
            RefusedError: see `absorb`; the monitor is unchanged.
        """
        result = self.filter.restart(before, snapshots, new=len(snapshots) if new else 0)
        self._replace_recent(snapshots, pauses, result)
        return result

    def _replace_recent(
        self, snapshots: Sequence[Snapshot], pauses: Sequence[float], result: MeasurementUpdate
    ) -> None:
        """Begin the recent snapshots anew, with some and their joint update."""
        self._recent = RecentSnapshots(result.belief, self.filter.walk, self.noise.model_error)
        self._recent.replace(snapshots, pauses, result)

    def _diagnose_misfit(self, age: int) -> MonitorUpdate | None:
        """Learn the object again if it has changed and the latest snapshots therefore fit worse."""
        age = min(age, len(self._recent))
        if self.filter.learnt_since(self.known_since) - age >= OBJECT_SNAPSHOTS:
            with contextlib.suppress(RefusedError):  # nothing was known about the rig
                return self._adopt_object(self._recent.belief_before(age), *self._recent.latest(age))
        return None

    def _diagnose_first_misfit(self, result: MeasurementUpdate) -> MonitorUpdate | None:
        """Learn the object again if it never matched its file and the first snapshots therefore do not fit."""
        count = self.filter.count
        first = not self.known_since and self._pending is None and len(self._recent) == count
        if not first or not has_never_fitted(result, count):
            return None
        return self._adopt_object(self._prior, *self._recent.latest(count))

    def _loosen_object(self, result: MeasurementUpdate) -> MeasurementUpdate:
        """Give an object that was taken as exact the usual tolerance if its first snapshots, `result`, show errors.

        What is learned from errors of the object that nothing allows for is certain and wrong.
        """
        first, kept = self._prior, len(result.brought)
        everything = not self.known_since and self._pending is None and self.filter.count == kept
        if self.filter.calibrated or self.filter.horizon is not None or not everything or kept not in LOOSENED:
            return result
        obj, labels = first.obj, kept * first.rig.num_cameras * first.obj.num_fiducials
        if obj.unknown_markers or not obj.exact or obj.num_fiducials > PRINT_FIDUCIALS or labels > MOST_TESTED:
            return result
        loose = free_object(first, SHAPE, ALL_MM)
        with contextlib.suppress(RefusedError):
            free = self.filter.absorb_kept(loose)
            if free.evidence - result.evidence > LOOSE_ODDS:
                self._prior = loose
                result = self.filter.begin_with(loose, free)
                self._replace_recent(*self._recent.latest(len(self._recent)), result)
        return result

    def diagnose_object(
        self, snapshots: Sequence[Snapshot], pauses: Sequence[float], learnt: bool
    ) -> MonitorUpdate | None:
        """Diagnose whether labels do not fit because the object has changed, and learn it again if so.

        Args:
            snapshots: the latest ones, with those labels.
            pauses: s before each of them.
            learnt: the snapshots were absorbed without those labels; otherwise not at all.

        Returns:
            The update and the change of the object; None = the object has not changed.
        """
        if self._pending is not None or (learnt and len(self._recent) < len(snapshots)):
            return None
        found = None
        with contextlib.suppress(RefusedError):  # nothing was known about the rig
            if learnt:
                before = self._recent.belief_before(len(snapshots))
            else:
                before = age_belief(self.filter.belief, self.filter.waited + pauses[0], self.filter.walk)
            found = self._adopt_object(before, snapshots, pauses, new=not learnt)
        return None if found is None else replace(found, update=found.update.of_last())

    def quarantine_doubtful(self, snapshots: Sequence[Snapshot], pauses: Sequence[float]) -> tuple[int, ...]:
        """Quarantine the cameras because of which labels no longer fit in most cameras.

        Args:
            snapshots: the latest ones, with those labels; not absorbed.
            pauses: s before each of them.

        Returns:
            The newly quarantined cameras.
        """
        if self._pending is not None:
            return ()
        before = age_belief(self.filter.belief, self.filter.waited + pauses[0], self.filter.walk)
        try:
            found, sure = doubtful_cameras(before, snapshots, pauses, self.filter.options)
        except RefusedError:  # nothing explains these snapshots
            return ()
        new = tuple(sorted(set(found) - self.quarantine.cameras))
        if new:
            self.quarantine.add(new, self._is_new())
            self.quarantine.unsynchronized, self.quarantine.seconds = sure, sum(pauses[1:])
        return new

    def have_all_moved(self, snapshots: Sequence[Snapshot], pauses: Sequence[float]) -> bool:
        """Tell whether labels no longer fit in most cameras because these have moved at once.

        Args:
            snapshots: the latest ones, with those labels; not absorbed.
            pauses: s before each of them.
        """
        before = age_belief(self.filter.belief, self.filter.waited + pauses[0], self.filter.walk)
        with contextlib.suppress(RefusedError):  # nothing explains these snapshots
            return explained_by_moves(before, snapshots, pauses, self.filter.options)
        return False

    def _adopt_object(
        self, before: RigBelief, snapshots: Sequence[Snapshot], pauses: Sequence[float], new: bool = False
    ) -> MonitorUpdate | None:
        """Learn the object again if its change explains some snapshots; `new`: the filter has not absorbed them.

        Returns:
            The update; None = the change does not explain them, or cannot be learned.
        """
        case = Case(before, snapshots, pauses, len(snapshots), self.filter.options)
        with contextlib.suppress(RefusedError):  # nothing explains these snapshots
            if not may_have_changed(case) and weigh(case, (Steady(), Warmed())).best.name == Steady.name:
                return None
            verdict = weigh(case)
            best, sure = verdict.best, Steady.name in verdict.explained and verdict.lead >= MISFIT_LEAD
            if sure and best.name in (ObjectChanged.name, Warmed.name) and not best.explanation.premature(case, best):
                return self._adopt(case, verdict, new)
        return None

    def _decide_kinds(self, last: bool) -> tuple[Change, ...]:
        """Decide the kinds of pending changes where the snapshots since allow it, or it is time."""
        pending = self._pending
        if pending is None:
            return ()
        test = pending.test(self.filter.walk)
        decided, kinds = pending.decide_kinds(test, self.open, last)
        pending.kinds.update(kinds)
        # Snapshots that were linearized while a camera could be anywhere are absorbed again. Where the first of them
        # are no longer kept, there are so many that the camera is well known whatever the kind of its change.
        if any(kind is not None for kind in kinds.values()) and pending.count <= len(self._recent):
            first, belief, information = pending.adopt_kinds(test)
            self._recent.rebase(belief, information)
            with contextlib.suppress(RefusedError):
                belief = self._restart(first, *self._recent.latest(pending.count)).belief
            self.filter.replace_beliefs(first, age_belief(belief, pending.seconds, self.filter.walk))
        self.open = {camera: change for camera, change in self.open.items() if camera not in kinds}
        if not self.open:
            self._pending = None
        return decided


def _misfit_cameras(case: Case) -> set[int]:
    """Cameras that saw too little before a case's latest snapshots, or had wrong labels in half of the earlier ones.

    Raises:
        RefusedError: see `absorb`.
    """
    earlier = case.snapshots[: -case.count]
    if not earlier:
        return set()
    observations, poses = stack_snapshots(earlier)
    before = case.before if case.beginning is None else case.beginning  # nothing has been linearized at wrong labels
    off = absorb(before, observations, poses, case.options).residual.norm(dim=-1)  # (S, C, N)
    wrong = (observations.seen & (off > WRONG_LABEL * observations.sigma)).any(-1).sum(0)
    seeing = observations.seen.any(-1).sum(0)
    return set(torch.nonzero((seeing < LEAST_BEFORE) | (2 * wrong >= seeing)).flatten().tolist())


def _shift(belief: RigBelief, snapshot: Snapshot, camera: int) -> float:
    """Median distance (px), over both axes, between observed and predicted blobs of a camera."""
    observations, pose = snapshot
    seen = observations.seen[0, camera]
    off = (observations.uv[0, camera] - project_fiducials(belief, pose, camera)[0])[seen]
    return float(off.median(0).values.norm()) if len(off) else 0.0
