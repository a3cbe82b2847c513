"""Detect cameras that expose at another time than the others, from residuals along the object's motion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.geometry import RigidTransform
from imgcal.medians import median, median_of_known
from imgcal.messages import plus_minus
from imgcal.monitoring import ClockSlip, MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import UNTRUSTED, RigState

# Residuals that count.
MEMORY_SECONDS = 5.0
"""Decay time (s, to 1/e) of a residual's weight."""
LONGEST_INTERVAL = 0.21
"""Maximum time (s) between snapshots for which the difference of predictions is a velocity: 5 Hz, with some room."""

# Offsets that are reported and corrected.
OFFSET_CHI2, LEAST = 40.0, 1e-3
"""Chi-squared (one degree of freedom; chance: once in 10^9 independent tests), and seconds, to report an offset ..."""
LEAST_KNOWN = 1e-4
"""... and seconds from which it is corrected."""
LEAST_CHANGE = 0.05
"""Relative change of an offset at which it is reported again."""
LEAST_MEMORY = 0.75
"""Seconds of motion that a camera must have seen before a report."""

# When motion and shift can be separated.
LEAST_MOTION, LEAST_SIGMAS = 0.5, 5.0
"""Pixels, and standard deviations, by which blobs (their median) must move between snapshots: less is noise of the
pose, which correlates with the residuals. Predictions would not do: they also move as the rig is learned."""
CAMERA_STEP, STEP_SNAPSHOTS = 0.2, 3
"""Change (px) of a camera's image, and number of snapshots that it must last, to restart that camera's estimate ..."""
LASTING_STEP = 2.0
"""... and the least change, relative to `RigState.persistent`."""
LEAST_DETERMINED = 1e-6
"""Minimum determinant, scaled to a unit diagonal, for separating motion and shift."""
MOST_PIXELS = 50.0
"""Larger residuals come from wrong labels."""


