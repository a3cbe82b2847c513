"""Everything a keeper remembers between snapshots: what is saved, and what a file must contain to be resumed."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import PipelineOptions, to_observations
from imgcal.geometry import RigidTransform
from imgcal.medians import median
from imgcal.monitoring import RigBelief, RigFilter, RigMonitor, belief_from_posterior, calibration_posterior
from imgcal.online.camera_search import Search, Surroundings
from imgcal.online.camera_visibility import CameraVisibility
from imgcal.online.clock_correction import POSES
from imgcal.online.copied_images import CopiedImages
from imgcal.online.drift_watch import DriftWatch
from imgcal.online.events import Event
from imgcal.online.light_tracks import LightTracks
from imgcal.online.noise_level import NoiseLevel
from imgcal.online.object_checks import ObjectChecks
from imgcal.online.relearning import Relearning
from imgcal.online.rig_state import ImageHealth
from imgcal.online.state_document import NOT_SAVED, StateReader
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
"""Error of most cameras, in multiples of its usual size, above which labels or pose must be wrong, not the cameras."""
LEAST_LOOKS = 8
"""Number of snapshots of a camera in its current pose after which its labels can be predicted."""
USUAL_SNAPSHOTS = 8
"""Number of snapshots that define the usual error of most cameras."""
DRIFT_FROM = 20
"""Snapshots after which the drift of a rig that began with its factory values is measured: labels of its first ones may
be wrong, and the next ones correct it."""


@dataclass
class KeeperMemory:
    """What is known about a rig and its object, and what is in progress; changed in place."""

    options: PipelineOptions = field(metadata=NOT_SAVED)  # given by the caller on resuming
    factory: CameraRig
    obj: CalibrationObject  # as in its file
    drift: DriftRate | None
    horizon: int | None  # latest snapshots that count; None = all
    prior: CameraRig  # the filter's initial rig
    monitor: RigMonitor
    noise: NoiseLevel
    sightings: CameraVisibility
    relearning: Relearning
    drift_watch: DriftWatch
    doubts: ObjectChecks
    search: Search
    looks: NDArray[np.int64]  # (C,) snapshots learned of each camera in its current pose
    before: RigBelief  # before the pending changes
    copies: CopiedImages = field(default_factory=CopiedImages)
    lights: LightTracks | None = None  # None = an object is known
    count: int = 0
    learnt: float | None = None  # s, time of the last absorbed snapshot
    times: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=512))  # number in the filter, time
    poses: deque[tuple[float, RigidTransform]] = field(default_factory=lambda: deque(maxlen=POSES))  # (1,), the latest
    labels: int = 0  # number in the last snapshot
    usual: deque[float] = field(default_factory=lambda: deque(maxlen=64))  # px
    off: dict[int, float] = field(default_factory=dict)  # camera that did not fit last -> since when
    in_vain: int = 0  # successive snapshots that fit in no camera
    told_health: dict[int, ImageHealth] = field(default_factory=dict)  # as reported by tests
    pending: list[Event] = field(default_factory=list)
    time: float = 0.0

    @classmethod
    def from_factory(
        cls,
        rig: CameraRig,
        obj: CalibrationObject,
        drift: DriftRate | None,
        options: PipelineOptions,
        horizon: int | None = None,
    ) -> KeeperMemory:
        """Start with a factory calibration; with a horizon, earlier calibration snapshots do not count.

        Raises:
            InputError: the rig or the object is invalid, or the object's fiducials are collinear.
        """
        check_rig(rig)
        if drift is not None:
            check_rig(replace(rig, drift_rate=drift))
        if not obj.unknown_markers:
            obj.require_rigid("for a running rig")
        check_object(obj)
        rig = rig.as_constant()
        calibration, rig = None if horizon is not None else calibration_posterior(rig), replace(rig, posterior=None)
        start = None if calibration is None else (belief_from_posterior(calibration, obj), calibration.snapshots)
        monitor = RigMonitor(RigFilter(rig, obj, drift, options.estimation, start=start, horizon=horizon))
        memory = cls(
            options=options, factory=rig, obj=obj, drift=drift, horizon=horizon, prior=rig, monitor=monitor,
            noise=NoiseLevel(rig, obj, options), sightings=CameraVisibility(rig.camera_names),
            relearning=Relearning(rig.camera_names), drift_watch=DriftWatch(rig.camera_names),
            doubts=ObjectChecks(obj.num_fiducials), search=Search(rig.num_cameras),
            looks=np.zeros(rig.num_cameras, dtype=np.int64), before=monitor.filter.belief,
            lights=LightTracks.of(obj.each[-1].num_fiducials, rig.num_cameras) if obj.unknown_markers else None,
        )  # fmt: skip
        if calibration is not None:
            memory.looks[:], memory.learnt = LEAST_LOOKS, calibration.time
        if calibration is not None or memory.lights is not None:
            memory.noise.trust()
        return memory

    def reset(self) -> None:
        """Forget everything but the factory calibration."""
        fresh = KeeperMemory.from_factory(self.prior, self.obj, self.drift, self.options, self.horizon)
        for name in ("monitor", "doubts", "search", "relearning", "drift_watch", "looks", "off", "in_vain"):
            setattr(self, name, getattr(fresh, name))
        self.noise.restart()
        self.usual.clear()
        self.times.clear()
        cause = "labels fit in no camera: all cameras have moved, or the labels are of another object"
        message = f"{cause}; learning starts again from the factory calibration"
        self.pending.append(Event(self.time, self.count - 1, "restart", message=message))

    @property
    def belief(self) -> RigBelief:
        """The current belief about the rig."""
        return self.monitor.filter.belief

    def elapsed(self, time: float) -> float:
        """Seconds since the last absorbed snapshot, limited to a useful range.

        Longer times forget no more: one kind of value may then be as far off as in the factory calibration. Also, a
        clock that is set (from 1970, after a start) does not count as years of drift.
        """
        if self.learnt is None:
            return 0.0
        prior, rate = self.prior.prior or RigPrior(), self.monitor.filter.rate
        hours = [(getattr(prior, name) / wander) ** 2 for name, wander in vars(rate).items() if wander > 0]
        return min(max(time - self.learnt, 0.0), 3600 * min(hours, default=0.0))

    @property
    def obj_now(self) -> CalibrationObject:
        """The object as currently estimated."""
        known = self.belief.obj  # with tolerances, even if an exact object has changed
        return self.obj if known.exact else replace(self.obj.as_exact(), points=self.belief.points_object)

    @property
    def surroundings(self) -> Surroundings | None:
        """The rig and its uncertainty with a margin; None = nothing but the factory calibration is known."""
        if not self.monitor.filter.count:
            return None
        return Surroundings(self.belief, self.prior, self.obj_now, self.options)

    @property
    def best_known(self) -> frozenset[int]:
        """Cameras that every snapshot within the horizon shows in their current poses; empty without a horizon."""
        return frozenset() if self.horizon is None else frozenset(np.flatnonzero(self.looks >= self.horizon).tolist())

    @property
    def unsettled(self) -> frozenset[int]:
        """Cameras whose drift is not measured: moved, lost or off; at first all of a rig with its factory values."""
        filtered = self.monitor.filter
        if not filtered.calibrated and filtered.count < DRIFT_FROM:
            return frozenset(range(self.prior.num_cameras))
        return frozenset(self.relearning.events) | frozenset(self.sightings.lost) | frozenset(self.off)

    @property
    def most_usual(self) -> float:
        """Maximum error of most cameras, px."""
        if len(self.usual) < USUAL_SNAPSHOTS:
            return math.inf
        return self.options.identity_error + UNUSUAL * max(median(self.usual), median(self.noise.additive))

    def predicted(self, pose: RigidTransform | None) -> NDArray[np.float64]:
        """Project the fiducials of an object in a pose (1,): (C, N, 2) pixels; nan without a pose."""
        if pose is None:
            return np.full((self.prior.num_cameras, self.obj.num_fiducials, 2), np.nan)
        points = self.belief.points_at(pose)[0]
        uv: NDArray[np.float64] = self.belief.rig.project_values(points, self.obj.radius).uv.numpy()
        return uv

    def observed(self, blobs: Detections) -> Observations:
        """Labelled blobs of a snapshot with their estimated noise: (1, C, N)."""
        seen = to_observations(blobs, self.prior, self.obj)
        additive = torch.from_numpy(self.noise.additive)[:, None]
        return replace(seen, sigma=torch.hypot(seen.sigma, additive))

    def change_time(self, number: int, camera: int | None = None) -> float:
        """Time (s) of a change, found by the filter since snapshot `number`, of a camera or the object."""
        since = next((time for learnt, time in self.times if learnt >= number), self.time)
        return since if camera is None else self.search.lost_since(camera, min(since, self.off.get(camera, since)))

    @classmethod
    def restored(cls, reader: StateReader, plain: dict[str, Any], options: PipelineOptions) -> KeeperMemory:
        """Restore the memory from a file.

        Args:
            reader: of the file.
            plain: the file's values for it.
            options: as for a new one.

        Raises:
            ValueError: the values are invalid, or belong to another rig and object.
            InputError: the file contains an invalid rig or object.
        """
        rig, obj = reader.read(CameraRig, plain["prior"], "prior"), reader.read(CalibrationObject, plain["obj"], "obj")
        drift = reader.read(DriftRate | None, plain["drift"], "drift")
        horizon = reader.read(int | None, plain["horizon"], "horizon")
        if horizon is not None and horizon < 1:
            raise ValueError(f"horizon: found {horizon}")
        memory = cls.from_factory(rig, obj, drift, options, horizon)
        reader.read_object(cls, plain, "memory", memory)
        beliefs = (memory.belief, memory.before)
        alike = all(belief.rig.camera_names == rig.camera_names for belief in beliefs)
        if not alike or memory.belief.obj.num_fiducials != obj.num_fiducials or len(memory.looks) != rig.num_cameras:
            raise ValueError("found a belief about another rig or object")
        return memory
