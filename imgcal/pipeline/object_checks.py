"""A calibration's estimates of the object, and checks that the data support them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import RefusedError
from imgcal.estimation import BENT, SNAPSHOTS_TO_BEND, Estimate, FiducialOffset, ScaleEvidence, ShapeEvidence, offsets
from imgcal.messages import plus_minus
from imgcal.types import CalibrationObject

CERTAIN = 4.0
"""Significance, in standard deviations, at which a fiducial is reported as displaced."""
TOLERATED = 4.6
"""Multiple of the tolerance per coordinate; chance exceeds it once in ten thousand."""
MOST_DISPLACED = 0.15
"""Maximum displacement as a share of the object's size: beyond it, the fiducial belongs to another object."""
LEAST_KNOWN = 0.005
"""Maximum standard deviation of a displaced fiducial, as a share of the object's size."""
LEAST_EXPECTED = 6
"""Number of expected views at which a fiducial's absence is not chance."""
LOST = 0.5
"""Share of the usual number of views below which a fiducial counts as lost."""
IN_PLACE = 1e-4
"""Displacement, as a share of the object's size, that counts as none."""


def object_offsets(
    fit: Estimate, shape: ShapeEvidence | ScaleEvidence | None, obj: CalibrationObject
) -> tuple[FiducialOffset, ...]:
    """Return each fiducial's offset, and refuse if the data do not support it.

    Args:
        fit: the estimate.
        shape: evidence of its residuals about the object; None = not tested.
        obj: the object as in its file.

    Returns:
        One offset per fiducial; empty if the object was taken as exact.

    Raises:
        RefusedError: the object differs from its file, and the data cannot tell how.
    """
    measure = {
        "python": "measure it again, or take more snapshots; if fiducials may be off, say so: "
        "replace(obj, tolerance=...)",
        "command": "measure it again, or take more snapshots; if fiducials may be off, say so: "
        "--object-tolerance MM, or a column `tolerance`",
    }
    # With few snapshots, the lenses might be the cause instead: then these would disagree.
    few = fit.problem.uv.shape[1] < SNAPSHOTS_TO_BEND
    if few and shape is not None and shape.bent_sigma() >= 2 * BENT:
        raise RefusedError(
            "estimation: the object differs from its file, and other positions of its fiducials do not explain the "
            "images either",
            **measure,
        )
    if fit.problem.object_prior_std is None:
        return ()
    places = (fit.problem.points + fit.problem.centroid).double().numpy()  # including the bending modes
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
                f"({plus_minus(offset.distance, offset.sigma, digits=2)} mm)",
                **measure,
            )
    return found


def find_lost_fiducials(seen: NDArray[np.bool_], in_view: NDArray[np.bool_]) -> tuple[int, ...]:
    """Find the fiducials that were hardly seen although all the others were: missing, hidden, or elsewhere.

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
    """Find the fiducials that are farther from their places than chance and their tolerance explain."""
    granted = obj.granted.double().numpy()
    return tuple(
        offset
        for offset in found
        if offset.distance > CERTAIN * offset.sigma + TOLERATED * granted[offset.fiducial] + IN_PLACE * obj.size
    )
