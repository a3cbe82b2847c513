"""Does a camera expose at another time than the others? What its blobs are off along the object's motion tells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.detection import Frame
from imgcal.geometry import RigidTransform
from imgcal.monitoring import ClockSlip, MeasurementUpdate
from imgcal.online.events import Event
from imgcal.online.rig_state import RigState

MEMORY = 5.0
"""Seconds after which a residual counts for less, by a factor e."""
LONGEST = 0.2
"""Seconds between snapshots up to which the difference of predictions is a velocity."""
OFFSET_CHI2, LEAST = 40.0, 1e-3
"""Chi-squared (one degree of freedom, once in 10^9 independent looks by chance), and seconds, to tell an offset ..."""
LEAST_KNOWN = 1e-4
"""... and seconds from which it is reckoned with."""
INEXACT = 0.05
"""Share of an offset by which it must be otherwise to be told again."""
LEAST_MEMORY = 1.0
"""Seconds of motion before anything is told."""
LEAST_MOTION, LEAST_SIGMAS = 0.5, 5.0
"""Pixels, and standard deviations, by which blobs (their median) must move from a snapshot to the next one: less is the
noise of the pose, which goes with the residuals. Not predictions: they move with what is learnt about the rig, too."""
STEP, STEPS = 0.2, 3
"""Pixels by which a camera's image must be otherwise, and for how many snapshots, to begin it anew."""
LEAST_DETERMINED = 1e-6
"""Determinant, of ones on the diagonal, from which motion and shift are told apart."""
MOST_PIXELS = 50.0
"""Residuals beyond are wrong labels."""


