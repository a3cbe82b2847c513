"""Marker files for biomechanics, C3D or TRC: the object's fiducials, or lights, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.online import LightPoints, LightTracks
from imgcal.types import CalibrationObject, CameraRig
from imgcal.watch.c3d_file import MASKED_CAMERAS, C3DFile
from imgcal.watch.poses import PoseRecord, PoseSink, UnwrittenError
from imgcal.watch.trc_file import TRCFile

TO_FIND_RATE = 32
"""Number of snapshots that determine the rate before anything is written."""
NEAR_WHOLE = 5e-4  # relative: rates this close to a whole number are rounded
WRITE_EVERY = 1.0  # s
AT_ONCE = 1024  # frames in one write, at most
LONGEST_GAP = 100_000  # frames
MOST_LIGHTS = 255
"""Maximum number of columns of lights in a file; beyond that, the column unused for the longest time is reused."""

Frame = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]  # points (N, 3), error (N,), cameras (N,)


class MarkerFile(PoseSink):
    """Writes the fiducials, or the lights, of every snapshot to a new file at a constant frame rate.

    Both formats have one rate for the whole file: the usual rate of the first snapshots. Missing snapshots become
    frames without markers. A marker that no camera saw is missing in its frame.

    Lights (`imgcal.load_object("lights")`) are called L1, L2, ... in the order in which they appear. A light hidden for
    less than half a second keeps its column; after that, it counts as a new one.
    """

    def __init__(self, path: Path, rig: CameraRig, obj: CalibrationObject) -> None:
        """Check that the file can be created.

        Raises:
            InputError: the file exists, or cannot be created.
        """
        if path.exists():
            raise InputError(f"{path}: already exists, expected a new file: each trial has its own")
        if not path.parent.is_dir():
            raise InputError(f"{path}: cannot be written: no folder {path.parent}")
        self._path, self._labels = path, marker_labels(obj)
        self._tracks = LightTracks.of(MOST_LIGHTS, rig.num_cameras) if obj.unknown_markers else None
        centres = rig.cam_from_rig.inverse().translation
        self._reach = 2 * float(centres.abs().max()) + 1000.0
        self._first: list[tuple[float, Frame]] = []  # snapshots before the rate is known, with their times
        self._file: C3DFile | TRCFile | None = None
        self._width = 0  # number of columns in the file
        self._rate, self._latest, self._written = 0.0, 0.0, time.monotonic()
        self._waiting: list[Frame | None] = []  # not written yet; None = a snapshot that is missing

    def send(self, record: PoseRecord) -> None:
        """See `PoseSink`."""
        frame = self._frame(record)
        if self._file is None:
            self._first.append((record.time, frame))
            if len(self._first) >= TO_FIND_RATE:
                self._begin()
            return
        self._add(record.time, frame)
        if time.monotonic() - self._written >= WRITE_EVERY:
            self._write()

    def close(self) -> None:
        """See `PoseSink`."""
        try:
            if self._first:
                self._begin()
            self._write()
        finally:
            if self._file is not None:
                self._file.close()

    def _begin(self) -> None:
        """Create the file, with the known rate; if that fails, the trial begins later."""
        first, self._first = self._first, []
        self._rate = usual_rate([moment for moment, _ in first])
        try:
            if self._path.suffix.lower() == ".c3d":
                self._file = C3DFile(self._path, self._labels, self._rate, self._reach)
            else:
                self._file = TRCFile(self._path, self._labels, self._rate)
        except OSError as error:
            raise UnwrittenError(str(error), len(first)) from error
        self._width = len(self._labels)
        self._latest = first[0][0] - 1.0 / self._rate
        for moment, frame in first:
            self._add(moment, frame)
        self._write()

    def _add(self, moment: float, frame: Frame) -> None:
        """Add a frame at its time, after an empty frame for each missed one."""
        steps = max(round((moment - self._latest) * self._rate), 1)
        if steps > LONGEST_GAP:
            raise OSError(f"a gap of {steps:,} frames: start a new file")
        self._waiting += [None] * (steps - 1)
        self._waiting.append(frame)
        self._latest = moment

    def _write(self) -> None:
        """Write what waits; what cannot be written becomes a gap before the next frame.

        Raises:
            UnwrittenError: how many snapshots were lost.
        """
        waiting, self._waiting = self._waiting, []
        self._written = time.monotonic()
        try:
            while waiting and self._file is not None:
                if len(self._labels) > self._width:
                    self._file.widen(self._labels)
                    self._width = len(self._labels)
                wide = [self._widen(frame) for frame in waiting[:AT_ONCE]]
                points, error, cameras = (np.stack(part) for part in zip(*wide, strict=True))
                self._file.append(points, error, cameras)
                del waiting[:AT_ONCE]
        except (OSError, InputError) as problem:
            self._latest -= len(waiting) / self._rate
            raise UnwrittenError(str(problem), sum(frame is not None for frame in waiting)) from problem

    def _frame(self, record: PoseRecord) -> Frame:
        """The markers that were seen."""
        if record.lights is not None:
            return self._lights(record.time, record.lights)
        points, error, cameras = self._empty_frame()
        if record.pose is None or record.pose.seen is None:
            return points, error, cameras
        found, std = (values.numpy() for values in record.pose.points_rig())
        where = record.pose.seen.any(0)
        points[where], error[where] = found[where], std[where]
        return points, error, _camera_bits(record.pose.seen)

    def _lights(self, moment: float, lights: LightPoints) -> Frame:
        """Put lights into their columns; if only one light is possible, it goes into the first."""
        if self._tracks is None:
            column = np.arange(min(len(lights), 1))
        else:
            column = self._tracks.number_lights(lights.point, moment)
            count = max(len(self._labels), int(column.max(initial=-1)) + 1)
            self._labels = tuple(f"L{number}" for number in range(1, count + 1))
        points, error, cameras = self._empty_frame()
        rows = np.flatnonzero(column >= 0)
        column = column[rows]
        points[column], error[column] = lights.point[rows], lights.error[rows]
        cameras[column] = _camera_bits(lights.seen)[rows]
        return points, error, cameras

    def _empty_frame(self) -> Frame:
        count = len(self._labels)
        return np.full((count, 3), np.nan), np.zeros(count), np.zeros(count, dtype=np.int64)

    def _widen(self, frame: Frame | None) -> Frame:
        """Extend a frame to all present columns."""
        if frame is None:
            return self._empty_frame()
        missing = self._width - len(frame[0])
        filled = np.pad(frame[0], ((0, missing), (0, 0)), constant_values=np.nan)
        return filled, np.pad(frame[1], (0, missing)), np.pad(frame[2], (0, missing))


def _camera_bits(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Bits of the first cameras that saw each marker, from (C, N): (N,)."""
    bits = 2 ** np.arange(min(len(seen), MASKED_CAMERAS))
    return np.asarray((seen[: len(bits)] * bits[:, None]).sum(0))


def marker_labels(obj: CalibrationObject) -> tuple[str, ...]:
    """Names of the markers in the object, else `M` and their number in tables; the first light is `L1`."""
    if obj.unknown_markers:
        return ("L1",)
    return obj.fiducial_names or tuple(f"M{label}" for label in obj.labels or range(obj.num_fiducials))


def usual_rate(moments: Sequence[float]) -> float:
    """Frames per second, from the median step between snapshots; rounded if close to a whole number.

    Examples:
        >>> usual_rate([0.0, 0.01, 0.02, 0.05, 0.06]), usual_rate([5.0])
        (100.0, 1.0)
    """
    steps = np.diff(np.asarray(moments))
    steps = steps[steps > 0]
    if not len(steps):
        return 1.0
    rate = 1.0 / float(np.median(steps))
    whole = float(round(rate))
    return whole if whole and abs(rate - whole) <= NEAR_WHOLE * whole else rate
