"""Lights of a running rig from snapshot to snapshot: their numbers, blobs that never move, cameras that see them off.

Everything is an array of fixed size, so that it can be saved.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_STILL = 32
"""Blobs that never move, of each camera."""
STILL_PIXELS, STILL_SECONDS = 1.0, 2.0
"""How near to its place, and for how long, a blob must be that never moves; and how long it may then be hidden."""
LONGEST = 0.5
"""Seconds for which a light that is hidden keeps its number."""
NEAR = 100.0
"""Millimetres, at most, from where a light should be, within which it keeps its number."""


@dataclass
class LightTracks:
    """What is remembered of N lights and C cameras.

    Examples:
        >>> tracks = LightTracks.of(lights=4, cameras=2)
        >>> tracks.number_lights(np.array([[0.0, 0.0, 500.0], [90.0, 0.0, 500.0]]), time=0.0)
        array([0, 1])
        >>> tracks.number_lights(np.array([[89.0, 0.0, 500.0], [0.0, 1.0, 500.0]]), time=0.1)
        array([1, 0])
    """

    place: Array  # (N, 3) mm, where each light was last; nan = no light has the number
    velocity: Array  # (N, 3) mm/s
    time: Array  # (N,) s, when it was seen last
    shift: Array  # (C, 2) px by which a camera sees lights elsewhere than where the others say that they are
    shift_at: Array  # (C, 2) px, where such lights should have been when that was first seen
    astray: Array  # (C,) s, since when no shift of its image makes lights of what a camera sees; nan = it does not
    still: Array = field(repr=False)  # (C, MOST_STILL, 4) px, px, s, s: a blob's place, since when and until when; nan

    @classmethod
    def of(cls, lights: int, cameras: int) -> LightTracks:
        """Begin with nothing seen."""
        return cls(
            np.full((lights, 3), np.nan), np.zeros((lights, 3)), np.zeros(lights), np.zeros((cameras, 2)),
            np.zeros((cameras, 2)), np.full(cameras, np.nan), np.full((cameras, MOST_STILL, 4), np.nan),
        )  # fmt: skip

    def number_lights(self, points: Array, time: float) -> NDArray[np.int64]:
        """Give each light (L, 3) mm the number that it had, or a free one: (L,); -1 where there are too many."""
        since = time - self.time
        self.place[(since > LONGEST) | (since < 0)] = np.nan
        expected = self.place + self.velocity * since[:, None]
        distance = np.linalg.norm(points[:, None] - expected, axis=-1)
        distance = np.where(np.isfinite(distance), distance, np.inf)
        number = np.full(len(points), -1, dtype=np.int64)
        for _ in range(min(distance.shape)):
            light, known = np.unravel_index(int(distance.argmin()), distance.shape)
            if not distance[light, known] < NEAR:
                break
            number[light] = known
            distance[light], distance[:, known] = np.inf, np.inf
        left = np.flatnonzero(~np.isin(np.arange(len(self.place)), number))  # free ones first, then those long hidden
        hidden = np.isfinite(self.place[left, 0])
        left = left[np.lexsort((np.where(hidden, self.time[left], 0.0), hidden))]
        self.place[left[: (number < 0).sum()]] = np.nan
        free = iter(sorted(left[: (number < 0).sum()].tolist()))
        for unnumbered in np.flatnonzero(number < 0).tolist():
            number[unnumbered] = next(free, -1)
        kept = number >= 0
        mine, there = number[kept], points[kept]
        passed = since[mine, None]
        was = np.isfinite(self.place[mine]) & (passed > 0)
        went = (there - self.place[mine]) / np.where(was, passed, 1.0)
        self.velocity[mine] = np.where(was, went, 0.0)
        self.place[mine], self.time[mine] = there, time
        return number

    def mark_still(self, camera: NDArray[np.int64], uv: Array, lit: NDArray[np.bool_], time: float) -> None:
        """Follow blobs (M,) that may never move; a light that three cameras agree on (`lit`) is none of them."""
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
        """Tell which blobs (M,) have been where they are for so long that they are no lights that move."""
        known = np.where((self.still[..., 3] - self.still[..., 2] >= STILL_SECONDS)[..., None], self.still, np.inf)
        away = np.linalg.norm(known[camera, :, :2] - uv[:, None], axis=-1)
        return np.asarray((away <= STILL_PIXELS).any(1))
