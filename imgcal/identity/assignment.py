"""One-to-one pairing of fiducials with blobs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def mutual_nearest(cost: NDArray[np.floating], gate: float) -> NDArray[np.int64]:
    """Pair those that are each other's cheapest.

    Args:
        cost: (*B, N, M).
        gate: pairs at this cost or above are not made.

    Returns:
        (*B, N) blob of each fiducial, -1 = none.
    """
    best, back = cost.argmin(-1), cost.argmin(-2)
    agreed = np.take_along_axis(back, best, -1) == np.arange(cost.shape[-2])
    cheap = np.take_along_axis(cost, best[..., None], -1)[..., 0] < gate
    return np.where(agreed & cheap, best, -1)


def assign(cost: NDArray[np.floating], gate: float) -> NDArray[np.int64]:
    """Pair fiducials and blobs at the least total cost, where leaving a fiducial out costs `gate`.

    Args:
        cost: (*B, N, M).
        gate: cost of no pair.

    Returns:
        (*B, N) blob of each fiducial, -1 = none.
    """
    batch, (fiducials, blobs) = cost.shape[:-2], cost.shape[-2:]
    flat = cost.reshape(-1, fiducials, blobs)
    labels = np.where(flat.min(-1) < gate, flat.argmin(-1), -1)
    # Where all cheapest blobs differ, nothing is cheaper. Only the others need the full search.
    ordered = np.sort(labels, axis=1)
    contested = ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any(1)
    for b in np.flatnonzero(contested):
        possible = flat[b] < gate
        rows, columns = np.flatnonzero(possible.any(1)), np.flatnonzero(possible.any(0))
        part = np.minimum(flat[b][np.ix_(rows, columns)], gate)
        i, j = linear_sum_assignment(part)
        made = part[i, j] < gate
        labels[b] = -1
        labels[b, rows[i[made]]] = columns[j[made]]
    return labels.reshape(*batch, fiducials)
