"""Other labellings that might do as well: those of an object moved onto itself, wholly or in part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imgcal.objects import CalibrationObject


def conflicts(obj: CalibrationObject, first: NDArray[np.int64], second: NDArray[np.int64]) -> float:
    """Share of commonly labelled blobs that two labellings (C, N) call differently, up to the object's symmetry.

    Labellings without a common blob conflict entirely.
    """
    used = first >= 0
    least = 1.0
    for motion in obj.symmetries:
        # Fiducial i of the first labelling is fiducial permutation[i] of the second.
        other = second[:, motion.permutation]
        agree = int((used & (first == other)).sum())
        least = min(least, 1 - agree / max(_common(first, second), 1))
    return least


def _common(first: NDArray[np.int64], second: NDArray[np.int64]) -> int:
    """Number of blobs that both labellings name."""
    return sum(len(np.intersect1d(a[a >= 0], b[b >= 0])) for a, b in zip(first, second, strict=True))


def moved_along(obj: CalibrationObject) -> None:
    return None
