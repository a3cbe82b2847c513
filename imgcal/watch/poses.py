"""Where the object is, snapshot by snapshot, for whoever wants it: `PoseRecord`, and `Poses` that hands them on."""

from __future__ import annotations

import json
import math
import threading
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Protocol

from imgcal.geometry import vector_from_rotation
from imgcal.online import LightPoints, ObjectPose, RigState

PoseStatus = Literal["ok", "degraded", "no_object"]
MOST_WAITING = 128
"""Snapshots that wait for a sink; more, and the oldest is dropped."""
LONGEST_END = 5.0
"""Seconds that a sink has at the end for what waits."""
COVARIANCE = tuple((i, j) for i in range(6) for j in range(i, 6))
AXES = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
COLUMNS = (
    "time", "snapshot", "status", "markers", "cameras", *AXES, *(f"cov_{i}{j}" for i, j in COVARIANCE),
)  # fmt: skip
"""Of a table of poses: rotation vector and translation of rig_from_object, upper triangle of their covariance."""


@dataclass(frozen=True)
class PoseRecord:
    """What a snapshot says of where the object is.

    Status: `ok`, all cameras are calibrated; `degraded`, some are not (lost, in doubt, being learnt again), the pose is
    from the others; `no_object`, there is no pose.
    """

    time: float  # s, of the snapshot
    snapshot: int  # number of the update
    pose: ObjectPose | None
    status: PoseStatus
    message: str  # why there is no pose; otherwise the state of the rig in a sentence
    not_ok: int = 0  # cameras that are not calibrated
    lights: LightPoints | None = None  # where no object is known, and lights were found

    @classmethod
    def of(cls, state: RigState) -> PoseRecord:
        """Take it out of what is known after a snapshot."""
        pose, lights = state.object_pose, state.light_points
        not_ok = sum(health != "ok" for health in state.cameras.values())
        if lights is not None and len(lights):
            status: PoseStatus = "degraded" if not_ok else "ok"
            return cls(state.time, state.snapshot, None, status, state.sentence, not_ok, lights)
        if pose is None:
            why = state.refused or "the object is not seen well enough"
            return cls(state.time, state.snapshot, None, "no_object", why, not_ok)
        return cls(state.time, state.snapshot, pose, "degraded" if not_ok else "ok", state.sentence, not_ok)

    def to_json(self) -> str:
        """Write a line of JSON: the pose as (4, 4), mm; its covariance (6, 6), rad and mm; null where there is none."""
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
        """Say for people how surely the pose is known.

        Examples:
            >>> PoseRecord(0.0, 0, None, "no_object", "nothing is seen").accuracy()
            'no pose'
        """
        if self.pose is None:
            return "no pose"
        turn, shift = self.pose.std()
        return f"+-{shift:.2g} mm, {math.degrees(turn):.2g} deg"


class PoseSink(Protocol):
    """Takes poses."""

    def send(self, record: PoseRecord) -> None:
        """Take the pose of a snapshot.

        Raises:
            OSError: it cannot be taken now; the next one may.
        """

    def close(self) -> None:
        """Take no more."""


class Poses:
    """Hands the pose of every snapshot to a sink. A context manager: leaving it gives the sink a while for what waits.

    Covariances are computed, and the sink is served, by a thread of its own: neither ever holds up who publishes.
    """

    def __init__(self, name: str, sink: PoseSink, most_waiting: int = MOST_WAITING, end: float = LONGEST_END) -> None:
        """Begin.

        Args:
            name: of the sink, for messages.
            sink: is closed with it.
            most_waiting: snapshots.
            end: seconds that it has at the end.
        """
        self.name, self.dropped, self.failed = name, 0, 0
        """Snapshots that could not be waited for, or written."""
        self.problem: str | None = None
        """What went wrong first; None = nothing did."""
        self._sink, self._most, self._end = sink, most_waiting, end
        self._waiting: deque[RigState] = deque()
        self._changed, self._closing = threading.Condition(), False
        self._thread = threading.Thread(target=self._work, name="poses", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Poses that the sink did not get."""
        return self.dropped + self.failed

    def publish(self, state: RigState) -> None:
        """Take what is known after a snapshot; returns at once."""
        with self._changed:
            self._waiting.append(state)
            if len(self._waiting) > self._most:
                self._waiting.popleft()
                self.dropped += 1
                self._fail(f"poses are dropped: more than {self._most} wait")
            self._changed.notify()

    def __enter__(self) -> Poses:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let the sink take what waits, for a while, and close it."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(self._end)
        if self._thread.is_alive():
            with self._changed:
                self.dropped += len(self._waiting)
                self._waiting.clear()
                self._fail("poses are dropped: they could not be written in time")

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    break
                state = self._waiting.popleft()
            try:
                self._sink.send(PoseRecord.of(state))
            except Exception as error:  # whatever is wrong with one pose, the next ones are sent
                self.failed += 1
                self._fail(f"cannot be written: {error}")
        try:
            self._sink.close()
        except OSError as error:
            self._fail(f"cannot be closed: {error}")

    def _fail(self, how: str) -> None:
        self.problem = self.problem or f"{self.name}: {how}"
