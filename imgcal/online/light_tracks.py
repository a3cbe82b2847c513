"""Lights of a running rig from snapshot to snapshot: their numbers, static blobs, and shifted cameras.

All arrays have a fixed size, so that they can be saved.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_STILL = 32
"""Number of static blobs of each camera."""
STILL_PIXELS, STILL_SECONDS = 1.0, 2.0
"""Distance (px) and time (s) that define a static blob; the same time applies to how long it may be hidden."""
HIDDEN_SECONDS = 0.5
"""Time (s) for which a hidden light keeps its number."""
NEAR_MM = 100.0
"""Maximum distance (mm) between a light and its prediction for it to keep its number."""
PREDICTION_ERROR, ACCELERATION = 10.0, 50_000.0
"""Error of a light's prediction from its velocity: mm, and mm/s^2."""
UNKNOWN_SPEED = 5000.0
"""Speed (mm/s) of a light with unknown velocity."""
NEIGHBOUR, DIFFERENCE = 500.0, 2000.0
"""Distance (mm) from a light with known velocity within which a new light is assumed to move likewise, and the possible
difference of their velocities (mm/s)."""


@dataclass
class LightTracks:
    """Memory of N lights and C cameras.

    Examples:
        >>> tracks = LightTracks.of(lights=4, cameras=2)
        >>> tracks.number_lights(np.array([[0.0, 0.0, 500.0], [90.0, 0.0, 500.0]]), time=0.0)
        array([0, 1])
        >>> tracks.number_lights(np.array([[89.0, 0.0, 500.0], [0.0, 1.0, 500.0]]), time=0.1)
        array([1, 0])
    """

    place: Array  # (N, 3) mm, last position of each light; nan = the number is free
    velocity: Array  # (N, 3) mm/s; nan = unknown
    time: Array  # (N,) s, last time it was seen; -inf = the number was never used
    shift: Array  # (C, 2) px image shift of a camera relative to the lights' predictions by the others
    shift_at: Array  # (C, 2) px, predictions of such lights when the shift was first seen
    astray: Array  # (C,) s, time since which no image shift explains a camera's blobs; nan = not so
    still: Array = field(repr=False)  # (C, MOST_STILL, 4) px, px, s, s: a blob's place, start, end; nan

    @classmethod
    def of(cls, lights: int, cameras: int) -> LightTracks:
        """Start empty."""
        nothing = np.full((lights, 3), np.nan)
        return cls(
            nothing, nothing.copy(), np.full(lights, -np.inf), np.zeros((cameras, 2)), np.zeros((cameras, 2)),
            np.full(cameras, np.nan), np.full((cameras, MOST_STILL, 4), np.nan),
        )  # fmt: skip

    def number_lights(self, points: Array, time: float) -> NDArray[np.int64]:
        """Give each light (L, 3) mm its earlier number, or a free one: (L,); -1 if there are too many.

        Unused numbers are given out first, then those unused for the longest time.
        """
        since = time - self.time
        self.place[(since > HIDDEN_SECONDS) | (since < 0)] = np.nan
        velocity, reach = self._expected_velocity(points, since)
        expected = self.place + velocity * since[:, None]
        distance = np.linalg.norm(points[:, None] - expected, axis=-1)
        distance = np.where(distance < reach, distance, np.inf)  # and where there is no light
        number = np.full(len(points), -1, dtype=np.int64)
        hidden = self.time < self.time[np.isfinite(self.place[:, 0])].max(initial=-np.inf)
        seen = np.where(hidden, np.inf, distance)
        for _ in range(min(seen.shape)):
            light, known = np.unravel_index(int(seen.argmin()), seen.shape)
            if not np.isfinite(seen[light, known]):
                break
            number[light] = known
            seen[light], seen[:, known] = np.inf, np.inf
        # Recognize a light that was hidden only if the match is unique in both directions.
        may_be = np.isfinite(distance) & hidden & (number < 0)[:, None]
        which, again = np.nonzero(may_be & (may_be.sum(0) == 1) & (may_be.sum(1) == 1)[:, None])
        number[which] = again
        left = np.flatnonzero(~np.isin(np.arange(len(self.place)), number))
        left = left[np.lexsort((left, self.time[left], np.isfinite(self.place[left, 0])))]  # hidden ones last
        self.place[left[: (number < 0).sum()]] = np.nan
        free = iter(left[: (number < 0).sum()].tolist())
        for unnumbered in np.flatnonzero(number < 0).tolist():
            number[unnumbered] = next(free, -1)
        kept = number >= 0
        mine, there = number[kept], points[kept]
        passed = since[mine, None]
        was = np.isfinite(self.place[mine]) & (passed > 0)
        went = (there - self.place[mine]) / np.where(was, passed, 1.0)
        self.velocity[mine] = np.where(was, went, np.nan)
        self.place[mine], self.time[mine] = there, time
        return number

    def _expected_velocity(self, points: Array, since: Array) -> tuple[Array, Array]:
        """Velocity (N, 3) mm/s of each light, and the error (N,) mm of the position predicted from it.

        A light that has been seen once moves like its nearest neighbour. If no velocity is known, use the one with
        which most lights match.
        """
        alive = np.isfinite(self.place[:, 0])
        known = alive & np.isfinite(self.velocity[:, 0])
        velocity, reach = self.velocity.copy(), np.minimum(PREDICTION_ERROR + ACCELERATION / 2 * since**2, NEAR_MM)
        unknown = np.flatnonzero(alive & ~known)
        if known.any() and len(unknown):
            others = np.flatnonzero(known)
            away = np.linalg.norm(self.place[unknown, None] - self.place[others], axis=-1)
            near = away.min(1) < NEIGHBOUR
            velocity[unknown[near]] = self.velocity[others[away.argmin(1)[near]]]
            reach[unknown] = np.minimum(reach[unknown] + DIFFERENCE * since[unknown], NEAR_MM)
        elif len(unknown) and len(points):
            velocity[unknown] = self._common_velocity(points, unknown, since)
        alone = unknown[~np.isfinite(velocity[unknown, 0])]
        velocity[alone] = 0.0
        reach[alone] = np.minimum(PREDICTION_ERROR + UNKNOWN_SPEED * since[alone], NEAR_MM)
        return velocity, reach

    def _common_velocity(self, points: Array, rows: NDArray[np.int64], since: Array) -> Array:
        """Velocity (3,) mm/s that takes most of some lights to present lights; nan = none matches two."""
        passed = since[rows].max()
        shift = (points[:, None] - self.place[rows]).reshape(-1, 3)
        shift = shift[np.linalg.norm(shift, axis=1) < PREDICTION_ERROR + UNKNOWN_SPEED * passed]
        if not len(shift) or passed <= 0:
            return np.full(3, np.nan)
        moved = self.place[rows] + shift[:, None]  # (T, R, 3)
        there = np.linalg.norm(moved[:, :, None] - points, axis=-1).min(2) < PREDICTION_ERROR
        count = there.sum(1)
        best = int(np.lexsort((np.linalg.norm(shift, axis=1), -count))[0])
        return shift[best] / passed if count[best] >= 2 else np.full(3, np.nan)

    def mark_still(self, camera: NDArray[np.int64], uv: Array, lit: NDArray[np.bool_], time: float) -> None:
        """Track blobs (M,) that may be static; a light that three cameras agree on (`lit`) is not."""
        for c in np.unique(camera[~lit]).tolist():
            known = self.still[c]
            known[(time - known[:, 3] > STILL_SECONDS) | (known[:, 3] > time)] = np.nan
            for place in uv[(camera == c) & ~lit]:
                away = np.hypot(known[:, 0] - place[0], known[:, 1] - place[1])
                near = int(np.where(np.isnan(away), np.inf, away).argmin())
                if away[near] <= STILL_PIXELS:
                    known[near, 3] = time
                else:
                    empty = int(np.where(np.isnan(known[:, 3]), -np.inf, known[:, 3]).argmin())
                    known[empty] = place[0], place[1], time, time

    def is_still(self, camera: NDArray[np.int64], uv: Array) -> NDArray[np.bool_]:
        """Tell which blobs (M,) have been in place for so long that they are not moving lights."""
        known = np.where((self.still[..., 3] - self.still[..., 2] >= STILL_SECONDS)[..., None], self.still, np.inf)
        away = np.linalg.norm(known[camera, :, :2] - uv[:, None], axis=-1)
        return np.asarray((away <= STILL_PIXELS).any(1))
