"""Combine single exposures into snapshots by the cameras' time stamps; exposures may be late, repeated or missing."""

from __future__ import annotations

import itertools
import math
import zlib
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from imgcal.io import Frame
from imgcal.types import Detections
from imgcal.watch.exposures import CameraBlobs, Exposure, frame_digest
from imgcal.watch.time_stamp_check import TimeStampCheck
from imgcal.watch.timing import LEAP, Timing

MOST_PENDING = 32
"""Maximum number of unfinished snapshots; beyond it, the oldest is released as it is."""
OUT_AFTER = 10
"""Successive snapshots without a camera after which it is no longer waited for."""
INTERVALS, LEAST_INTERVALS = 8, 3
"""Number of intervals between exposures of a camera whose median predicts its next one; with fewer, it is
always due."""
BEGINNING = 3.0
"""Time (s) to wait for a camera with few exposures: it may send once a second."""
MOST_TOLERANCE = 0.49
"""Maximum tolerance as a share of a camera's median interval: beyond half of it, exposures would belong to two
snapshots."""
EARLY = 0.05
"""Share of the median interval by which it may come early."""
ALONE = 30
"""Successive snapshots of one camera alone, while the others are together, that show that its time stamps are off."""
NEIGHBOUR = 1.1
"""Part of a camera's usual interval in which others must have exposed: a faster camera is often alone rightly."""
LONGEST_ASTRAY = 100
"""Successive exposures after a jump of the clocks until the new times are accepted."""
REMEMBERED = 4096
"""Number of remembered names of released snapshots."""

COUNTS = ("received", "missing", "late", "duplicate", "out_of_order", "clock_off", "out_of_tolerance")
"""Counters of each camera.

`missing`: snapshots without it although it was due. `late`: it came after its snapshot was released. `duplicate`: a
second exposure for the same snapshot. `clock_off`: its clock is off by more than `LEAP`. `out_of_tolerance`: its time
stamps have differed from the others' for long. These four are left out. `out_of_order`: earlier than a previous one;
used if its snapshot has not been released.
"""


@dataclass(frozen=True)
class TimedSnapshot:
    """What the cameras saw at one moment."""

    time: float  # s, median time stamp
    exposures: Mapping[str, Exposure]  # by camera, as far as present
    name: str | None = None  # if the source names snapshots
    era: int = 0  # number of joint jumps of all clocks before it

    @property
    def digest(self) -> int | None:
        """Number that differs between snapshots that show something else, at whatever time; None = no blobs."""
        shown = [(name, self.exposures[name].content) for name in sorted(self.exposures)]
        digests = [
            (name, zlib.crc32(content.uv.tobytes()) if isinstance(content, CameraBlobs) else frame_digest(content))
            for name, content in shown
            if not isinstance(content, CameraBlobs) or len(content.uv)
        ]
        return zlib.crc32(repr(digests).encode()) if digests else None

    def frames(self, camera_names: tuple[str, ...]) -> dict[str, Frame | None]:
        """Frame (H, W) of each camera; None = no frame, or blobs."""
        contents = {name: self.exposures[name].content for name in camera_names if name in self.exposures}
        return {name: None if isinstance(found := contents.get(name), CameraBlobs) else found for name in camera_names}

    def source(self, camera_names: tuple[str, ...]) -> dict[str, Frame | None] | Detections:
        """Input for a keeper: frames (H, W) by camera, or blobs if the source sends those."""
        given = [
            (camera, content)
            for camera, name in enumerate(camera_names)
            if name in self.exposures and isinstance(content := self.exposures[name].content, CameraBlobs)
        ]
        if not given:
            return self.frames(camera_names)
        camera = np.repeat([camera for camera, _ in given], [len(blobs.uv) for _, blobs in given]).astype(np.int64)
        count = len(camera)
        return Detections(
            uv=np.concatenate([blobs.uv for _, blobs in given]),
            sigma=np.concatenate([blobs.sigma for _, blobs in given]),
            camera=camera,
            snapshot=np.zeros(count, dtype=np.int64),
            fiducial=np.full(count, -1, dtype=np.int64),
            radius=np.concatenate([blobs.radius for _, blobs in given]),
            flags=np.zeros(count, dtype=np.uint8),
            camera_names=camera_names,
            snapshot_names=(self.name or "0",),
        )

    @property
    def num_bytes(self) -> int:
        """Memory of its frames."""
        return sum(e.content.nbytes for e in self.exposures.values() if not isinstance(e.content, CameraBlobs))


