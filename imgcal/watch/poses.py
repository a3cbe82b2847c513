"""The object's pose in each snapshot (`PoseRecord`), and its delivery to a sink (`Poses`)."""

from __future__ import annotations

import json
import math
import threading
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal

from imgcal.geometry import vector_from_rotation
from imgcal.online import LightPoints, ObjectPose, RigState

PoseStatus = Literal["ok", "degraded", "no_object"]
MOST_WAITING = 128
"""Maximum number of snapshots that wait for a sink; beyond that, the oldest is dropped, or a recording waits."""
LONGEST_WAIT = 10.0
"""Time (s) for which a recording waits for a sink that takes nothing."""
IDLE_EVERY = 0.25  # s between two calls of `PoseSink.idle`
LONGEST_END = 5.0
"""Time (s) after which a sink that takes none of the waiting poses is given up at the end."""
COVARIANCE = tuple((i, j) for i in range(6) for j in range(i, 6))
AXES = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
COLUMNS = (
    "time", "snapshot", "status", "markers", "cameras", *AXES, *(f"cov_{i}{j}" for i, j in COVARIANCE),
)  # fmt: skip
"""Columns of a table of poses: rotation vector and translation of rig_from_object, upper triangle of the covariance."""


@dataclass(frozen=True)
class PoseRecord:
    """The object's pose in a snapshot.

    Status: `ok`, all cameras are calibrated; `degraded`, some are not (lost, in doubt, being relearned), and the
    pose comes from the others; `no_object`, there is no pose.
    """

    time: float  # s, of the snapshot
    snapshot: int  # number of the update
    pose: ObjectPose | None
    status: PoseStatus
    message: str  # why there is no pose; otherwise the state of the rig in a sentence
    not_ok: int = 0  # number of uncalibrated cameras
    lights: LightPoints | None = None  # lights, if they are unknown ones

    @classmethod
    def of(cls, state: RigState) -> PoseRecord:
        """Make the record from the state after a snapshot."""
        pose, lights = state.object_pose, state.light_points
        not_ok = len(state.uncalibrated)
        if lights is not None and len(lights):
            status: PoseStatus = "degraded" if not_ok else "ok"
            return cls(state.time, state.snapshot, None, status, state.sentence, not_ok, lights)
        if pose is None:
            why = state.refused or "the object is not seen well enough"
            return cls(state.time, state.snapshot, None, "no_object", why, not_ok)
        return cls(state.time, state.snapshot, pose, "degraded" if not_ok else "ok", state.sentence, not_ok)

    def to_json(self) -> str:
        """Write a line of JSON: the pose as (4, 4), mm; its covariance (6, 6), rad and mm; null if there is none."""
        values: dict[str, Any] = {
            "time": self.time,
            "snapshot": self.snapshot,
            "status": self.status,
            "rig_from_object": None,
            "covariance": None,
            "markers": 0,
            "cameras": 0,
            "message": self.message,
        }
        if self.pose is not None:
            values |= {
                "rig_from_object": self.pose.matrix().tolist(),
                "covariance": self.pose.covariance.tolist(),
                "markers": self.pose.markers,
                "cameras": self.pose.cameras,
            }
        return json.dumps(values, ensure_ascii=False)

    def to_row(self) -> str:
        """Write a row of a table, without a line end: see `COLUMNS`."""
        first = f"{self.time!r},{self.snapshot},{self.status}"
        if self.pose is None:
            return f"{first},0,0{',' * (len(COLUMNS) - 5)}"
        place = self.pose.rig_from_object
        numbers = [*vector_from_rotation(place.rotation).tolist(), *place.translation.tolist()]
        numbers += [float(self.pose.covariance[i, j]) for i, j in COVARIANCE]
        return f"{first},{self.pose.markers},{self.pose.cameras}," + ",".join(f"{number:.9g}" for number in numbers)

    def accuracy(self) -> str:
        """Describe the accuracy of the pose for people.

        Examples:
            >>> PoseRecord(0.0, 0, None, "no_object", "nothing is seen").accuracy()
            'no pose'
        """
        if self.pose is None:
            return "no pose"
        turn, shift = self.pose.std()
        return f"+-{shift:.2g} mm, {math.degrees(turn):.2g} deg"


