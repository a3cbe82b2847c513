"""Is a camera getting dirty, or out of focus? Its blobs, second after second, against what they used to be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.monitoring import Cusum, MeasurementUpdate
from imgcal.online.events import Event, EventKind
from imgcal.online.rig_state import RigState
from imgcal.online.sightings import well_inside

BLOCK = 1.0
"""Seconds that are put together: neighbouring snapshots say the same."""
MISSING = 2
"""Number of the share of fiducials that are missing, after size and uncertainty of blobs."""
LEAST_VALUES = np.array((10, 10, 20))
"""Blobs in such a block from which its median counts, and fiducials from which the share of those that are missing is
nearly normal; where there are fewer, the next block is put to it."""
LEAST_SNAPSHOTS = 10
"""Snapshots of it: a few cameras a second make a block of many seconds."""
LONGEST = 60.0
"""Seconds after which what has been put together is forgotten: the object was away."""
LEARNT = 30
"""Blocks that say what is usual."""
RUN_LENGTH = 1e6
"""Blocks for one false alarm of a camera and value: eleven days in which it sees the object."""
LEAST_SPREAD = np.array((0.03, 0.15, 0.05))
"""Standard deviations of a block at least: size (3 %), uncertainty (15 %), share that is missing (5 %)."""
MOST_SPREADS = 4.0
"""Standard deviations by which one block counts at most: shares are not normal."""
CLEAN, CLEAN_BLOCKS = 1.5, 5
"""Standard deviations within which a value is as usual again, and for how many blocks it must be."""
SAID: tuple[tuple[EventKind, str], ...] = (
    ("defocused", "shows blobs that are larger than they used to be: out of focus"),
    ("dirty", "shows blobs that are fainter than they used to be: dirty, or badly lit"),
    ("dirty", "misses fiducials that other cameras see: dirty, or half covered"),
)


class ImageQuality:
    """Follows size and uncertainty of blobs, and the share that is missing, camera by camera.

    A blob is as large as its fiducial is near; its uncertainty says how bright it is against the noise.
    Page's cumulative sum of medians over a second is compared with the first half minute.
    """

    name = "image quality"

    def __init__(self, cameras: int) -> None:
        """Begin with cameras whose images are good."""
        self._cameras = cameras
        self._values = _nothing()  # of each thing that is watched: camera (M,), value (M,) of every snapshot
        self._began: float | None = None  # s, of the block ...
        self._snapshots = 0  # ... and how many there are in it
        self._count = np.zeros((3, cameras), dtype=np.int64)  # blocks that have been learnt
        self._sum, self._squares = np.zeros((3, cameras)), np.zeros((3, cameras))
        self._usual = np.zeros((3, cameras), dtype=np.int64)  # blocks in a row that are as usual
        self._bad = np.zeros((3, cameras), dtype=bool)
        self._good = np.zeros((3, cameras))  # s, until when nothing spoke for worse
        self._test = Cusum(3 * cameras, 1.0, RUN_LENGTH)

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """See `SequentialTest`."""
        if self._began is None:  # also after a start that goes on: what was before is not known to the second
            self._good[:] = state.time
        self._good = np.minimum(self._good, state.time)  # clocks may be set back
        if self._began is None or not 0 <= state.time - self._began < LONGEST:
            self._began, self._values = state.time, _nothing()
        events = self._judged(state) if state.time - self._began >= BLOCK else []
        if state.rig_from_object is not None:
            self._collect(state)
        return events

    def _collect(self, state: RigState) -> None:
        """Add the blobs of a snapshot."""
        assert state.rig_from_object is not None
        blobs, rig = state.detections, state.rig
        rows = np.flatnonzero((blobs.fiducial >= 0) & blobs.usable)
        camera, fiducial = blobs.camera[rows], blobs.fiducial[rows]
        points = state.rig_from_object.apply(state.belief.points_object)
        depth = rig.cam_from_rig.apply(points)[..., 2].numpy()[camera, fiducial]
        with np.errstate(invalid="ignore", divide="ignore"):
            size = np.log(blobs.radius[rows] * depth / rig.focal_length.mean(-1).numpy()[camera])
            sigma = np.log(blobs.sigma[rows] / depth)  # a lamp is as bright as it is near
        seen = np.zeros(state.predicted.shape[:2], dtype=bool)
        seen[camera, fiducial] = True
        inside = well_inside(state.predicted, rig)
        others_tell = (seen.sum(0) - seen >= 2) & seen.any(axis=1, keepdims=True)  # of a camera that is not out
        at = np.nonzero(inside & others_tell)
        missing = (~seen[at]).astype(np.float64)
        for kept, cameras, values in zip(self._values, (camera, camera, at[0]), (size, sigma, missing), strict=True):
            finite = np.isfinite(values)
            kept.append((cameras[finite], values[finite]))

    def _block(self) -> NDArray[np.float64]:
        """Put together what was collected, where it is enough, and keep the rest: (3, C), nan where it is not."""
        block = np.full((3, self._cameras), np.nan)
        for number, least in enumerate(LEAST_VALUES):
            if not self._values[number]:
                continue
            cameras, values = (np.concatenate(parts) for parts in zip(*self._values[number], strict=True))
            enough = np.bincount(cameras, minlength=self._cameras) >= least
            for camera in np.flatnonzero(enough):
                own = values[cameras == camera]
                block[number, camera] = own.mean() if number == MISSING else np.median(own)
            rest = ~enough[cameras]
            self._values[number] = [(cameras[rest], values[rest])]
        return block

    def _judged(self, state: RigState) -> list[Event]:
        """Compare a block with those before, and begin the next one."""
        block = self._block()
        self._began = state.time
        learning = np.isfinite(block) & (self._count < LEARNT)
        self._count += learning
        self._sum += np.where(learning, block, 0.0)
        self._squares += np.where(learning, np.square(np.nan_to_num(block)), 0.0)
        mean = self._sum / np.maximum(self._count, 1)
        spread = np.sqrt(np.maximum(self._squares / np.maximum(self._count, 1) - mean**2, 0.0))
        z = (block - mean) / np.maximum(spread, LEAST_SPREAD[:, None])
        z[(self._count < LEARNT) | learning] = np.nan
        risen = self._test.update(np.minimum(z, MOST_SPREADS).ravel()).reshape(z.shape)
        self._usual = np.where(np.isnan(z), self._usual, np.where(z < CLEAN, self._usual + 1, 0))
        events = self._told(state, risen & ~self._bad, self._bad & (self._usual >= CLEAN_BLOCKS), z)
        self._good = np.where(self._test.age.reshape(z.shape) == 0, state.time, self._good)
        return events

    def _told(
        self, state: RigState, worse: NDArray[np.bool_], better: NDArray[np.bool_], z: NDArray[Any]
    ) -> list[Event]:
        events, names = [], state.factory.camera_names
        was = self._bad.any(0)
        for number, camera in zip(*np.nonzero(worse), strict=True):
            kind, message = SAID[number]
            since = float(self._good[number, camera])
            events.append(
                Event(
                    state.time, state.snapshot, kind, names[camera], since, evidence=float(z[number, camera]),
                    message=f"{names[camera]} {message}",
                )
            )  # fmt: skip
        self._bad = (self._bad | worse) & ~better
        self._usual[worse] = 0
        for camera in np.flatnonzero(was & ~self._bad.any(0)):
            message = f"{names[camera]} shows blobs as it used to"
            events.append(Event(state.time, state.snapshot, "clean", names[camera], message=message))
        return events

    def saved(self) -> dict[str, Any]:
        """See `SequentialTest`."""
        return {
            "count": self._count.tolist(), "sum": self._sum.tolist(), "squares": self._squares.tolist(),
            "bad": self._bad.tolist(), "usual": self._usual.tolist(),
        }  # fmt: skip

    def restored(self, values: dict[str, Any]) -> None:
        """See `SequentialTest`."""
        shape = (3, self._cameras)
        kept = {name: np.array(values[name], dtype=np.float64) for name in ("count", "sum", "squares", "bad", "usual")}
        if any(array.shape != shape or not np.isfinite(array).all() for array in kept.values()):
            raise ValueError(f"{self.name}: expected numbers of {shape[1]} cameras")
        self._count, self._usual = kept["count"].astype(np.int64), kept["usual"].astype(np.int64)
        self._sum, self._squares, self._bad = kept["sum"], kept["squares"], kept["bad"] > 0


def _nothing() -> list[list[tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    return [[] for _ in SAID]
