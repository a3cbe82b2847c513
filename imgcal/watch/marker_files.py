"""Markers in a file for biomechanics: the object's fiducials, frame by frame, in C3D or TRC."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.types import CalibrationObject, CameraRig
from imgcal.watch.c3d_file import MASKED_CAMERAS, C3DFile
from imgcal.watch.poses import PoseRecord
from imgcal.watch.trc_file import TRCFile

TO_FIND_RATE = 32
"""Snapshots from whose times the rate is found, before anything is written."""
NEAR_WHOLE = 5e-4  # relative: a rate that is so near a whole number is that
WRITE_EVERY = 1.0  # s
LONGEST_GAP = 100_000  # frames

Frame = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]  # points (N, 3), error (N,), cameras (N,)


class MarkerFile:
    """Writes the fiducials of every snapshot to a new file, evenly spaced in time.

    Both formats have one rate for the whole file. It is the usual rate of the first snapshots; what is missing
    in between becomes frames without any marker. A marker that no camera saw is missing in its frame.
    """

    def __init__(self, path: Path, rig: CameraRig, obj: CalibrationObject) -> None:
        """Check that the file can be made.

        Raises:
            InputError: it exists, or cannot be made.
        """
        if path.exists():
            raise InputError(f"{path}: exists, expected a new file: a file of markers is one trial")
        if not path.parent.is_dir():
            raise InputError(f"{path}: cannot be written: no folder {path.parent}")
        self._path, self._labels = path, marker_labels(obj)
        centres = rig.cam_from_rig.inverse().translation
        self._reach = 2 * float(centres.abs().max()) + 1000.0
        self._first: list[tuple[float, Frame]] = []  # snapshots before the rate is known, with their times
        self._file: C3DFile | TRCFile | None = None
        self._rate, self._latest, self._written = 0.0, 0.0, time.monotonic()
        self._waiting: list[Frame] = []

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
        if self._file is None and self._first:
            self._begin()
        if self._file is not None:
            try:
                self._write()
            finally:
                self._file.close()

    def _begin(self) -> None:
        """Make the file, now that the rate is known."""
        self._rate = usual_rate([moment for moment, _ in self._first])
        if self._path.suffix.lower() == ".c3d":
            self._file = C3DFile(self._path, self._labels, self._rate, self._reach)
        else:
            self._file = TRCFile(self._path, self._labels, self._rate)
        self._latest = self._first[0][0] - 1.0 / self._rate
        for moment, frame in self._first:
            self._add(moment, frame)
        self._first = []
        self._write()

    def _add(self, moment: float, frame: Frame) -> None:
        """Put a frame where it belongs in time: after as many empty ones as were missed."""
        steps = max(round((moment - self._latest) * self._rate), 1)
        if steps > LONGEST_GAP:
            raise OSError(f"a gap of {steps:,} frames: begin a new file")
        self._waiting += [self._nothing()] * (steps - 1)
        self._waiting.append(frame)
        self._latest = moment

    def _write(self) -> None:
        waiting, self._waiting = self._waiting, []
        self._written = time.monotonic()
        if waiting and self._file is not None:
            points, error, cameras = (np.stack(part) for part in zip(*waiting, strict=True))
            self._file.append(points, error, cameras)

    def _frame(self, record: PoseRecord) -> Frame:
        """The fiducials that were seen."""
        points, error, cameras = self._nothing()
        if record.pose is None or record.pose.seen is None:
            return points, error, cameras
        found, std = (values.numpy() for values in record.pose.points_rig())
        seen = record.pose.seen
        where = seen.any(0)
        points[where], error[where] = found[where], std[where]
        bits = 2 ** np.arange(min(len(seen), MASKED_CAMERAS))
        return points, error, (seen[: len(bits)] * bits[:, None]).sum(0)

    def _nothing(self) -> Frame:
        count = len(self._labels)
        return np.full((count, 3), np.nan), np.zeros(count), np.zeros(count, dtype=np.int64)


def marker_labels(obj: CalibrationObject) -> tuple[str, ...]:
    """What the fiducials are called in files of markers: by their names, else `M` and the number that tables have."""
    return obj.fiducial_names or tuple(f"M{label}" for label in obj.labels or range(obj.num_fiducials))


def usual_rate(moments: Sequence[float]) -> float:
    """Frames a second, by the median of the steps between snapshots; whole where it is nearly so.

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
