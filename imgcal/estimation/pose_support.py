"""Which snapshots show enough of the object to say where it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError

LEAST_BREADTH = 0.05
"""Breadth of what is left of an object, in parts of the whole object's: below, it turns about a line unseen."""

ON_A_LINE = "the labels that are left lie on one line, about which the object could be turned"


class UndeterminedPosesError(RefusedError):
    """Raise where labels leave the object's pose open in some snapshots, which can be done without."""

    def __init__(self, rows: Sequence[int]) -> None:
        """Keep the numbers of the snapshots, counted among those of the fit."""
        super().__init__(f"estimation: in {len(rows)} snapshots {ON_A_LINE}")
        self.rows = tuple(rows)


def require_poses(seen: NDArray[np.bool_], points: Tensor) -> None:
    """Make sure that what is `seen` (S, C, N) of an object's points (N, 3) is more than a line in every snapshot.

    Raises:
        UndeterminedPosesError: it is not; says in which.
    """
    posed = has_poses(seen, points)
    if not posed.all():
        raise UndeterminedPosesError(np.flatnonzero(~posed).tolist())


def has_poses(seen: NDArray[np.bool_], points: Tensor) -> NDArray[np.bool_]:
    """Tell in which snapshots what is `seen` (S, C, N) of an object's points (N, 3) is more than a line: (S,)."""
    shown, where = seen.any(1), points.detach().cpu().double().numpy()
    whole = _breadth(where)
    if whole > 0 and shown.all():
        return np.ones(len(seen), dtype=bool)
    # What is seen repeats itself: thousands of snapshots show few different parts of an object.
    parts, which = np.unique(shown, axis=0, return_inverse=True)
    broad = np.array([_breadth(where[part]) > LEAST_BREADTH * whole for part in parts], dtype=bool)
    return broad[which.reshape(-1)]


def _breadth(points: NDArray[np.float64]) -> float:
    """Second largest extent of some points (M, 3): zero on a line."""
    if len(points) < 3:
        return 0.0
    return float(np.linalg.svd(points - points.mean(0), compute_uv=False)[1])
