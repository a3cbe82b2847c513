"""What a calibration says about the object, and where the data cannot carry it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import RefusedError
from imgcal.estimation import BENT, SNAPSHOTS_TO_BEND, Estimate, FiducialOffset, ScaleEvidence, ShapeEvidence, offsets
from imgcal.types import CalibrationObject

CERTAIN = 4.0
"""Standard deviations from which a fiducial is named as displaced."""
TOLERATED = 4.6
"""Times the tolerance of each coordinate: a displacement within it is longer once in ten thousand."""
MOST_DISPLACED = 0.15
"""Of the object's size: a fiducial that is farther from its place belongs to another object."""
LEAST_KNOWN = 0.005
"""Of the object's size: standard deviation of a displaced fiducial above which the data cannot carry it."""
LEAST_EXPECTED = 6
"""Views of a fiducial from which its absence is no chance."""
LOST = 0.5
"""Share of what is usual, below which a fiducial counts as lost."""
IN_PLACE = 1e-4
"""Of the object's size: a fiducial that is nearer to its place is in it."""


def object_offsets(
    fit: Estimate, shape: ShapeEvidence | ScaleEvidence | None, obj: CalibrationObject
) -> tuple[FiducialOffset, ...]:
    """Say how far each fiducial is from its place, and refuse where the data do not carry that.

    Args:
        fit: the estimate.
        shape: what its residuals still say about the object; None = not asked.
        obj: the object as its file has it.

    Returns:
        One offset a fiducial; empty where the object was taken as exact.

    Raises:
        RefusedError: the object is not what its file says, and what it is instead cannot be said.
    """
    measure = {
        "python": "measure it anew, or take more snapshots; where fiducials may be off, say so: "
        "replace(obj, tolerance=...)",
        "command": "measure it anew, or take more snapshots; where fiducials may be off, say so: "
        "--object-tolerance MM, or a column `tolerance`",
    }
    # Of a few snapshots nobody can tell whether it is the lenses instead: then they would disagree.
    few = fit.problem.uv.shape[1] < SNAPSHOTS_TO_BEND
    if few and shape is not None and shape.bent_sigma() >= 2 * BENT:
        raise RefusedError(
            "estimation: the object is not as its file says, and other places of its fiducials do not explain the "
            "images either",
            **measure,
        )
    if fit.problem.object_prior_std is None:
        return ()
    places = (fit.problem.points + fit.problem.centroid).double().numpy()  # bent as its modes are
    found = offsets(fit, places)
    learnt = fit.problem.object_prior_std[0, :-1:3].numpy()
    granted = obj.granted.double().numpy()
    for offset in found:
        if learnt[offset.fiducial] <= 1.01 * granted[offset.fiducial]:
            continue
        which = f"estimation: fiducial {offset.fiducial} (row of the object file)"
        if offset.distance > MOST_DISPLACED * obj.size:
            raise RefusedError(
                f"{which} would be {offset.distance:.3g} mm from its place: labels are swapped, or this is not the "
                "object of the file",
                **measure,
            )
        if offset.sigma > LEAST_KNOWN * obj.size:
            raise RefusedError(
                f"{which} is not in its place, and the snapshots do not say where it is "
                f"({offset.distance:.2g} +- {offset.sigma:.1g} mm)",
                **measure,
            )
    return found


def find_lost_fiducials(seen: NDArray[np.bool_], in_view: NDArray[np.bool_]) -> tuple[int, ...]:
    """Choose the fiducials that were hardly found where all the others were: missing, hidden, or somewhere else.

    Args:
        seen: (S, C, N) labels that fit.
        in_view: (S, C, N) fiducials that the cameras should see.
    """
    looked = in_view & (seen.sum(-1, keepdims=True) > 0)
    expected, found = looked.sum((0, 1)), (seen & looked).sum((0, 1))
    share = found / np.maximum(expected, 1)
    lost = (expected >= LEAST_EXPECTED) & (share < LOST * np.median(share))
    return tuple(np.flatnonzero(lost).tolist())


def find_displaced(found: tuple[FiducialOffset, ...], obj: CalibrationObject) -> tuple[FiducialOffset, ...]:
    """Choose the fiducials that are farther from their places than chance and their tolerance explain."""
    granted = obj.granted.double().numpy()
    return tuple(
        offset
        for offset in found
        if offset.distance > CERTAIN * offset.sigma + TOLERATED * granted[offset.fiducial] + IN_PLACE * obj.size
    )