class ClockOffsets:
    """Estimates when each camera exposes, against the median camera, and tells it.

    Residuals are explained by a time (the object's velocity in the image times it) and a constant shift of the image
    together: a camera that was bumped shifts its image the same way wherever the object goes.
    """

    name = "clock"

    def __init__(self, cameras: int) -> None:
        """Begin with nothing known."""
        self._normal, self._right = np.zeros((cameras, 3, 3)), np.zeros((cameras, 3))
        self._other = np.zeros(cameras, dtype=np.int64)  # snapshots in a row that are otherwise
        self._last: tuple[float, RigidTransform, NDArray[np.float64]] | None = None
        self._seconds = np.zeros(cameras)  # of motion that each has seen
        self._told = np.zeros(cameras)  # s, what was told last
        self.late = np.zeros(cameras)  # s by which cameras are known to expose later: blobs come as if in time
        self._period = math.nan

    def __call__(
        self, state: RigState, frames: Mapping[str, Frame | None] | None, absorbed: MeasurementUpdate | None
    ) -> Iterable[Event]:
        """See `SequentialTest`."""
        pose, last = state.rig_from_object, self._last
        places = self._places(state)
        self._last = None if pose is None else (state.time, pose, places)
        if last is None or pose is None or not 0 < state.time - last[0] <= LONGEST:
            return ()
        self._period = state.time - last[0]
        went = np.linalg.norm(places - last[2], axis=-1)
        went = went[np.isfinite(went)]
        least = max(LEAST_MOTION, LEAST_SIGMAS * float(np.median(state.detections.sigma)))
        if not len(went) or np.median(went) < least:
            return ()
        # Both by the rig as it is now: what is learnt about cameras is no motion.
        self._add(state, (state.predicted - self._predicted(state, last[1])) / self._period)
        offset, sigma = self.offsets()
        changed = np.abs(offset - self.late)
        sure = changed > np.maximum(math.sqrt(OFFSET_CHI2) * sigma, LEAST_KNOWN)
        sure &= self._seconds >= LEAST_MEMORY
        if not sure.any():
            return ()
        camera = int(np.argmax(np.where(sure, changed / sigma, 0.0)))  # one at a time: the others may lean on it
        evidence = float(changed[camera] / sigma[camera]) ** 2
        return self._adopt_offset(state, camera, float(offset[camera]), float(sigma[camera]), evidence)

    def adopt_slip(self, state: RigState, slip: ClockSlip, since: float) -> Iterable[Event]:
        """Take over a slip that was seen at once."""
        late = float(self.late[slip.camera] + slip.seconds)
        return self._adopt_offset(state, slip.camera, late, slip.sigma, slip.odds, since)

    def _adopt_offset(
        self, state: RigState, camera: int, late: float, sigma: float, evidence: float, since: float | None = None
    ) -> Iterable[Event]:
        """Reckon with an offset (s) from now on, and tell it if that is worth it."""
        self.late[camera] = late
        self._begin(camera)
        if abs(late - self._told[camera]) < LEAST + INEXACT * abs(late):
            return ()
        self._told[camera] = late
        return (self._event(state, camera, late, sigma, evidence, since),)

    def _begin(self, cameras: int | NDArray[np.bool_]) -> None:
        """Forget what cameras have shown."""
        self._normal[cameras], self._right[cameras] = 0.0, 0.0
        self._other[cameras], self._seconds[cameras] = 0, 0.0

    def offsets(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """By how much each camera exposes after the median one, and its standard deviation: (C,) s; nan = unknown."""
        power = np.diagonal(self._normal, axis1=1, axis2=2)
        scale = np.sqrt(np.maximum(power, 1e-30))
        scaled = self._normal / (scale[:, :, None] * scale[:, None])
        known = (power.min(1) > 0) & (np.linalg.det(scaled) > LEAST_DETERMINED)
        inverse = np.linalg.inv(np.where(known[:, None, None], scaled, np.eye(3)))
        offset = np.where(known, (inverse[:, 0] * self._right / scale).sum(1) / scale[:, 0], np.nan)
        sigma = np.where(known, np.sqrt(inverse[:, 0, 0]) / scale[:, 0], np.nan)
        # Most cameras are as late as is known: where half of them slipped together, what is known already stays.
        offset += self.late - (np.nanmedian(offset) if known.any() else 0.0)
        return offset, sigma

    @staticmethod
    def _places(state: RigState) -> NDArray[np.float64]:
        """Blobs by camera and fiducial: (C, N, 2) pixels, nan where there is none."""
        blobs, places = state.detections, np.full(state.predicted.shape, np.nan)
        rows = np.flatnonzero(blobs.fiducial >= 0)
        places[blobs.camera[rows], blobs.fiducial[rows]] = blobs.uv[rows]
        return places

    @staticmethod
    def _predicted(state: RigState, rig_from_object: RigidTransform) -> NDArray[np.float64]:
        """Where the rig puts the fiducials of an object elsewhere: (C, N, 2) pixels, nan out of view."""
        belief = state.belief
        points = rig_from_object.reshape(1).apply(belief.points_object)
        image = belief.rig.expand(1).project_values(points, belief.obj.radius)
        return np.where(image.visible[0].numpy()[..., None], image.uv[0].numpy(), np.nan)

    def _add(self, state: RigState, velocity: NDArray[np.float64]) -> None:
        """Add the residuals of a snapshot; `velocity` (C, N, 2) pixels a second."""
        keep = math.exp(-self._period / MEMORY)
        self._normal *= keep
        self._right *= keep
        self._seconds = self._seconds * keep + self._period
        blobs = state.detections
        rows = np.flatnonzero((blobs.fiducial >= 0) & blobs.usable)
        at = blobs.camera[rows], blobs.fiducial[rows]
        residual, sigma = np.full(velocity.shape, np.nan), np.full(velocity.shape[:2], np.nan)
        residual[at] = (blobs.uv + state.lag)[rows] - state.predicted[at]
        sigma[at] = blobs.sigma[rows]
        with np.errstate(invalid="ignore"):
            good = np.isfinite(velocity).all(-1) & (np.linalg.norm(residual, axis=-1) < MOST_PIXELS)
        # A camera in doubt sees the object elsewhere for whatever reason; only the others are late by little.
        good &= np.array([state.cameras.get(name) != "doubtful" for name in state.factory.camera_names])[:, None]
        good &= ~self._reset_changed(velocity, residual, sigma, good)[:, None]
        weight = np.where(good, 1 / np.square(sigma), 0.0)
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
        velocity: NDArray[np.float64],
        residual: NDArray[np.float64],
        sigma: NDArray[np.float64],
        good: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Tell which cameras no longer do what they did, bumped, or their clock slipped; begin anew those that stay so.

        The first such snapshots are left out: together with what was before they would be explained by any time.
        """
        scale = np.sqrt(np.maximum(np.diagonal(self._normal, axis1=1, axis2=2), 1e-30))
        scaled = self._normal / (scale[:, :, None] * scale[:, None])
        known = good.any(1) & (np.linalg.det(scaled) > LEAST_DETERMINED)
        solved = np.linalg.solve(np.where(known[:, None, None], scaled, np.eye(3)), (self._right / scale)[..., None])
        explained = solved[..., 0] / scale  # (C, 3): seconds and a shift
        off = residual - velocity * explained[:, None, :1] - explained[:, None, 1:]
        count = np.maximum(good.sum(1), 1)
        middle = _middle(np.where(good[..., None], off, np.inf), count)
        usual = _middle(np.where(good, sigma, np.inf)[..., None], count)[:, 0]
        with np.errstate(invalid="ignore"):
            other = known & (np.linalg.norm(middle, axis=1) > np.maximum(STEP, 6 * usual / np.sqrt(count)))
        self._other = np.where(other, self._other + 1, np.where(known, 0, self._other))
        anew = self._other >= STEPS
        self._begin(anew)
        return other & ~anew

    def _event(
        self, state: RigState, camera: int, offset: float, sigma: float, evidence: float, since: float | None = None
    ) -> Event:
        name = state.factory.camera_names[camera]
        how = "later" if offset > 0 else "earlier"
        message = f"{name} exposes {1e3 * abs(offset):.3g} +- {1e3 * sigma:.1g} ms {how} than the other cameras"
        if abs(offset) < max(LEAST, 3 * sigma):
            message = f"{name} exposes at the same time as the other cameras again"
        frames = (offset / self._period, sigma / self._period)
        return Event(state.time, state.snapshot, "clock_slip", name, since, None, *frames, "frames", evidence, message)

    def saved(self) -> dict[str, Any]:
        """See `SequentialTest`."""
        return {"told": self._told.tolist(), "late": self.late.tolist()}

    def restored(self, values: dict[str, Any]) -> None:
        """See `SequentialTest`."""
        told, late = (np.array(values[name], dtype=np.float64) for name in ("told", "late"))
        if not all(each.shape == self._told.shape and np.isfinite(each).all() for each in (told, late)):
            raise ValueError(f"{self.name}: expected seconds of {len(self._told)} cameras")
        self._told, self.late = told, late


def unsynchronized_event(camera: str, since: float, time: float, snapshot: int) -> Event:
    """Tell that a camera exposes at moments of its own, by how much nobody knows yet.

    Args:
        camera: its name.
        since: s since the epoch.
        time: s since the epoch, now.
        snapshot: number of the update.
    """
    message = f"{camera} sees the object at other moments than the other cameras, by how much is not known yet"
    return Event(time, snapshot, "clock_slip", camera, since, message=message)


def _middle(values: NDArray[np.float64], count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Median of the first `count` (C,) of values (C, N, D) when they are sorted: (C, D)."""
    ordered, rows = np.sort(values, axis=1), np.arange(len(values))
    return (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2
