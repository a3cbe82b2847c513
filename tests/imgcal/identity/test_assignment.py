from itertools import permutations

import numpy as np
import pytest

from imgcal.identity.assignment import assign, mutual_nearest


def cheapest(cost: np.ndarray, gate: float) -> float:
    """Least total cost by trying everything; a fiducial without blob costs `gate`."""
    fiducials, blobs = cost.shape
    padded = np.concatenate((cost, np.full((fiducials, fiducials), gate)), axis=1)
    return min(padded[range(fiducials), p].sum() for p in permutations(range(blobs + fiducials), fiducials))


@pytest.mark.parametrize(("fiducials", "blobs"), [(3, 3), (3, 4), (4, 2), (1, 3)])
def test_assign_costs_least(fiducials: int, blobs: int) -> None:
    cost, gate = np.random.default_rng(0).random((20, fiducials, blobs)), 0.6
    labels = assign(cost, gate)
    for c, found in zip(cost, labels, strict=True):
        made = found >= 0
        assert len(set(found[made])) == made.sum()
        total = c[np.flatnonzero(made), found[made]].sum() + gate * (~made).sum()
        assert total == pytest.approx(cheapest(c, gate))


def test_mutual_nearest_makes_no_contested_pair() -> None:
    cost = np.array([[0.1, 0.5], [0.2, 0.9], [0.8, 0.7]])
    np.testing.assert_array_equal(mutual_nearest(cost, 1.0), [0, -1, -1])
    np.testing.assert_array_equal(mutual_nearest(cost[:, :1], 0.05), [-1, -1, -1])
