"""Snapshots whose labels determine the object's pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.geometry import pose_rank
from imgcal.messages import plural

Parts: TypeAlias = NDArray[np.int64] | Tensor | None

LEAST_POSE_LABELS = 4
"""Labels that determine the pose of a solid object, in all cameras together: three fit some pose exactly."""
LEAST_BREADTH = 0.05
"""Breadth of the visible part, relative to the whole object's: below, a rotation about a line is undetermined."""

UNPOSED = "fewer than four labels remain, or all lie on one line"
TOO_FEW = "two cameras share labels of fewer than {}"


class UndeterminedPosesError(RefusedError):
    """Raise when labels do not determine the object's pose in some snapshots; the caller can drop those."""

    def __init__(self, rows: Sequence[int], reason: str = UNPOSED) -> None:
        """Keep the indices of the snapshots among those of the fit, and the reason."""
        super().__init__(f"estimation: in {plural(len(rows), 'snapshot')} {reason}")
        self.rows, self.reason = tuple(rows), reason


def require_poses(seen: NDArray[np.bool_], points: Tensor, part_of: Parts = None) -> None:
    """Require that the labels `seen` (S, C, N) of an object's points (N, 3) determine its pose in every snapshot.

    A solid object needs points off a line, and four labels. A stick needs two points and a light its one, each in two
    cameras.

    Args:
        seen: whether each point has a label.
        points: of the object, or of several.
        part_of: (N,) the object to which each point belongs, for several objects; each row shows one of them.

    Raises:
        UndeterminedPosesError: some poses are undetermined; it has their rows.
    """
    posed = has_poses(seen, points, part_of)
    if not posed.all():
        rows = np.flatnonzero(~posed).tolist()
        least = None if part_of is not None else _least_fiducials(pose_rank(points))
        if least is None:
            raise UndeterminedPosesError(rows)
        raise UndeterminedPosesError(rows, TOO_FEW.format(plural(least, "fiducial")))


def _least_fiducials(rank: int) -> int | None:
    """Number of fiducials of a light or a stick that two cameras must see; None = other objects."""
    return None if rank == 6 else 2 if rank == 5 else 1


def has_poses(seen: NDArray[np.bool_], points: Tensor, part_of: Parts = None) -> NDArray[np.bool_]:
    """Find the snapshots in which labels `seen` (S, C, N) of an object's points (N, 3) determine its pose: (S,).

    With several objects (`part_of`, as in `require_poses`), at least one of them must be determined.
    """
    if part_of is not None:
        part_of = np.asarray(part_of)
        columns = [np.flatnonzero(part_of == part) for part in range(int(part_of.max()) + 1)]
        return np.any([has_poses(seen[..., own], points[own]) for own in columns], axis=0)
    least = _least_fiducials(pose_rank(points))
    if least is not None:
        enough: NDArray[np.bool_] = (seen.sum(1) >= 2).sum(1) >= least
        return enough
    shown, where = seen.any(1), points.detach().cpu().double().numpy()
    whole, enough = breadth(where), seen.sum((1, 2)) >= LEAST_POSE_LABELS
    if whole > 0 and shown.all():
        return enough
    # Patterns repeat: thousands of snapshots show only a few different parts of an object.
    parts, which = np.unique(shown, axis=0, return_inverse=True)
    broad = np.array([breadth(where[part]) > LEAST_BREADTH * whole for part in parts], dtype=bool)
    return enough & broad[which.reshape(-1)]


def breadth(points: NDArray[np.float64]) -> float:
    """Second largest extent of points (M, 3): zero on a line."""
    if len(points) < 3:
        return 0.0
    return float(np.linalg.svd(points - points.mean(0), compute_uv=False)[1])