@dataclass
class _Pending:
    """An unfinished snapshot."""

    name: str | None
    arrived: float  # s, arrival of its first exposure
    exposures: dict[str, Exposure] = field(default_factory=dict)
    earliest: float = math.inf
    latest: float = -math.inf
    tolerance: float = math.inf  # s, the smallest of its cameras

    def add(self, exposure: Exposure, tolerance: float) -> None:
        self.exposures[exposure.camera] = exposure
        self.tolerance = min(self.tolerance, tolerance)
        self.earliest, self.latest = min(self.earliest, exposure.time), max(self.latest, exposure.time)

    def distance(self, time: float) -> float:
        return abs(time - (self.earliest + self.latest) / 2)

    def includes(self, time: float, tolerance: float) -> bool:
        """Tell whether a time stamp belongs to it, by the tolerances of its camera and of those already present."""
        return max(self.latest, time) - min(self.earliest, time) <= min(self.tolerance, tolerance)

    def finished(self, era: int) -> TimedSnapshot:
        times = sorted(exposure.time for exposure in self.exposures.values())
        return TimedSnapshot(times[len(times) // 2], self.exposures, self.name, era)


class Synchronizer:
    """Combines exposures into snapshots, in bounded memory.

    A snapshot is released when all active cameras have delivered, or when `patience` has passed: by this machine's
    clock if nothing more waits to be read, otherwise by later time stamps, because a reader that was held up finds
    exposures that came in time. Snapshots are released in the order of their times; named ones in the order of arrival.
    No single clock defines the time of a snapshot: it is the median of the cameras' time stamps.

    Examples:
        >>> pair = Synchronizer(("left", "right"), Timing())
        >>> pair.add(Exposure("left", 0.001, CameraBlobs.of([])))
        ()
        >>> [snapshot.time for snapshot in pair.add(Exposure("right", 0.002, CameraBlobs.of([])))]
        [0.002]
    """

    def __init__(self, camera_names: tuple[str, ...], timing: Timing) -> None:
        self.camera_names, self.timing = camera_names, timing
        self.counts: dict[str, Counter[str]] = {kind: Counter(dict.fromkeys(camera_names, 0)) for kind in COUNTS}
        self.leaps = 0
        """Number of joint jumps of all clocks."""
        self._pending: list[_Pending] = []  # in the order of release
        self._absent = Counter(dict.fromkeys(camera_names, 0))  # successive snapshots without a camera
        self._newest: dict[str, float] = {}  # latest time stamp of each camera
        self._stamps = {name: deque[float](maxlen=INTERVALS + 1) for name in camera_names}  # latest of each camera
        self._alone: Counter[str] = Counter()  # successive snapshots of one camera alone, close to others
        self.alone: tuple[str, ...] = ()
        """Cameras whose time stamps always differ from the others': their clocks do."""
        self._check = TimeStampCheck(camera_names)
        self._offset: dict[str, float] = {}  # last time stamp minus this machine's clock at arrival
        self._gone: _Pending | None = None  # the last released snapshot without a name
        self._names: deque[str] = deque(maxlen=REMEMBERED)
        self._known: set[str] = set()  # the same as a set
        self._astray: dict[str, Exposure] = {}  # last exposure of each camera whose clock has jumped
        self._astray_in_a_row = 0

    @property
    def waiting(self) -> int:
        """Number of unfinished snapshots."""
        return len(self._pending)

    @property
    def advice(self) -> str:
        """What is wrong with the time stamps; empty = nothing that shows."""
        return self._check.advise(self.counts["received"], self.leaps)

    def add(self, exposure: Exposure, now: float = 0.0) -> tuple[TimedSnapshot, ...]:
        """Take an exposure of one of the cameras.

        Args:
            exposure: checked.
            now: s, this machine's clock; 0 for recordings, which are read as fast as possible.

        Returns:
            The snapshots released by it, the earliest first.
        """
        self.counts["received"][exposure.camera] += 1
        if exposure.snapshot is not None or not self._has_leapt(exposure, now):
            self._add(exposure, now)
            return self.release_due()
        self.counts["clock_off"][exposure.camera] += 1
        self._leave_out(exposure)
        self._astray[exposure.camera] = exposure
        self._astray_in_a_row += 1
        believed = [waiting for waiting in self._astray.values() if abs(waiting.time - exposure.time) <= LEAP]
        if 2 * len(believed) <= len(self._active_cameras()) and self._astray_in_a_row < LONGEST_ASTRAY:
            return self.release_due()
        done = self.flush()
        self._reset()
        for waiting in sorted(believed, key=lambda waiting: waiting.time):
            self.counts["clock_off"][waiting.camera] -= 1
            self._add(waiting, now)
        return done + self.release_due()

    def release_due(self, now: float | None = None) -> tuple[TimedSnapshot, ...]:
        """Release snapshots that are due.

        Args:
            now: s, this machine's clock while nothing comes; None if more exposures may wait to be read.
        """
        done: list[TimedSnapshot] = []
        while self._pending and self._is_complete(self._pending[0], now):
            done.append(self._has_continued(self._pending.pop(0)))
        return self._drop_unsynchronized(done)

    def flush(self) -> tuple[TimedSnapshot, ...]:
        """Release all unfinished snapshots."""
        pending, self._pending = self._pending, []
        return self._drop_unsynchronized([self._has_continued(snapshot) for snapshot in pending])

    def tolerance(self, name: str) -> float:
        """Maximum time (s) between time stamps of a snapshot with this camera.

        This is `Timing.tolerance`, but less than half the interval between the camera's exposures.
        """
        interval = self._rest(name, least=1)
        return self.timing.tolerance if math.isnan(interval) else min(self.timing.tolerance, MOST_TOLERANCE * interval)

    def _drop_unsynchronized(self, done: list[TimedSnapshot]) -> tuple[TimedSnapshot, ...]:
        """Remove the exposures of unsynchronized cameras: the object's pose at those times is unknown."""
        kept = []
        for snapshot in done:
            if len(snapshot.exposures) == 1 and (name := next(iter(snapshot.exposures))) in self.alone:
                self.counts["out_of_tolerance"][name] += 1
            else:
                kept.append(snapshot)
        return tuple(kept)

    def _add(self, exposure: Exposure, now: float) -> None:
        camera, before = exposure.camera, self._newest.get(exposure.camera, -math.inf)
        self._astray.pop(camera, None)
        self._astray_in_a_row = 0
        self._absent[camera] = 0
        self._offset[camera] = exposure.time - now
        self.counts["out_of_order"][camera] += exposure.time < before
        stamps = self._stamps[camera]
        repeats = exposure.time in stamps
        self._check.take(camera, now, exposure.time, bool(stamps), repeats and exposure.snapshot is None)
        if not repeats:  # a repetition says nothing about the interval
            stamps.append(exposure.time)
        self._newest[camera] = max(before, exposure.time)
        tolerance = self.tolerance(camera)
        pending = self._place(exposure, tolerance, now)
        if pending is None:
            self.counts["late"][camera] += 1
            self._leave_out(exposure)
        elif camera in pending.exposures:
            self.counts["duplicate"][camera] += 1
        else:
            self._check.use(camera)
            pending.add(exposure, tolerance)

    def _leave_out(self, exposure: Exposure) -> None:
        """Note how far off an exposure is that cannot be used."""
        if exposure.snapshot is None:
            self._check.leave_out(exposure.camera, exposure.time - self._latest())

    def _place(self, exposure: Exposure, tolerance: float, now: float) -> _Pending | None:
        """Find the snapshot of an exposure, or start a new one; None = it was released already."""
        name, time = exposure.snapshot, exposure.time
        near = [pending for pending in self._pending if pending.name == name]
        if name is None:
            near = [pending for pending in near if pending.includes(time, tolerance)]
        if near:
            return min(near, key=lambda pending: pending.distance(time))
        gone = self._gone
        if name in self._known or (
            name is None and gone is not None and (time <= gone.latest or gone.includes(time, tolerance))
        ):
            return None
        new = _Pending(name, now)
        later = [i for i, pending in enumerate(self._pending) if pending.name is None and pending.earliest > time]
        self._pending.insert(later[0] if name is None and later else len(self._pending), new)
        return new

    def _is_complete(self, pending: _Pending, now: float | None) -> bool:
        if len(self._pending) > MOST_PENDING or all(
            name in pending.exposures or not self._is_due(name, pending) for name in self._active_cameras()
        ):
            return True
        if pending.name is not None:
            return now is not None and now - pending.arrived > self.timing.patience
        clock = self._latest() if now is None else self._clock(now)
        return clock - pending.latest > self.timing.patience

    def _has_continued(self, pending: _Pending) -> TimedSnapshot:
        self._check.released += 1
        if pending.name is None:
            self._gone = replace(pending, exposures={})  # frames are large
        else:
            if len(self._names) == REMEMBERED:
                self._known.discard(self._names[0])
            self._names.append(pending.name)
            self._known.add(pending.name)
        for name in self.camera_names:
            if name not in pending.exposures and self._is_due(name, pending):
                self._absent[name] += 1
                self.counts["missing"][name] += 1
        for name in pending.exposures:
            self._alone[name] = self._alone[name] + 1 if self._is_beside(name, pending) else 0
        self.alone = tuple(name for name in self.camera_names if self._alone[name] >= ALONE)
        return pending.finished(self.leaps)

    def _rest(self, name: str, least: int = LEAST_INTERVALS) -> float:
        """Usual interval between a camera's exposures; nan = fewer than `least` intervals are known."""
        stamps = sorted(self._stamps[name])
        rests = sorted(later - earlier for earlier, later in itertools.pairwise(stamps))
        return rests[len(rests) // 2] if len(rests) >= least else math.nan

    def _nearest(self, name: str, pending: _Pending) -> float:
        """Time between a snapshot and the nearest of a camera's latest exposures."""
        return min((abs(stamp - pending.latest) for stamp in self._stamps[name]), default=math.inf)

    def _is_due(self, name: str, pending: _Pending) -> bool:
        """Tell whether a camera that sends less often than others was due for a snapshot."""
        between = (1 - EARLY) * self._rest(name) - min(pending.tolerance, self.tolerance(name))
        return pending.name is not None or not self._nearest(name, pending) < between

    def _is_beside(self, name: str, pending: _Pending) -> bool:
        """Tell whether a snapshot has one camera only, while others expose shortly before or after it."""
        if len(pending.exposures) > 1 or pending.name is not None:
            return False
        return any(
            self._nearest(other, pending) < NEIGHBOUR * self._rest(name) for other in self.camera_names if other != name
        )

    def _active_cameras(self) -> list[str]:
        """The cameras to wait for, including one that has just started: its rate is still unknown."""
        latest = max(self._newest.values(), default=0.0)
        return [name for name in self.camera_names if self._absent[name] < OUT_AFTER or self._begins(name, latest)]

    def _begins(self, name: str, latest: float) -> bool:
        few = len(self._stamps[name]) <= LEAST_INTERVALS
        return few and latest - self._newest.get(name, -math.inf) < BEGINNING

    def _latest(self) -> float:
        """Median of the active cameras' latest time stamps; of two, the later one: the other camera may be out."""
        stamps = sorted(self._newest[name] for name in self._active_cameras() if name in self._newest)
        return stamps[len(stamps) // 2] if stamps else math.nan

    def _clock(self, now: float) -> float:
        """Current time by the cameras' clocks: the median, of two the earlier one."""
        offsets = sorted(self._offset[name] for name in self._active_cameras() if name in self._offset)
        return now + offsets[(len(offsets) - 1) // 2] if offsets else math.nan

    def _has_leapt(self, exposure: Exposure, now: float) -> bool:
        return abs(exposure.time - self._clock(now)) > LEAP

    def _reset(self) -> None:
        self.leaps += 1
        self._newest.clear()
        self._check.left_out.clear()
        for stamps in self._stamps.values():
            stamps.clear()
        self._offset.clear()
        self._gone = None
