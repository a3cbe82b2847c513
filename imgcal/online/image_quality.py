"""Detect dirt and defocus by comparing a camera's blobs with earlier ones at the same place."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.medians import median_of_known
from imgcal.monitoring import Cusum, MeasurementUpdate
from imgcal.online.camera_visibility import well_inside
from imgcal.online.events import Event, EventKind
from imgcal.online.rig_state import RigState

Array = NDArray[np.float64]

# Blocks of snapshots, which are averaged.
BLOCK_SECONDS = 1.0
"""Duration of a block, whose snapshots are averaged."""
INTERVAL = 0.06
"""Minimum time between evaluated snapshots: more of them add nothing."""
LEAST_FIDUCIALS = np.array((10.0, 10.0, 20.0))
"""Minimum number of fiducials in a block, for each measure; a block with fewer continues."""
LONGEST_BLOCK = 60.0
"""Age (s) at which an unfinished block is discarded: the object was away."""
CORRELATION_SECONDS = 4.0
"""Time constant of what place and distance do not explain: arms in front, motion blur, the object's attitude. On the
ten-camera stream the autocorrelation at one second is below 0.3 for nine cameras and 0.6 for the tenth."""

# What place and distance explain.
TERM_CENTRES = (-2 / 3, 0.0, 2 / 3)
"""Centres of the local terms across and down the image, relative to its centre, in half image sizes ..."""
TERM_WIDTH = 0.5
"""... and the standard deviation of each."""
FEATURES = 1 + len(TERM_CENTRES) ** 2 + 2 + 3  # constant, local terms, log distance and its square, direction

# What is known beforehand, and how it is learned.
LEAST_SPREAD = np.array((0.03, 0.15, 0.1))
"""Minimum standard deviations of a block: size (3 %), sigma (15 %), share missing (0.1, on the real stream)."""
PRIOR = np.array(((10.0, 0.1, 0.3, 0.1), (10.0, 0.5, 2.0, 0.5), (0.3, 0.2, 0.2, 0.2)))
"""Prior standard deviations of the coefficients of each measure: constant, local terms, distance, direction."""
PRIOR_BLOCKS = 20
"""Weight of the prior `LEAST_SPREAD`, in blocks."""
MEMORY_BLOCKS = 600
"""Number of blocks over which the spread is averaged."""
LEARNT = 0.1
"""A place is known if the variance of its expected value is below this, in variances of a block. Only known places are
tested; nothing is learned there, so that slow changes are not absorbed."""
SUSPICION = 0.3
"""Share of the alarm threshold above which nothing is learned: it may be the fault itself."""

# The test.
RUN_LENGTH = 1e7
"""Mean number of blocks between false alarms of a camera and measure, if blocks were normal: four months in view."""
SUBTRACTED = 0.5
"""Standard deviations that are subtracted from each block."""
MOST_SPREADS = np.array((4.0, 4.0, 1.0))
"""Maximum number of standard deviations that one block counts for. An arm hides fiducials for seconds, dirt until it is
cleaned: evidence for missing fiducials grows with time alone, and suffices after half a minute."""
SHARED_CAMERAS = 4
"""Minimum number of cameras for a shared effect (a fast object, a hand, a weak lamp) to be blamed on none of them."""
CLEAN, CLEAN_BLOCKS = 1.5, 5
"""Standard deviations below which a block is normal, and how many such blocks in a row end an alarm."""
MESSAGES: tuple[tuple[EventKind, str], ...] = (
    ("defocused", "shows larger blobs than it used to: out of focus"),
    ("dirty", "shows fainter blobs than it used to: dirty, or badly lit"),
    ("dirty", "misses fiducials that other cameras see: dirty, or half covered"),
)


class ImageQuality:
    """Tracks three measures of each camera: size and sigma of its blobs, and the share of fiducials that it misses.

    Each is averaged over a second and compared with a regression on the object's place in the image, its distance and
    the viewing direction, learned from the camera's own history. New places are learned, known ones are tested. The
    remainder is correlated in time, so its innovations feed Page's cumulative sum.
    """

    name = "image quality"
    STATE: ClassVar = {
        "began": ("_began", float | None),
        "collected": ("_collected", float),
        "bad": ("_bad", NDArray[np.bool_]),
        "test": ("_test", Cusum),
        **{
            name: (f"_{name}", Array)
            for name in (
                "distance", "count", "sum", "place", "last_time", "last_value", "last_place", "coefficients",
                "covariance", "variance", "blocks", "usual", "good",
            )
        },
    }  # fmt: skip

    def __init__(self, cameras: int) -> None:
        """Start with cameras whose images are good."""
        shape = (3, cameras)
        self._distance = np.zeros(cameras)  # log mm, first distance; 0 = object not seen yet
        self._began: float | None = None  # s, start of the block
        self._collected = -math.inf  # s, its last snapshot
        self._count = np.zeros(shape)  # fiducials in the block ...
        self._sum, self._place = np.zeros(shape), np.zeros((*shape, FEATURES))  # ... sums of values and of features
        self._last_time = np.full(shape, -1e9)  # s, of the last block ...
        self._last_value, self._last_place = np.zeros(shape), np.zeros((*shape, FEATURES))  # ... and its contents
        self._coefficients = np.zeros((*shape, FEATURES))
        self._covariance = np.broadcast_to(_prior()[:, None], (*shape, FEATURES, FEATURES)).copy()
        self._variance = np.repeat(LEAST_SPREAD[:, None] ** 2, cameras, 1)  # of a block
        self._blocks = np.zeros(shape)
        self._usual = np.zeros(shape)  # successive normal blocks
        self._bad = np.zeros(shape, dtype=bool)
        self._good = np.zeros(shape)  # s, last time without a sign of a fault
        self._test = Cusum(3 * cameras, SUBTRACTED, RUN_LENGTH)

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """See `SequentialTest`."""
        if self._began is None:
            self._good[:] = state.time
        self._good = np.minimum(self._good, state.time)  # clocks may be set back
        if self._began is None or not 0 <= state.time - self._began < LONGEST_BLOCK:
            self._began = state.time
            self._discard(np.ones_like(self._bad))
        events = []
        if state.time - self._began >= BLOCK_SECONDS:
            events = self._judge(state)
            self._began = state.time
        if state.rig_from_object is not None and not 0 <= state.time - self._collected < INTERVAL:
            self._collected = state.time
            self._collect(state)
        return events

    def _collect(self, state: RigState) -> None:
        """Add a snapshot to the block."""
        assert state.rig_from_object is not None
        blobs, rig, shape = state.detections, state.rig, state.predicted.shape[:2]
        points = rig.cam_from_rig.apply(state.rig_from_object.apply(state.belief.points_object)).numpy()
        rows = np.flatnonzero((blobs.fiducial >= 0) & blobs.usable)
        at = blobs.camera[rows], blobs.fiducial[rows]
        measured = np.full((2, *shape), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            size = blobs.radius[rows] * points[..., 2][at] / rig.focal_length.mean(-1).numpy()[at[0]]
            measured[0][at], measured[1][at] = np.log(size), np.log(blobs.sigma[rows])
        value, count = np.zeros((3, shape[0])), np.zeros((3, shape[0]))
        count[:2], value[:2] = _medians(measured)
        seen = np.zeros(shape, dtype=bool)
        seen[at] = True
        others_tell = (seen.sum(0) - seen >= 2) & seen.any(axis=1, keepdims=True)  # for a camera with data
        inside = well_inside(state.predicted, rig)
        asked = inside & others_tell
        unlabelled = np.bincount(blobs.camera[blobs.fiducial < 0], minlength=shape[0])  # each may be one of these
        count[2] = asked.sum(1)
        value[2] = np.maximum((asked & ~seen).sum(1) - unlabelled, 0) / np.maximum(count[2], 1)
        place = _place(state, points, inside, self._distance)
        count[:, ~np.isfinite(place).all(1)] = 0.0
        self._count += count
        self._sum += np.where(count > 0, count * value, 0.0)
        self._place += np.where(count[..., None] > 0, count[..., None] * place, 0.0)

    def _discard(self, which: NDArray[np.bool_]) -> None:
        """Restart the blocks of some measures and cameras."""
        self._count[which], self._sum[which], self._place[which] = 0.0, 0.0, 0.0

    def _judge(self, state: RigState) -> list[Event]:
        """Compare complete blocks with their expectation, and learn from them."""
        done = self._count >= LEAST_FIDUCIALS[:, None]
        total = np.maximum(self._count, 1)
        value, place = self._sum / total, self._place / total[..., None]
        self._discard(done)
        correlation = np.exp(-np.maximum(state.time - self._last_time, BLOCK_SECONDS) / CORRELATION_SECONDS)
        own = self._variance * (1 - correlation**2)  # of the innovation; after a long pause all of it
        step_place = place - correlation[..., None] * self._last_place
        step = value - correlation * self._last_value - (step_place * self._coefficients).sum(-1)
        spread = np.einsum("qcij,qcj->qci", self._covariance, step_place)
        variance = np.maximum((step_place * spread).sum(-1), 0.0) + own
        z = np.where(done, step / np.sqrt(variance), np.nan)
        level = value - (place * self._coefficients).sum(-1)
        unknown = np.einsum("qci,qcij,qcj->qc", place, self._covariance, place)
        usual = level < CLEAN * np.sqrt(self._variance + unknown)
        calm = self._test.value.reshape(done.shape) < SUSPICION * self._test.threshold
        learning = done & ~self._bad & calm & (unknown > LEARNT * self._variance)
        gain = np.where(learning[..., None], spread / variance[..., None], 0.0)
        self._coefficients += gain * step[..., None]
        self._covariance -= gain[..., None] * spread[..., None, :]
        self._blocks += done
        excess = np.where(done, np.minimum(z**2, 9.0) - 1.0, 0.0) / np.minimum(
            PRIOR_BLOCKS + self._blocks, MEMORY_BLOCKS
        )
        self._variance = np.maximum(self._variance * (1 + excess), LEAST_SPREAD[:, None] ** 2)
        self._last_time[done] = state.time
        self._last_value[done], self._last_place[done] = value[done], place[done]
        risen = self._test.update(np.minimum(_own_part(z), MOST_SPREADS[:, None]).ravel()).reshape(z.shape)
        self._usual = np.where(done, np.where(usual, self._usual + 1, 0), self._usual)
        events = self._report(state, risen & ~self._bad, self._bad & (self._usual >= CLEAN_BLOCKS), z)
        self._good = np.where(self._test.age.reshape(z.shape) == 0, state.time, self._good)
        return events

    def _report(self, state: RigState, worse: NDArray[np.bool_], better: NDArray[np.bool_], z: Array) -> list[Event]:
        """Make the events of measures that became worse, and of cameras that recovered."""
        events, names = [], state.factory.camera_names
        was = self._bad.any(0)
        for number, camera in zip(*np.nonzero(worse), strict=True):
            kind, message = MESSAGES[number]
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
            message = f"{names[camera]} shows its blobs as before"
            events.append(Event(state.time, state.snapshot, "clean", names[camera], message=message))
        return events


def _prior() -> Array:
    """Prior covariance of the coefficients of each measure: (3, F, F)."""
    std = np.repeat(PRIOR, (1, len(TERM_CENTRES) ** 2, 2, 3), axis=1)
    return std[..., None] ** 2 * np.eye(FEATURES)


def _medians(values: Array) -> tuple[NDArray[np.int64], Array]:
    """Count finite values along the last axis, and take their median; 0 if there are none."""
    finite = np.isfinite(values)
    count = finite.sum(-1)
    ordered = np.sort(np.where(finite, values, np.inf), axis=-1)
    middle = np.stack(((count - 1).clip(0) // 2, count // 2), axis=-1).clip(max=values.shape[-1] - 1)
    median = np.take_along_axis(ordered, middle, axis=-1).mean(-1)
    return count, np.where(count > 0, median, 0.0)


def _place(state: RigState, points: Array, inside: NDArray[np.bool_], reference: Array) -> Array:
    """Describe where each camera sees the object: (C, F); nan if it should not see it.

    Args:
        state: with a pose and predictions of the fiducials.
        points: (C, N, 3) mm, the fiducials in the frame of each camera.
        inside: (C, N), fiducials well inside the image.
        reference: (C,) logarithms of the first distances (mm); 0 = unknown, which is filled in.
    """
    rig, pose = state.rig, state.rig_from_object
    assert pose is not None
    count = inside.sum(1, keepdims=True)
    weight = (inside / np.where(count > 0, count, np.nan))[..., None]
    half = rig.image_size.numpy() / 2
    centre = (np.where(inside[..., None], state.predicted, 0.0) * weight).sum(1) / half - 1
    distance = np.log((points[..., 2:] * weight).sum((1, 2)))
    reference[:] = np.where(reference == 0, np.nan_to_num(distance), reference)
    far = (distance - reference)[:, None]
    local = [np.exp(-0.5 * np.square((axis[:, None] - TERM_CENTRES) / TERM_WIDTH)) for axis in centre.T]
    nearby = (local[0][:, :, None] * local[1][:, None, :]).reshape(len(points), -1)
    ray = (rig.positions - pose.apply(state.belief.points_object).mean(0)) @ pose.rotation
    direction = (ray / ray.norm(dim=-1, keepdim=True)).numpy()
    return np.concatenate((np.ones_like(far), nearby, far, far**2, direction), axis=1)


def _own_part(z: Array) -> Array:
    """Subtract the effect shared by most cameras from z (3, C), if there are enough cameras."""
    enough = np.isfinite(z).sum(1) >= SHARED_CAMERAS
    common = np.zeros(len(z))
    common[enough] = np.maximum(median_of_known(z[enough].T), 0.0)
    return z - common[:, None]