class UnwrittenError(OSError):
    """A sink has lost poses, the one that it was given and earlier ones."""

    def __init__(self, message: str, count: int) -> None:
        """Say why, and how many."""
        super().__init__(message)
        self.count = count


class PoseSink(ABC):
    """Takes poses."""

    @property
    def table(self) -> tuple[str, int] | None:
        """Path and size (bytes) of a table from which a restart removes the rows that come again; None = no table."""
        return None

    @abstractmethod
    def send(self, record: PoseRecord) -> None:
        """Take the pose of a snapshot.

        Raises:
            OSError: this pose cannot be taken now; the next one may.
            UnwrittenError: the same of several poses.
        """

    def idle(self) -> None:
        """Do what is due while no snapshot comes; called several times a second.

        Raises:
            OSError: it cannot be done now.
        """
        return

    @abstractmethod
    def close(self) -> None:
        """Close the sink.

        Raises:
            OSError: it cannot be closed.
            UnwrittenError: poses that it held cannot be written.
        """


class Poses:
    """Passes every snapshot's pose to a sink. A context manager: on leaving, waiting poses get some time.

    A separate thread computes covariances and serves the sink, so that neither blocks the caller.
    """

    def __init__(
        self,
        name: str,
        sink: PoseSink,
        most_waiting: int = MOST_WAITING,
        end: float = LONGEST_END,
        idle: float = IDLE_EVERY,
    ) -> None:
        """Start the thread.

        Args:
            name: of the sink, for messages.
            sink: closed together with this object.
            most_waiting: maximum number of waiting snapshots.
            end: seconds at the end after which a sink that takes nothing is given up.
            idle: seconds without a snapshot after which the sink may do something else.
        """
        self.name, self.dropped, self.failed = name, 0, 0
        """Number of snapshots that were dropped, or could not be written."""
        self.problem: str | None = None
        """The first problem; None = no problem."""
        self._sink, self._most, self._end, self._idle = sink, most_waiting, end, idle
        self._waiting: deque[RigState] = deque()
        self._changed, self._closing, self._hangs = threading.Condition(), False, False
        self._thread = threading.Thread(target=self._work, name="poses", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Number of poses that the sink did not get."""
        return self.dropped + self.failed

    @property
    def table(self) -> tuple[str, int] | None:
        """See `PoseSink`."""
        return self._sink.table

    def publish(self, state: RigState, wait: bool = False) -> None:
        """Take the state after a snapshot; returns at once, or with `wait`, once there is room.

        A sink that takes nothing for `LONGEST_WAIT` seconds is no longer waited for.
        """
        with self._changed:
            if wait and not self._hangs:
                has_room = self._changed.wait_for(lambda: len(self._waiting) < self._most, LONGEST_WAIT)
                self._hangs = not has_room
            self._waiting.append(state)
            if len(self._waiting) > self._most:
                self._waiting.popleft()
                self.dropped += 1
                self._fail(f"poses were dropped: more than {self._most} were waiting")
            self._changed.notify_all()

    def __enter__(self) -> Poses:
        """Return itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Let the sink take the waiting poses for as long as it takes some, and close it."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        before = math.inf
        while self._thread.is_alive() and len(self._waiting) < before:
            before = len(self._waiting)
            self._thread.join(self._end)
        if self._thread.is_alive():
            with self._changed:
                self.dropped += len(self._waiting)
                self._waiting.clear()
                self._fail("poses were dropped: they could not be written in time")

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing, self._idle)
                if self._closing and not self._waiting:
                    break
                state = self._waiting.popleft() if self._waiting else None
                self._hangs = False
                self._changed.notify_all()
            try:
                if state is None:
                    self._sink.idle()
                else:
                    self._sink.send(PoseRecord.of(state))
            except Exception as error:  # a bad pose must not stop the next ones
                self.failed += error.count if isinstance(error, UnwrittenError) else state is not None
                self._fail(f"cannot be written: {error}")
        try:
            self._sink.close()
        except UnwrittenError as error:
            self.failed += error.count
            self._fail(f"cannot be written: {error}")
        except OSError as error:
            self._fail(f"cannot be closed: {error}")

    def _fail(self, how: str) -> None:
        self.problem = self.problem or f"{self.name}: {how}"