class ClockOffsets:
    """Estimates each camera's exposure time relative to the median camera, and reports offsets.

    Residuals are explained by a time offset (times the object's velocity in the image) and a constant image shift
    together: a camera that was bumped shifts its image the same way wherever the object goes.
    """

    name = "clock"
    STATE: ClassVar = {
        "normal": ("_normal", NDArray[np.float64]),
        "right": ("_right", NDArray[np.float64]),
        "other": ("_other", NDArray[np.int64]),
        "seconds": ("_seconds", NDArray[np.float64]),
        "told": ("_told", NDArray[np.float64]),
        "late": ("late", NDArray[np.float64]),
        "period": ("_period", float),
        "last": ("_last", tuple[float, RigidTransform, NDArray[np.float64]] | None),
    }

    def __init__(self, cameras: int) -> None:
        """Start without knowledge."""
        self._normal, self._right = np.zeros((cameras, 3, 3)), np.zeros((cameras, 3))
        self._other = np.zeros(cameras, dtype=np.int64)  # successive snapshots that differ
        self._last: tuple[float, RigidTransform, NDArray[np.float64]] | None = None
        self._seconds = np.zeros(cameras)  # of motion seen by each camera
        self._told = np.zeros(cameras)  # s, as last reported
        self.late = np.zeros(cameras)  # s of known delay: blobs are corrected for it
        self._period = math.nan
        self._solved: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # offsets of the present data

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """See `SequentialTest`."""
        lost = np.array([state.cameras.get(name) == "lost" for name in state.factory.camera_names])
        if self.late[lost].any():  # what is wrong with such a camera may have passed for a delay
            self.late[lost] = self._told[lost] = 0.0
            self._begin(lost)
        pose, last = state.rig_from_object, self._last
        places = self._places(state)
        self._last = None if pose is None else (state.time, pose, places)
        if last is None or pose is None or not 0 < state.time - last[0] <= LONGEST_INTERVAL:
            return ()
        self._period = state.time - last[0]
        went = np.linalg.norm(places - last[2], axis=-1)
        went = went[np.isfinite(went)]
        least = max(LEAST_MOTION, LEAST_SIGMAS * median(state.detections.sigma))
        if not len(went) or median(went) < least:
            return ()
        # Use the current rig for both: what is learned about cameras is no motion.
        self._add(state, (state.predicted - self._predict(state, last[1])) / self._period)
        offset, sigma = self.offsets()
        changed = np.abs(offset - self.late)
        sure = changed > np.maximum(math.sqrt(OFFSET_CHI2) * sigma, LEAST_KNOWN)
        sure &= self._seconds >= LEAST_MEMORY
        if not sure.any():
            return ()
        camera = int(np.argmax(np.where(sure, changed / sigma, 0.0)))  # one at a time: the others may depend on it
        evidence = float(changed[camera] / sigma[camera]) ** 2
        return self._adopt_offset(state, camera, float(offset[camera]), float(sigma[camera]), evidence)

    def adopt_slip(self, state: RigState, slip: ClockSlip, since: float) -> Iterable[Event]:
        """Adopt a clock slip that was found at once."""
        late = float(self.late[slip.camera] + slip.seconds)
        return self._adopt_offset(state, slip.camera, late, slip.sigma, slip.odds, since)

    def _adopt_offset(
        self, state: RigState, camera: int, late: float, sigma: float, evidence: float, since: float | None = None
    ) -> Iterable[Event]:
        """Correct an offset (s) from now on, and report it if significant."""
        self.late[camera] = late
        self._begin(camera)
        if abs(late - self._told[camera]) < LEAST + LEAST_CHANGE * abs(late):
            return ()
        self._told[camera] = late
        return (self._event(state, camera, late, sigma, evidence, since),)

    def _begin(self, cameras: int | NDArray[np.bool_]) -> None:
        """Discard the data of some cameras."""
        self._normal[cameras], self._right[cameras], self._solved = 0.0, 0.0, None
        self._other[cameras], self._seconds[cameras] = 0, 0.0

    def offsets(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Delay of each camera relative to the median one, and its standard deviation: (C,) s; nan = unknown."""
        if self._solved is None:
            self._solved = self._solve()
            for part in self._solved:
                part.setflags(write=False)  # states share them
        return self._solved

    def _solve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Do the work of `offsets`."""
        power = np.diagonal(self._normal, axis1=1, axis2=2)
        scale = np.sqrt(np.maximum(power, 1e-30))
        scaled = self._normal / (scale[:, :, None] * scale[:, None])
        known = (power.min(1) > 0) & (np.linalg.det(scaled) > LEAST_DETERMINED)
        inverse = np.linalg.inv(np.where(known[:, None, None], scaled, np.eye(3)))
        offset = np.where(known, (inverse[:, 0] * self._right / scale).sum(1) / scale[:, 0], np.nan)
        sigma = np.where(known, np.sqrt(inverse[:, 0, 0]) / scale[:, 0], np.nan)
        # Most cameras keep their known delay. If half of them slip together, the known delays stay.
        offset += self.late - (median_of_known(offset) if known.any() else 0.0)
        return offset, sigma

    @staticmethod
    def _places(state: RigState) -> NDArray[np.float64]:
        """Blobs by camera and fiducial: (C, N, 2) pixels, nan where there is none."""
        blobs, places = state.detections, np.full(state.predicted.shape, np.nan)
        rows = np.flatnonzero(blobs.fiducial >= 0)
        places[blobs.camera[rows], blobs.fiducial[rows]] = blobs.uv[rows]
        return places

    @staticmethod
    def _predict(state: RigState, rig_from_object: RigidTransform) -> NDArray[np.float64]:
        """Project the fiducials of an object in another pose: (C, N, 2) pixels, nan out of view."""
        belief = state.belief
        image = belief.rig.project_values(rig_from_object.reshape().apply(belief.points_object), belief.obj.radius)
        return np.where(image.visible.numpy()[..., None], image.uv.numpy(), np.nan)

    def _add(self, state: RigState, velocity: NDArray[np.float64]) -> None:
        """Add the residuals of a snapshot; `velocity` (C, N, 2) pixels a second."""
        keep, self._solved = math.exp(-self._period / MEMORY_SECONDS), None
        self._normal *= keep
        self._right *= keep
        self._seconds *= keep
        blobs = state.detections
        rows = np.flatnonzero((blobs.fiducial >= 0) & blobs.usable)
        at = blobs.camera[rows], blobs.fiducial[rows]
        residual, sigma = np.full(velocity.shape, np.nan), np.full(velocity.shape[:2], np.nan)
        residual[at] = (blobs.uv + state.lag)[rows] - state.predicted[at]
        sigma[at] = blobs.sigma[rows]
        with np.errstate(invalid="ignore"):
            good = np.isfinite(velocity).all(-1) & (np.linalg.norm(residual, axis=-1) < MOST_PIXELS)
        # Leave out untrusted cameras: their residuals have other causes than a small delay.
        good &= np.array([state.cameras.get(name) not in UNTRUSTED for name in state.factory.camera_names])[:, None]
        good &= ~self._reset_changed(state, velocity, residual, sigma, good)[:, None]
        self._seconds += np.where(good.any(1), self._period, 0.0)
        # Counts labels of one camera as independent, so each carries its share of the shift that they have in common.
        shared = good.sum(1, keepdims=True) * np.square(state.persistent)[:, None]
        weight = np.where(good, 1 / (np.square(sigma) + shared), 0.0)
        motion, residual = np.where(good[..., None], velocity, 0.0), np.where(good[..., None], residual, 0.0)
        total, shift = weight.sum(1), np.einsum("cn,cni->ci", weight, motion)
        self._normal[:, 0, 0] += np.einsum("cn,cni,cni->c", weight, motion, motion)
        self._normal[:, 0, 1:] += shift
        self._normal[:, 1:, 0] += shift
        self._normal[:, [1, 2], [1, 2]] += total[:, None]
        self._right[:, 0] += np.einsum("cn,cni,cni->c", weight, motion, residual)
        self._right[:, 1:] += np.einsum("cn,cni->ci", weight, residual)

    def _reset_changed(
        self,
        state: RigState,
        velocity: NDArray[np.float64],
        residual: NDArray[np.float64],
        sigma: NDArray[np.float64],
        good: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Find the cameras that were bumped or whose clock slipped; restart the estimates of those that stay so.

        The first such snapshots are left out: together with the earlier ones, any time offset would explain them.
        """
        scale = np.sqrt(np.maximum(np.diagonal(self._normal, axis1=1, axis2=2), 1e-30))
        scaled = self._normal / (scale[:, :, None] * scale[:, None])
        known = good.any(1) & (np.linalg.det(scaled) > LEAST_DETERMINED)
        solved = np.linalg.solve(np.where(known[:, None, None], scaled, np.eye(3)), (self._right / scale)[..., None])
        explained = solved[..., 0] / scale  # (C, 3): time offset and shift
        off = residual - velocity * explained[:, None, :1] - explained[:, None, 1:]
        count = np.maximum(good.sum(1), 1)
        middle = _middle(np.where(good[..., None], off, np.inf), count)
        usual = _middle(np.where(good, sigma, np.inf)[..., None], count)[:, 0]
        with np.errstate(invalid="ignore"):
            least = np.maximum(CAMERA_STEP, np.maximum(6 * usual / np.sqrt(count), LASTING_STEP * state.persistent))
            other = known & (np.linalg.norm(middle, axis=1) > least)
        self._other = np.where(other, self._other + 1, np.where(known, 0, self._other))
        restarted = self._other >= STEP_SNAPSHOTS
        self._begin(restarted)
        return other & ~restarted

    def _event(
        self, state: RigState, camera: int, offset: float, sigma: float, evidence: float, since: float | None = None
    ) -> Event:
        name = state.factory.camera_names[camera]
        how = "later" if offset > 0 else "earlier"
        message = f"{name} exposes {plus_minus(1e3 * abs(offset), 1e3 * sigma)} ms {how} than the other cameras"
        if abs(offset) < max(LEAST, 3 * sigma):
            message = f"{name} exposes at the same time as the other cameras again"
        frames = (offset / self._period, sigma / self._period)
        return Event(state.time, state.snapshot, "clock_slip", name, since, None, *frames, "frames", evidence, message)


def unsynchronized_event(camera: str, since: float, time: float, snapshot: int) -> Event:
    """Report an unsynchronized camera whose offset is unknown.

    Args:
        camera: its name.
        since: s since the epoch.
        time: s since the epoch, now.
        snapshot: number of the update.
    """
    message = f"{camera} is not synchronized with the other cameras; its time offset is not known yet"
    return Event(time, snapshot, "clock_slip", camera, since, message=message)


def _middle(values: NDArray[np.float64], count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Median of the first `count` (C,) of values (C, N, D) when they are sorted: (C, D)."""
    ordered, rows = np.sort(values, axis=1), np.arange(len(values))
    return (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2
