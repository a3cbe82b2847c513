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
    named = np.zeros((2, len(first), max(first.max(), second.max()) + 2), dtype=bool)
    cameras = np.arange(len(first))[:, None]
    named[0, cameras, first], named[1, cameras, second] = True, True  # label -1 lands in the last column
    return int(named[..., :-1].all(0).sum())


def moved_along(obj: CalibrationObject) -> None:
    return None
