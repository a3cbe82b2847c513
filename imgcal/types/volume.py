"""`ConvexVolume`: the working volume of a rig."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError

Corner = tuple[float, float, float]
FLAT = 1e-6
"""Least thickness of a volume, relative to its length."""


@dataclass(frozen=True)
class ConvexVolume:
    """Working volume: the convex hull of points in the rig frame, for example a box.

    Examples:
        >>> room = ConvexVolume.box((-1000, -1000, 0), (1000, 1000, 2000))
        >>> len(room.points), room.low, room.high
        (8, (-1000.0, -1000.0, 0.0), (1000.0, 1000.0, 2000.0))
        >>> room.contains(np.array([[0.0, 0.0, 500.0], [0.0, 0.0, 2500.0]]))
        array([ True, False])
    """

    points: tuple[Corner, ...]  # mm in the rig frame, 4 or more, not all in one plane

    def __post_init__(self) -> None:
        """Refuse points that enclose no volume.

        Raises:
            InputError: fewer than four points, all in one plane, or a coordinate that is not finite.
        """
        points = tuple(tuple(float(value) for value in point) for point in self.points)
        object.__setattr__(self, "points", points)
        if len(points) < 4:
            raise InputError(f"volume: found {len(points)} points, expected 4 or more that enclose a volume")
        corners = np.array(points)
        if not np.isfinite(corners).all():
            raise InputError("volume: found a coordinate that is not finite, expected mm")
        spread = np.linalg.svd(corners - corners.mean(0), compute_uv=False)
        if not spread[2] > FLAT * spread[0]:
            raise InputError("volume: found points that all lie in one plane, expected ones that enclose a volume")

    @classmethod
    def box(cls, low: Corner, high: Corner) -> ConvexVolume:
        """Enclose a box between two opposite corners, mm.

        Raises:
            InputError: a coordinate of `low` is not below that of `high`.
        """
        if any(not a < b for a, b in zip(low, high, strict=True)):
            raise InputError(f"volume: found low {list(low)} and high {list(high)}, expected each low below its high")
        (x, y, z), (u, v, w) = low, high
        return cls(tuple((a, b, c) for a in (x, u) for b in (y, v) for c in (z, w)))

    @property
    def low(self) -> Corner:
        """Smallest x, y and z, mm."""
        x, y, z = np.array(self.points).min(0).tolist()
        return x, y, z

    @property
    def high(self) -> Corner:
        """Largest x, y and z, mm."""
        x, y, z = np.array(self.points).max(0).tolist()
        return x, y, z

    @property
    def is_box(self) -> bool:
        """Tell whether the volume is the box between `low` and `high`."""
        return len(self.points) == 8 and set(self.points) == set(ConvexVolume.box(self.low, self.high).points)

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which points (M, 3) mm are inside, with a small tolerance for rounding: (M,)."""
        slack = FLAT * float(np.ptp(np.array(self.points), axis=0).max())
        inside = np.all(points @ _planes(self.points)[:, :3].T + _planes(self.points)[:, 3] <= slack, axis=1)
        return np.asarray(inside)


@lru_cache(maxsize=16)
def _planes(points: tuple[Corner, ...]) -> NDArray[np.float64]:
    """Outward normals and offsets of the faces of the convex hull of points: (F, 4)."""
    from scipy.spatial import ConvexHull  # slow to import, and rarely needed

    return np.asarray(ConvexHull(np.array(points)).equations)
