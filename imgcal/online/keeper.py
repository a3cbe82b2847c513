"""A rig that is kept calibrated: every snapshot is learnt once, what moves is told, and nothing else is forgotten."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import PipelineOptions, Proposer, to_observations
from imgcal.detection import DetectionOptions, Frame
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import Absorbed, Change, ObjectChange, RigBelief, RigFilter, RigMonitor, initial_pose
from imgcal.geometry import RigidTransform
from imgcal.online.clock import ClockOffsets
from imgcal.online.default_tests import default_tests
from imgcal.online.drift_watch import DriftWatch
from imgcal.online.events import Event, snapshot_name
from imgcal.online.following import near_prediction
from imgcal.online.keeper_file import KeeperFile, read_memory, unusable
from imgcal.online.label_checks import Checked, check_labels
from imgcal.online.labelling import LEAST_FOLLOWED, Labelling
from imgcal.online.late_cameras import POSES, in_time, shifted
from imgcal.online.memory import Frozen, require_alike
from imgcal.online.noise_level import NoiseLevel
from imgcal.online.object_doubts import ObjectDoubts
from imgcal.online.relearning import Relearning
from imgcal.online.rig_state import CameraHealth, RigState
from imgcal.online.search import Search, Surroundings
from imgcal.online.sequential_test import SequentialTest
from imgcal.online.sightings import Look, Sightings
from imgcal.pipeline import DetectorName, checked_frames
from imgcal.types import (
    CalibrationObject,
    CameraRig,
    Detections,
    DriftRate,
    Observations,
    RigPrior,
    check_object,
    check_rig,
)

UNUSUAL = 5.0
"""Times as far off as most cameras usually are, from which it is not the cameras but labels or pose that are wrong."""
LEAST_LOOKS = 8
"""Snapshots of a camera, from where it stands, from which its values say where its labels must be."""
PATIENCE = 64
"""Snapshots in a row in which no camera fits: the rig is not the one that is known, and is learnt anew."""
GREATEST_TIME = 2.0**37

REMEMBERED_VALUES = (
    "factory", "obj", "drift", "_prior", "_monitor", "_noise", "_sightings", "_relearning", "_drift_watch", "_doubts",
    "_count", "_learnt", "_times", "_poses", "_labels", "_search", "_usual", "_off", "_looks", "_in_vain",
    "_told_health", "_before", "_pending", "_time",
)  # fmt: skip
"""Attributes of a keeper that are saved."""


@dataclass(frozen=True)
class _Labelled:
    """A snapshot with labels."""

    checked: Checked
    astray: frozenset[int]  # cameras that see what may be the object, and cannot tell what


class RigKeeper:
    """Keeps a rig calibrated over time, in constant memory. A context manager: leaving it ends its threads.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> blobs = true_detections(truth)
        >>> with imgcal.RigKeeper(factory, obj) as keeper:
        ...     for snapshot in range(4):
        ...         state = keeper.update(blobs.of_snapshots(snapshot, snapshot + 1), time=snapshot / 60)
        >>> state.sentence, state.events
        ('all 4 cameras are calibrated', ())
    """

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        options: PipelineOptions = PipelineOptions(),
        *,
        detection: DetectionOptions = DetectionOptions(),
        detector: DetectorName | Proposer = "classical",
        drift: DriftRate | None = None,
        tests: Sequence[SequentialTest] | None = None,
    ) -> None:
        """Start from a factory calibration.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object.
            options: how sure labels must be, and how to minimize.
            detection: how blobs are found.
            detector: who finds the fiducials in frames, as for `calibrate`.
            drift: how fast values wander; None = as the rig says.
            tests: what else watches each snapshot; None = `default_tests`.
        """
        rig = rig.to(torch.float64)
        self.factory, self.obj, self.options, self.drift = rig, obj, replace(options, blind_cameras=True), drift
        self.tests = tuple(default_tests(rig.num_cameras) if tests is None else tests)
        self._clock = next(
            (test for test in self.tests if isinstance(test, ClockOffsets)), ClockOffsets(rig.num_cameras)
        )
        self._prior = rig  # what the filter began with
        self._labelling = Labelling(rig, obj, self.options, detection, detector)
        self._monitor = self._begun()
        self._noise = NoiseLevel(rig, obj, self.options)
        self._sightings = Sightings(rig.camera_names)
        self._relearning = Relearning(rig.camera_names)
        self._drift_watch = DriftWatch(rig.camera_names)
        self._doubts = ObjectDoubts(obj.num_fiducials)
        self._count = 0
        self._learnt: float | None = None  # s, time of the last snapshot that was learnt
        self._times: deque[tuple[int, float]] = deque(maxlen=512)  # number in the filter and time of snapshots
        self._poses: deque[tuple[float, RigidTransform]] = deque(maxlen=POSES)  # (1,) of the last snapshots
        self._labels = 0  # of the last snapshot
        self._search = Search(rig.num_cameras)
        self._usual: deque[float] = deque(maxlen=64)  # px
        self._off: dict[int, float] = {}  # cameras that did not fit in the last snapshot -> since when
        self._looks = np.zeros(rig.num_cameras, dtype=np.int64)  # snapshots learnt from each camera where it stands
        self._in_vain = 0  # snapshots in a row in which no camera fits
        self._told_health: dict[int, CameraHealth] = {}  # by tests
        self._before = self._monitor.filter.belief  # a belief from before what is being decided
        self._pending: list[Event] = []
        self._time = 0.0

    def __enter__(self) -> RigKeeper:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the threads."""
        self._labelling.close()

    @property
    def belief(self) -> RigBelief:
        """What is known of the rig now."""
        return self._monitor.filter.belief

    @property
    def noise(self) -> float:
        """Noise (px, one standard deviation) that blobs have shown beyond what they say of themselves."""
        return self._noise.additive

    def update(self, source: Mapping[str, Frame | None] | Detections, time: float) -> RigState:
        """Learn from a snapshot.

        Args:
            source: frames by camera, (H, W), None = no frame; or blobs that were found elsewhere, labelled or not.
            time: s since the epoch. A time before the last one counts as the same time.

        Returns:
            What is known now. A snapshot that cannot decide teaches nothing: `refused` says why.

        Raises:
            InputError: a frame is no grey image, of another size than the rig says, or of a camera that the rig does
                not have; blobs of more than one snapshot; a time that is none.
        """
        if not (math.isfinite(time) and 0 <= time <= GREATEST_TIME):
            raise InputError(f"time: found {time!r}, expected seconds since the epoch")
        source = source if isinstance(source, Detections) else checked_frames(source, self._labelling.rig)
        detections = self._labelling.blobs(source, snapshot_name(self._count))
        frames = None if isinstance(source, Detections) else source
        self._count, self._time = self._count + 1, time
        lag = self._lag(detections)
        rows = np.flatnonzero(detections.usable & np.isfinite(lag).all(1))
        labelled, result, refused = None, None, None
        shown = replace(detections, fiducial=np.full(len(detections), -1, dtype=np.int64))
        try:
            usable = detections.select(rows)
            labelled = self._labelled(
                shifted(usable, lag[rows], self._clock.late), detections.snapshot_names[0], frames
            )
            found = labelled.checked.blobs
            if len(found) != len(rows):  # those of a proposer
                shown, lag = found, np.zeros((len(found), 2))
            else:
                shown.fiducial[rows] = found.fiducial
                if self._clock.late.any():  # the object's pose is known now
                    lag = self._lag(shown, (time, labelled.checked.rig_from_object))
                    found = shifted(shown.select(rows), lag[rows], self._clock.late)
                    labelled = replace(labelled, checked=replace(labelled.checked, blobs=found))
            result, changes = self._learn(labelled, time)
        except RefusedError as reason:
            self._labelling.follows, refused = False, str(reason)
        events, self._pending = self._pending, []
        if labelled is not None and result is not None:
            events += self._told(changes, time)
            if self._monitor.object_change is not None:
                events.append(self._told_object(self._monitor.object_change, time))
        state = self._state(shown, lag, result, refused)
        return self._concluded(state, frames, labelled, result, events)

    def saved(self, progress: dict[str, Any] | None = None) -> KeeperFile:
        """Take down all that is known, within milliseconds; the result can be written while the keeper goes on.

        Args:
            progress: what else is to be found in the file, in the same step: how far a source has been worked on.
        """
        memory = {
            "values": {name: getattr(self, name) for name in REMEMBERED_VALUES},
            "labelling": self._labelling.saved(),
            "tests": {test.name: test.saved() for test in self.tests},
        }
        health = self._health()
        learnt = self._monitor.filter.count
        return KeeperFile(
            time=self._time,
            snapshot=self._count - 1,
            sentence=_sentence(health, learnt),
            cameras={name: str(state) for name, state in health.items()},
            rig=self.belief.rig,
            factory=self.factory,
            obj=self.obj,
            memory=Frozen(memory),
            progress=progress,
        )

    def save(self, path: str | Path) -> None:
        """Write all that is known to a file, in one step: JSON, the part for people first.

        Raises:
            InputError: it cannot be written.
        """
        self.saved().write(path)

    @classmethod
    def restore(
        cls,
        path: str | Path,
        options: PipelineOptions = PipelineOptions(),
        *,
        detection: DetectionOptions = DetectionOptions(),
        detector: DetectorName | Proposer = "classical",
        tests: Sequence[SequentialTest] | None = None,
    ) -> RigKeeper:
        """Go on where `save` was called: the same snapshots give the same states.

        Args:
            path: the file; factory calibration and object stand in it.
            options: as for a new one.
            detection: as for a new one.
            detector: as for a new one.
            tests: as for a new one, those that were saved go on.

        Raises:
            InputError: the file is none of ours, or was changed.
        """
        memory = read_memory(path)
        try:
            values = memory["values"]
            if set(values) != set(REMEMBERED_VALUES):
                raise ValueError("other values than are written here")
            check_rig(values["_prior"])
            check_rig(values["factory"])
            check_object(values["obj"])
            keeper = cls(
                values["_prior"], values["obj"], options, detection=detection, detector=detector,
                drift=values["drift"], tests=tests,
            )  # fmt: skip
            keeper._take(values)
            keeper._labelling.restored(memory["labelling"])
            keeper._labelling.rig = keeper.factory
            for test in keeper.tests:
                if test.name in memory["tests"]:
                    test.restored(memory["tests"][test.name])
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
            raise unusable(path, error) from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        return keeper

    def _take(self, values: dict[str, Any]) -> None:
        """Take over what was remembered.

        Raises:
            ValueError: it does not belong to this rig and object.
        """
        for name in REMEMBERED_VALUES:
            found, fresh = values[name], getattr(self, name)
            if found is not None and fresh is not None and type(found) is not type(fresh):
                raise ValueError(f"{name}: found {type(found).__name__}, expected {type(fresh).__name__}")
            if type(fresh).__module__.startswith("imgcal.") and not isinstance(fresh, RigBelief):
                require_alike(found, fresh, name)
        monitor = values["_monitor"]
        require_alike(monitor.filter, self._monitor.filter, "filter")
        for belief in (monitor.filter.belief, values["_before"]):
            require_alike(belief, self._like(belief), "belief")
            require_alike(belief.rig, self._prior, "rig")
            check_rig(belief.rig)
            if not bool(belief.factor.isfinite().all() & (belief.factor.diagonal() > 0).all()):
                raise ValueError("found a belief that is none")
        if values["_looks"].shape != self._looks.shape:
            raise ValueError("found other cameras")
        vars(self).update(values)
        self._monitor.filter.options = self.options.estimation

    def _like(self, belief: RigBelief) -> RigBelief:
        """A belief of the kind that one from a file must be of: where an exact object has changed, with its shape.

        Raises:
            ValueError: it is about another object.
        """
        if belief.obj.exact == self.obj.exact:
            return self.belief
        check_object(belief.obj)
        if not self.obj.exact or belief.obj.num_fiducials != self.obj.num_fiducials:
            raise ValueError("found a belief about another object")
        return RigBelief.of_prior(self._prior, belief.obj)

    def accept_as_factory(self) -> Event:
        """Make the present rig the factory calibration that motion is told against; what is known stays known.

        Returns:
            The event, which comes with the next state, too.
        """
        self.factory = replace(self.belief.rig, prior=self.factory.prior, drift_rate=self.factory.drift_rate)
        self._labelling.rig = self.factory
        message = "the present rig is the factory calibration from now on"
        self._pending.append(Event(self._time, max(self._count - 1, 0), "factory", message=message))
        return self._pending[-1]

    def _begun(self) -> RigMonitor:
        return RigMonitor(RigFilter(self._prior, self.obj, self.drift, self.options.estimation))

    def _labelled(self, usable: Detections, name: str, frames: Mapping[str, Frame | None] | None) -> _Labelled:
        """Label a snapshot.

        Raises:
            RefusedError: it cannot be told which blob is which, or labels fit in no camera.
        """
        coded = usable.fiducial.copy() if (usable.fiducial >= 0).any() else None
        followed = None if coded is not None else self._followed(usable)
        if followed is not None:
            return followed
        blobs, snapshot = self._labelling.decided(
            usable, name, coded, None if coded is not None else frames, self._known()
        )
        pose = snapshot.rig_from_object
        if pose is None:
            obj = self._object
            pose = initial_pose(to_observations(blobs, self._prior, obj), self.belief.rig, obj)[0]
        checked = self._checked(blobs, pose.reshape(1))
        if checked.usual > self._most_usual() and self._doubts.due and self._asked_object(learnt=False) is not None:
            assert self._monitor.object_change is not None
            self._pending.append(self._told_object(self._monitor.object_change, self._time))
            checked = self._checked(blobs, pose.reshape(1))
        if checked.usual > self._most_usual():
            self._doubts.take_refused(checked, self._time if self._learnt is None else self._learnt, self._time)
            self._in_vain += 1
            if self._in_vain >= PATIENCE:
                self._begin_anew()
            raise RefusedError(
                f"estimation: labels are {checked.usual:.1f} px off in most cameras: labels are wrong, or the whole "
                "rig is another"
            )
        return self._searched(checked)

    def _followed(self, usable: Detections) -> _Labelled | None:
        """Label a snapshot by the last one's pose; None = it cannot be followed."""
        if not self._labelling.follows or self._labelling.slips or not self._poses:
            return None
        pose = self._extrapolated()
        named = replace(usable, fiducial=near_prediction(usable, self._predicted(pose)))
        if (named.fiducial >= 0).sum() < LEAST_FOLLOWED * self._labels:
            return None
        sought = frozenset(self._search.sought)
        try:
            found = self._searched(self._checked(named, pose))
        except RefusedError:
            return None
        few = found.checked.labels < LEAST_FOLLOWED * self._labels
        return None if few or found.astray - sought or found.checked.usual > self._most_usual() else found

    def _lag(self, blobs: Detections, *now: tuple[float, RigidTransform]) -> NDArray[np.float64]:
        """By how much blobs are off where they would have been in time: (M, 2) pixels."""
        return in_time(blobs, self._clock.late, self.belief, [*self._poses, *now], self._time)

    def _extrapolated(self) -> RigidTransform:
        """Where the object should be now: (1,)."""
        last_time, last = self._poses[-1]
        first_time, first = self._poses[-min(2, len(self._poses))]
        share = 0.0 if last_time <= first_time else (self._time - last_time) / (last_time - first_time)
        if not 0.5 < share < 2.0:
            return last
        return RigidTransform(last.rotation, last.translation + share * (last.translation - first.translation))

    def _checked(self, named: Detections, pose: RigidTransform) -> Checked:
        return check_labels(named, self.belief.rig, self._object, pose, self.options)

    def _most_usual(self) -> float:
        """How far off most cameras may be, px."""
        if len(self._usual) < 8:
            return math.inf
        return self.options.identity_error + UNUSUAL * max(float(np.median(self._usual)), self._noise.additive)

    @property
    def _object(self) -> CalibrationObject:
        """The object as it is known now."""
        known = self.belief.obj  # with tolerances, also where an exact one has changed
        return self.obj if known.exact else replace(self.obj.taken_as_exact(), points=self.belief.points_object)

    def _known(self) -> tuple[CameraRig, Tensor] | None:
        """The rig, and with some reserve how well it is known; None = nothing but the factory calibration."""
        there = self._surroundings()
        return None if there is None else (there.rig, there.std)

    def _surroundings(self) -> Surroundings | None:
        if not self._monitor.filter.count:
            return None
        prior = (self._prior.prior or RigPrior()).std(self._prior)
        return Surroundings(self.belief, prior, self._object, self.options)

    def _predicted(self, pose: RigidTransform | None) -> NDArray[np.float64]:
        """Where the rig puts the fiducials: (C, N, 2) pixels."""
        if pose is None:
            return np.full((self._prior.num_cameras, self.obj.num_fiducials, 2), np.nan)
        points = pose.apply(self.belief.points_object)
        uv: NDArray[np.float64] = self.belief.rig.expand(1).project_values(points, self.obj.radius).uv[0].numpy()
        return uv

    def _searched(self, checked: Checked) -> _Labelled:
        """Look for the object in cameras that do not see it where it should be."""
        there = self._surroundings()
        if there is None:
            return _Labelled(checked, frozenset())
        doubted = self._sightings.doubted | self._sightings.lost.keys()
        return _Labelled(*self._search.take(checked, there, self._time, self._count - 1, doubted))

    def _learn(self, labelled: _Labelled, time: float) -> tuple[Absorbed, tuple[Change, ...]]:
        """Absorb a snapshot; what a camera sees that does not fit for the first time waits for the next one."""
        checked, still_open = labelled.checked, self._monitor.open
        off = {
            camera: self._off.get(camera, time)
            for camera in np.flatnonzero(checked.off & (self._looks >= LEAST_LOOKS)).tolist()
        }
        waiting = [camera for camera in off if camera not in self._off and camera not in still_open]
        moved = [camera for camera in off if camera in self._off and camera not in still_open]
        blobs = replace(
            checked.blobs,
            fiducial=np.where(np.isin(checked.blobs.camera, waiting), -1, checked.blobs.fiducial),
        )
        seconds = 0.0 if self._learnt is None else max(time - self._learnt, 0.0)
        observations = self._observations(blobs)
        if not off and not still_open:
            self._before = self.belief
        first = self._monitor.first
        result, changes = self._monitor.update(observations, checked.rig_from_object, seconds, moved)
        if self._monitor.first != first:  # nothing that was known before counts any more
            self._drift_watch = DriftWatch(self._prior.camera_names)
            self._looks[:] = 0
        self._times.append((self._monitor.filter.count - 1, time))
        if changes or self._monitor.open or self._monitor.object_change is not None:
            self._doubts = ObjectDoubts(self.obj.num_fiducials)
        elif self._doubts.take(checked, blobs, seconds, time):
            result = self._asked_object(learnt=True) or result
        self._looks += observations.seen[0].any(-1).numpy()
        self._looks[[change.camera for change in changes]] = 0
        self._off, self._learnt, self._in_vain = off, time, 0
        self._labelling.follow(result.rig_from_object[0])
        if self._monitor.slips:  # poses were off that have been found with blobs of another time
            self._poses.clear()
        self._poses.append((time, result.rig_from_object))
        self._labels = checked.labels
        self._search.learnt(checked.blobs, self._count - 1)
        self._usual.append(checked.usual)
        steady = not (off or changes or self._monitor.open or self._monitor.slips)
        if self._noise.take(blobs, observations, result, steady, self._monitor.filter.count):
            result = self._again(result)
        return result, changes

    def _asked_object(self, learnt: bool) -> Absorbed | None:
        """Ask whether labels do not fit because the object is not as its file says; what was learnt then."""
        doubted = self._doubts.learnt if learnt else self._doubts.refused
        snapshots = [(self._observations(one.blobs), one.rig_from_object) for one in doubted]
        first = self._monitor.filter.count
        result = self._monitor.ask_object(snapshots, [one.seconds for one in doubted], learnt)
        if result is not None and not learnt:
            self._times.extend((first + n, one.time) for n, one in enumerate(doubted))
            self._learnt = doubted[-1].time
        self._doubts.asked(result is not None)
        return result

    def _observations(self, blobs: Detections) -> Observations:
        seen = to_observations(blobs, self._prior, self.obj)
        return replace(seen, sigma=(seen.sigma.square() + self._noise.additive**2).sqrt())

    def _again(self, result: Absorbed) -> Absorbed:
        """Learn the first snapshots again, with the noise that they have shown."""
        monitor = self._begun()
        for blobs, pose in self._noise.first:
            result, _ = monitor.update(self._observations(blobs), pose)
        self._monitor = monitor
        self._doubts = ObjectDoubts(self.obj.num_fiducials)
        return result

    def _begin_anew(self) -> None:
        """Forget everything but the factory calibration."""
        self._monitor, self._in_vain = self._begun(), 0
        self._noise.restart()
        self._usual.clear()
        self._times.clear()
        self._doubts = ObjectDoubts(self.obj.num_fiducials)
        self._off, self._search = {}, Search(self._prior.num_cameras)
        self._looks[:] = 0
        self._relearning = Relearning(self._prior.camera_names)
        self._drift_watch = DriftWatch(self._prior.camera_names)
        message = "no camera is where it was: learning begins again with the factory calibration"
        self._pending.append(Event(self._time, self._count - 1, "restart", message=message))

    def _told(self, changes: tuple[Change, ...], time: float) -> list[Event]:
        """Say what the monitor found."""
        events = []
        for change in changes:
            since = self._since(change.camera, change.since, time)
            told = self._relearning.events.get(change.camera)
            if told is not None and told.change == "unknown" and told.since is not None:  # the same, told again
                since = told.since
            events.append(self._relearning.told(change, since, time, self._count - 1, self._before))
        return events

    def _since(self, camera: int, number: int, time: float) -> float:
        """When it happened to a camera what the monitor found since a snapshot of this number."""
        since = next((t for learnt, t in self._times if learnt >= number), time)
        return self._search.since(camera, min(since, self._off.get(camera, since)))

    def _told_object(self, change: ObjectChange, time: float) -> Event:
        """Say that it is the object that is not as it was."""
        since = next((t for number, t in self._times if number >= change.since), time)
        if change.fiducial is None:
            how = "larger" if change.size > 0 else "smaller"
            message = f"the object is {100 * abs(change.size):.3g} % {how} than its file says: another one"
            values = (100 * change.size, 100 * change.sigma)
            return Event(
                time, self._count - 1, "object_exchanged", None, since, None, *values, None, change.odds, message
            )
        message = (
            f"fiducial {change.fiducial} of the object is {change.size:.3g} +- {change.sigma:.1g} mm from its place"
        )
        size = (change.size, change.sigma)
        return Event(time, self._count - 1, "object_bent", None, since, None, *size, "mm", change.odds, message)

    def _state(
        self, shown: Detections, lag: NDArray[np.float64], result: Absorbed | None, refused: str | None
    ) -> RigState:
        """What is known now, without health and events."""
        pose = None if result is None else result.rig_from_object
        predicted, cameras = self._predicted(pose), self._prior.num_cameras
        residual = np.full(cameras, np.nan)
        rows = np.flatnonzero(shown.fiducial >= 0)
        if len(rows) and pose is not None:
            squared = np.square(predicted[shown.camera[rows], shown.fiducial[rows]] - (shown.uv + lag)[rows]).mean(1)
            count = np.bincount(shown.camera[rows], minlength=cameras)
            total = np.bincount(shown.camera[rows], squared, minlength=cameras)
            residual = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        offset, sigma = self._clock.offsets()
        return RigState(
            time=self._time,
            snapshot=self._count - 1,
            belief=self.belief,
            factory=self.factory,
            cameras=self._health(),
            sentence="",
            refused=refused,
            detections=shown,
            lag=lag,
            predicted=predicted,
            residual=residual,
            rig_from_object=None if pose is None else pose[0],
            events=(),
            clock_offset=offset,
            clock_offset_sigma=sigma,
        )

    def _concluded(
        self,
        state: RigState,
        frames: Mapping[str, Frame | None] | None,
        labelled: _Labelled | None,
        result: Absorbed | None,
        events: list[Event],
    ) -> RigState:
        """Add what became known of cameras, and what is said of them."""
        time, number = state.time, state.snapshot
        names = self._prior.camera_names
        for slip in self._monitor.slips if result is not None else ():
            since = self._since(slip.camera, slip.since, time)
            events += self._clock.slipped(state, slip, since)
            state = replace(state, lag=self._lag(state.detections))
        silent = () if frames is None else (c for c, name in enumerate(names) if frames.get(name) is None)
        astray_ = frozenset() if labelled is None else labelled.astray
        look = Look(time, number, state.detections, state.predicted, astray_, frozenset(silent))
        events += self._sightings.take(state.rig, look)
        events += self._relearning.learnt(self.belief, frozenset(self._monitor.open), time, number)
        if result is not None:
            unsettled = frozenset(self._relearning.events) | frozenset(self._sightings.lost) | frozenset(self._off)
            events += self._drift_watch.take(self.belief, unsettled, time, number)
        for test in self.tests:
            for event in test(state, frames, result):
                events.append(event)
                self._take_health(event)
        health = self._health()
        return replace(
            state, cameras=health, events=tuple(events), sentence=_sentence(health, self._monitor.filter.count)
        )

    def _take_health(self, event: Event) -> None:
        """Remember what a test says of a camera."""
        if event.camera is None:
            return
        camera = self._prior.camera_names.index(event.camera)
        if event.kind in ("dirty", "defocused"):
            self._told_health[camera] = event.kind
        elif event.kind == "camera_lost":
            self._told_health[camera] = "blind"
        elif event.kind in ("clean", "camera_back"):
            self._told_health.pop(camera, None)

    def _health(self) -> dict[str, CameraHealth]:
        found: dict[str, CameraHealth] = {}
        for camera, name in enumerate(self._prior.camera_names):
            if camera in self._sightings.lost:
                found[name] = "lost"
            elif camera not in self._sightings.seen:
                found[name] = "unseen"
            elif camera in self._relearning.events:
                found[name] = "relearning"
            elif camera in self._off or camera in self._sightings.doubted:
                found[name] = "doubtful"
            else:
                found[name] = self._told_health.get(camera, "ok")
        return found


def _sentence(health: Mapping[str, CameraHealth], learnt: int) -> str:
    """Say how a rig is."""
    if not learnt:
        return "the object has not been seen yet"
    said = {
        "lost": "lost",
        "blind": "blind",
        "relearning": "moved, being learnt again",
        "doubtful": "in doubt",
        "dirty": "dirty",
        "defocused": "out of focus",
        "unseen": "not looked at yet",
    }
    parts = []
    for state, words in said.items():
        names = [name for name, found in health.items() if found == state]
        if names:
            parts.append(f"{', '.join(names)} {words}")
    return "; ".join(parts) if parts else f"all {len(health)} cameras are calibrated"
