"""Which snapshots show enough of the object to say where it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.geometry import pose_rank

LEAST_BREADTH = 0.05
"""Breadth of what is left of an object, in parts of the whole object's: below, it turns about a line unseen."""

ON_A_LINE = "the labels that are left lie on one line, about which the object could be turned"
TOO_FEW = "fewer than {} have labels in two cameras"


class UndeterminedPosesError(RefusedError):
    """Raise where labels leave the object's pose open in some snapshots, which can be done without."""

    def __init__(self, rows: Sequence[int], reason: str = ON_A_LINE) -> None:
        """Keep the numbers of the snapshots, counted among those of the fit."""
        super().__init__(f"estimation: in {len(rows)} snapshots {reason}")
        self.rows = tuple(rows)


def require_poses(seen: NDArray[np.bool_], points: Tensor, part_of: NDArray[np.int64] | None = None) -> None:
    """Make sure that what is `seen` (S, C, N) of an object's points (N, 3) shows its pose in every snapshot.

    That is more than a line; of a stick two points, of a light the one, each in two cameras.

    Args:
        seen: labels.
        points: of the object, or of several.
        part_of: (N,) the object to which each point belongs, where there are several; a row shows one of them.

    Raises:
        UndeterminedPosesError: it is not; says in which.
    """
    posed = has_poses(seen, points, part_of)
    if not posed.all():
        rows = np.flatnonzero(~posed).tolist()
        least = None if part_of is not None else _least_fiducials(pose_rank(points))
        if least is None:
            raise UndeterminedPosesError(rows)
        raise UndeterminedPosesError(rows, TOO_FEW.format("1 fiducial" if least == 1 else f"{least} fiducials"))


def _least_fiducials(rank: int) -> int | None:
    """Fiducials that two cameras must see of a light or a stick; None = other objects."""
    return None if rank == 6 else 2 if rank == 5 else 1


def has_poses(seen: NDArray[np.bool_], points: Tensor, part_of: NDArray[np.int64] | None = None) -> NDArray[np.bool_]:
    """Tell in which snapshots what is `seen` (S, C, N) of an object's points (N, 3) determines its pose: (S,).

    With several objects (`part_of`, as in `require_poses`) one of them must be determined.
    """
    if part_of is not None:
        columns = [np.flatnonzero(part_of == part) for part in range(int(part_of.max()) + 1)]
        return np.any([has_poses(seen[..., own], points[own]) for own in columns], axis=0)
    least = _least_fiducials(pose_rank(points))
    if least is not None:
        enough: NDArray[np.bool_] = (seen.sum(1) >= 2).sum(1) >= least
        return enough
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
