"""A rig that is kept calibrated: it learns from every snapshot once, reports cameras that move, and forgets nothing."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.association import PipelineOptions, Proposer
from imgcal.detection import DetectionOptions, Frame
from imgcal.errors import InputError, RefusedError
from imgcal.geometry import RigidTransform
from imgcal.medians import median
from imgcal.monitoring import MeasurementUpdate, MonitorUpdate, RigBelief
from imgcal.online.camera_health import camera_health, describe_health, take_health
from imgcal.online.camera_visibility import VisibleObject
from imgcal.online.clock_correction import clock_shifts, shift_blobs
from imgcal.online.clock_offsets import ClockOffsets, unsynchronized_event
from imgcal.online.events import Event, snapshot_name
from imgcal.online.foreign_object import ForeignObject
from imgcal.online.image_quality import ImageQuality
from imgcal.online.keeper_file import KeeperFile, read_state, unusable_error
from imgcal.online.keeper_memory import KeeperMemory
from imgcal.online.labelling import Labelling
from imgcal.online.object_checks import object_event
from imgcal.online.rig_state import RigState
from imgcal.online.sequential_test import SequentialTest
from imgcal.online.snapshot_labels import Labelled, label_snapshot
from imgcal.online.snapshot_update import learn_snapshot
from imgcal.online.state_document import StateWriter
from imgcal.pipeline import DetectorName, check_frames
from imgcal.types import CalibrationObject, CameraRig, Detections, DriftRate

GREATEST_TIME = 2.0**37


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
        horizon: int | None = None,
        tests: Sequence[SequentialTest] | None = None,
    ) -> None:
        """Start from a factory calibration.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object. The markers of a stick, or of several objects, are followed one by one, as
                unknown markers are; where they are recognized, their distances are used, and give the scale.
            options: how certain labels must be, and how to minimize.
            detection: how blobs are found.
            detector: how fiducials are found in frames, as for `calibrate`.
            drift: drift rates; None = as in the rig.
            horizon: number of latest snapshots that count beside the factory calibration; None = all, with weights that
                decrease as the rig may have drifted. A longer horizon is more accurate but slower to follow changes.
                From two on, one and up to a quarter more count at times. A camera that none of the snapshots shows
                keeps its last values.
            tests: other tests of each snapshot; None = for worse images, clock slips, and a different object.
        """
        obj = obj.as_unknown()
        if horizon is not None and horizon < 1:
            raise InputError(f"horizon: found {horizon}, expected at least 1 snapshot")
        if horizon is not None and obj.unknown_markers:
            raise InputError("horizon: with unknown lights, the rig needs all snapshots; leave the horizon out")
        self.options = _for_keeping(options)
        self._memory = KeeperMemory.from_factory(rig, obj, drift, self.options, horizon)
        self.tests: tuple[SequentialTest, ...] = tuple(tests or ())
        if tests is None and not obj.unknown_markers:  # these tests all need a rigid object
            self.tests = (ImageQuality(rig.num_cameras), ClockOffsets(rig.num_cameras), ForeignObject())
        clocks = (test for test in self.tests if isinstance(test, ClockOffsets))
        self._clock = next(clocks, ClockOffsets(rig.num_cameras))
        self._labelling = Labelling(self._memory.factory, obj, self.options, detection, detector)

    def __enter__(self) -> RigKeeper:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the threads."""
        self._labelling.close()

    @property
    def factory(self) -> CameraRig:
        """The factory calibration, relative to which motion is reported."""
        return self._memory.factory

    @property
    def obj(self) -> CalibrationObject:
        """The calibration object, as given."""
        return self._memory.obj

    @property
    def belief(self) -> RigBelief:
        """The current belief about the rig."""
        return self._memory.belief

    @property
    def given(self) -> CameraRig:
        """The factory calibration at the start, even if another one has been accepted since."""
        return self._memory.prior

    @property
    def noise(self) -> float:
        """Noise (px, one standard deviation) of the blobs beyond their own sigmas."""
        return median(self._memory.noise.additive)

    def update(
        self, source: Mapping[str, Frame | None] | Detections, time: float, silent: Collection[str] = ()
    ) -> RigState:
        """Learn from a snapshot.

        Args:
            source: frames by camera, (H, W), None = no frame; or blobs found elsewhere, labelled or not.
            time: s since the epoch. If it is before that of the snapshot learned last, no time has passed. The next
                time is then compared with this one: clocks may be set back.
            silent: cameras without data, if `source` is blobs; other cameras without blobs count as having seen
                nothing. If `source` is frames, cameras without a frame are silent.

        Returns:
            The current state. A snapshot that cannot be used teaches nothing: `refused` says why.

        Raises:
            InputError: a frame is not a grey image, has another size than the rig says, or is of a camera that is not
                in the rig; blobs of more than one snapshot; an invalid time.
        """
        if not (math.isfinite(time) and 0 <= time <= GREATEST_TIME):
            raise InputError(f"time: found {time!r}, expected seconds since the epoch")
        memory = self._memory
        source = source if isinstance(source, Detections) else check_frames(source, self._labelling.rig)
        given = self._labelling.blobs(source, snapshot_name(memory.count))
        detections = memory.copies.leave_out(given)
        frames = None if isinstance(source, Detections) else source
        memory.count, memory.time = memory.count + 1, time
        labelled, found, refused = None, None, None
        shown, lag = replace(detections, fiducial=np.full(len(detections), -1, dtype=np.int64)), self._lag(detections)
        try:
            labelled, shown, lag = self._label(detections, lag, frames)
            found = learn_snapshot(memory, labelled.checked)
            if memory.lights is None:
                self._labelling.follow(memory.poses[-1][1][0])
        except RefusedError as reason:
            self._labelling.follows, refused = False, str(reason)
        events, memory.pending = memory.pending, []
        if found is not None:
            events += self._report_findings(found)
        state = self._state(shown, lag, None if found is None else found.update, refused)
        out = silent if frames is None else [name for name in memory.prior.camera_names if frames.get(name) is None]
        stuck = [] if detections is given else np.setdiff1d(given.camera, detections.camera).tolist()
        out = frozenset(out).union(memory.prior.camera_names[camera] for camera in stuck)
        return self._conclude(state, frames, out, labelled, found, events)

    def _label(
        self, detections: Detections, lag: NDArray[np.float64], frames: Mapping[str, Frame | None] | None
    ) -> tuple[Labelled, Detections, NDArray[np.float64]]:
        """Label a snapshot whose late blobs are moved to where they would have been in time.

        Args:
            detections: its blobs.
            lag: (M, 2) pixels by which they are moved, as far as known before labelling.
            frames: frames that the blobs were found in; None = there are none.

        Returns:
            The moved blobs with their labels, the labelled blobs where they were seen, and the shifts between them.

        Raises:
            RefusedError: see `label_snapshot`.
        """
        memory, late = self._memory, self._clock.late
        rows = np.flatnonzero(detections.usable & np.isfinite(lag).all(1))
        usable = shift_blobs(detections.select(rows), lag[rows], late)

        def correct(named: Detections, pose: RigidTransform) -> Detections:
            if len(named) != len(rows):  # blobs of a proposer
                return named
            seen = replace(detections.select(rows), fiducial=named.fiducial)
            return shift_blobs(seen, self._lag(seen, (memory.time, pose)), late)

        name = detections.snapshot_names[0]
        labelled = label_snapshot(memory, self._labelling, usable, name, frames, correct if late.any() else None)
        found = labelled.checked.blobs
        if len(found) != len(rows):  # blobs of a proposer
            return labelled, found, np.zeros((len(found), 2))
        fiducial = np.full(len(detections), -1, dtype=np.int64)
        fiducial[rows] = found.fiducial
        shown = replace(detections, fiducial=fiducial)
        if late.any():  # the object's pose is known now
            known = self._lag(shown, (memory.time, labelled.checked.rig_from_object))
            lag = np.where(np.isfinite(lag), known, np.nan)  # what was left out stays so
            blobs = shift_blobs(shown.select(rows), lag[rows], late)
            labelled = replace(labelled, checked=replace(labelled.checked, blobs=blobs))
        return labelled, shown, lag

    def _lag(self, blobs: Detections, *now: tuple[float, RigidTransform]) -> NDArray[np.float64]:
        """Shift of each blob to where it would have been in time: (M, 2) pixels."""
        memory = self._memory
        return clock_shifts(blobs, self._clock.late, memory.belief, [*memory.poses, *now], memory.time)

    def _report_findings(self, found: MonitorUpdate) -> list[Event]:
        """Report what the monitor found with an absorbed snapshot."""
        memory, events = self._memory, []
        for change in found.changes:
            since = memory.change_time(change.since, change.camera)
            told = memory.relearning.events.get(change.camera)
            again = told is not None and told.change == "unknown"
            if told is not None and again and told.since is not None:
                since = told.since
            known = memory.before, memory.belief.rig
            event = memory.relearning.report_change(change, since, memory.time, memory.count - 1, *known)
            if not again or event.change != "unknown":  # a camera that keeps moving is reported once
                events.append(event)
        if (of_object := found.object_change) is not None:
            events.append(object_event(of_object, memory.change_time(of_object.since), memory.time, memory.count - 1))
        return events

    def _state(
        self, shown: Detections, lag: NDArray[np.float64], result: MeasurementUpdate | None, refused: str | None
    ) -> RigState:
        """The current state, without health and events."""
        memory, pose = self._memory, None if result is None else result.rig_from_object
        predicted, cameras = memory.predicted(pose), memory.prior.num_cameras
        residual = np.full(cameras, np.nan)
        rows = np.flatnonzero(shown.fiducial >= 0)
        if len(rows) and pose is not None:
            squared = np.square(predicted[shown.camera[rows], shown.fiducial[rows]] - (shown.uv + lag)[rows]).mean(1)
            count = np.bincount(shown.camera[rows], minlength=cameras)
            total = np.bincount(shown.camera[rows], squared, minlength=cameras)
            residual = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        offset, sigma = self._clock.offsets()
        return RigState(
            time=memory.time,
            snapshot=memory.count - 1,
            belief=memory.belief,
            factory=memory.factory,
            cameras=camera_health(memory, predicted),
            sentence="",
            refused=refused,
            detections=shown,
            lag=lag,
            predicted=predicted,
            residual=residual,
            rig_from_object=None if pose is None or memory.lights is not None else pose[0],
            events=(),
            clock_offset=offset,
            clock_offset_sigma=sigma,
            noise=memory.noise.additive,
            shake=memory.monitor.shaking.shake.numpy(),
            persistent=memory.monitor.noise.persistent.numpy(),
        )

    def _conclude(
        self,
        state: RigState,
        frames: Mapping[str, Frame | None] | None,
        out: frozenset[str],
        labelled: Labelled | None,
        found: MonitorUpdate | None,
        events: list[Event],
    ) -> RigState:
        """Add the health of the cameras and the events to a state."""
        memory, time, number = self._memory, state.time, state.snapshot
        names = memory.prior.camera_names
        for slip in () if found is None else found.slips:
            events += self._clock.adopt_slip(state, slip, memory.change_time(slip.since, slip.camera))
            state = replace(state, lag=self._lag(state.detections))
        for camera in () if found is None else found.unsynchronized:
            events.append(unsynchronized_event(names[camera], memory.off.get(camera, time), time, number))
        silent = (camera for camera, name in enumerate(names) if name in out)
        # An unsynchronized camera has not moved far.
        astray = frozenset() if labelled is None else labelled.astray - memory.monitor.quarantine.cameras
        left_out = frozenset(state.detections.camera[np.isnan(state.lag).any(1)].tolist())
        look = VisibleObject(time, number, state.detections, state.predicted, astray, frozenset(silent), left_out)
        events += memory.sightings.observe(state.rig, look)
        events += memory.relearning.report_relearnt(
            memory.belief, frozenset(memory.monitor.open), memory.best_known, time, number
        )
        if found is not None:
            seen = memory.monitor.seen_points
            events += memory.drift_watch.observe(memory.belief, memory.unsettled, seen, time, number)
        for test in self.tests:
            for event in test(state, frames, None if found is None else found.update):
                events.append(event)
                take_health(memory, event)
        health = camera_health(memory, state.predicted)
        sentence = describe_health(health, memory.monitor.filter.count)
        if memory.lights is not None and memory.monitor.filter.count:
            sentence += f"; the scale is known to +- {100 * memory.belief.scale_std():.2g} %"
            sentence += "" if memory.obj.parts else " (lights cannot improve it)"
        lights = None if labelled is None else labelled.checked.lights
        return replace(state, cameras=health, events=tuple(events), sentence=sentence, lights=lights)

    def use_proposer(self, proposer: Proposer) -> None:
        """Find fiducials in frames with this proposer from now on; saved states do not contain it."""
        self._labelling.use_proposer(proposer)

    def accept_as_factory(self) -> Event:
        """Make the current rig the factory calibration, relative to which motion is reported; the belief is unchanged.

        Returns:
            The event, which is also part of the next state.

        Raises:
            RefusedError: no snapshot has come yet.
        """
        memory = self._memory
        if memory.count == 0:
            raise RefusedError("factory: no snapshot has come yet, so the present rig is the factory calibration")
        known = memory.factory
        memory.factory = replace(memory.belief.rig, prior=known.prior, drift_rate=known.drift_rate)
        self._labelling.rig = memory.factory
        message = "the present rig is the factory calibration from now on"
        memory.pending.append(Event(memory.time, max(memory.count - 1, 0), "factory", message=message))
        return memory.pending[-1]

    def saved(self, progress: dict[str, Any] | None = None) -> KeeperFile:
        """Copy the state, within milliseconds; the copy can be written while the keeper continues.

        Args:
            progress: anything else to save in the same step, such as the position in a source.
        """
        memory = self._memory
        health = camera_health(memory, memory.predicted(memory.poses[-1][1] if memory.poses else None))
        writer = StateWriter()
        state = {
            "memory": writer.write(KeeperMemory, memory),
            "labelling": writer.write(Labelling, self._labelling),
            "tests": {test.name: writer.write(type(test), test) for test in self.tests},
        }
        return KeeperFile(
            time=memory.time,
            snapshot=memory.count - 1,
            sentence=describe_health(health, memory.monitor.filter.count),
            cameras={name: str(state) for name, state in health.items()},
            rig=memory.belief.rig,
            factory=memory.factory,
            obj=memory.obj,
            state=state,
            tables=writer,
            progress=progress,
        )

    def save(self, path: str | Path) -> None:
        """Save the state to a file atomically: JSON, the readable part first.

        Raises:
            InputError: the file cannot be written.
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
        """Resume from a saved state: the same snapshots then give the same states.

        Args:
            path: the file, which includes the factory calibration and the object.
            options: as for a new one.
            detection: as for a new one.
            detector: as for a new one.
            tests: as for a new one; their saved states are restored.

        Raises:
            InputError: the file is not a saved state, or was changed.
        """
        found, reader = read_state(path)
        try:
            memory = KeeperMemory.restored(reader, found["memory"], _for_keeping(options))
            keeper = cls(
                memory.prior, memory.obj, options, detection=detection, detector=detector, drift=memory.drift,
                horizon=memory.horizon, tests=tests,
            )  # fmt: skip
            keeper._memory = memory
            reader.read_object(Labelling, found["labelling"], "labelling", keeper._labelling)
            keeper._labelling.rig = keeper.factory
            for test in keeper.tests:
                if test.name in found["tests"]:
                    reader.read_object(type(test), found["tests"][test.name], f"tests.{test.name}", test)
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
            raise unusable_error(path, error) from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        return keeper


def _for_keeping(options: PipelineOptions) -> PipelineOptions:
    """Options under which a camera may be blind: this is reported, but no snapshot is refused for it."""
    return replace(options, blind_cameras=True)
