from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from imgcal.association import mutual_nearest
from imgcal.association.assignment import assign, spacing


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


@pytest.mark.parametrize(("fiducials", "blobs", "gate"), [(30, 40, 25.0), (40, 12, 25.0), (8, 8, 400.0), (20, 60, 1.0)])
def test_assign_costs_as_much_as_with_a_spare_blob_for_each_fiducial(fiducials: int, blobs: int, gate: float) -> None:
    random = np.random.default_rng(1)
    cost = random.chisquare(2, (3, 2, fiducials, blobs)) * random.choice([1.0, 30.0], (3, 2, fiducials, blobs))
    cost[..., -1] = np.inf  # padding
    labels = assign(cost, gate)
    assert labels.shape == (3, 2, fiducials)
    for place in np.ndindex(3, 2):
        spare = np.concatenate((np.minimum(cost[place], 1e9), np.full((fiducials, fiducials), gate)), axis=1)
        expected = spare[linear_sum_assignment(spare)].sum()
        made = labels[place] >= 0
        assert (cost[place][made, labels[place][made]] < gate).all()
        assert cost[place][made, labels[place][made]].sum() + gate * (~made).sum() == pytest.approx(expected)


def test_assign_does_not_care_about_the_order() -> None:
    random = np.random.default_rng(2)
    cost = random.chisquare(2, (12, 15))
    rows, columns = random.permutation(12), random.permutation(15)
    shuffled = assign(cost[rows][:, columns], 3.0)
    np.testing.assert_array_equal(np.where(shuffled >= 0, columns[shuffled], -1), assign(cost, 3.0)[rows])


def test_mutual_nearest_makes_no_contested_pair() -> None:
    places, blobs = np.array([[0.0, 0.0], [0.2, 0.0], [5.0, 0.0]]), np.array([[0.0, 9.0], [0.1, 0.0], [5.4, 0.0]])
    labels = np.empty(3, dtype=np.int64)
    mutual_nearest(places, blobs, 0.5, labels)
    np.testing.assert_array_equal(labels, [1, -1, 2])
    mutual_nearest(places, blobs[1:2], 0.1, labels)  # the reach itself is too far
    np.testing.assert_array_equal(labels, [-1, -1, -1])
    mutual_nearest(places, blobs[:0], 0.5, labels)
    np.testing.assert_array_equal(labels, [-1, -1, -1])


@pytest.mark.parametrize(("places", "blobs"), [(7, 11), (11, 7)])
def test_mutual_nearest_is_that_of_all_distances(places: int, blobs: int) -> None:
    generator = np.random.default_rng(1)
    a, b = generator.random((places, 2)), generator.random((blobs, 2))
    b = b[b[:, 0].argsort()]
    distance = np.linalg.norm(a[:, None] - b, axis=-1)
    expected = distance.argmin(1)
    mutual = distance.argmin(0)[expected] == np.arange(places)
    expected[~mutual | (distance.min(1) >= 0.2)] = -1
    labels = np.empty(places, dtype=np.int64)
    mutual_nearest(a, b, 0.2, labels)
    np.testing.assert_array_equal(labels, expected)


def test_spacing_is_the_median_distance_to_the_nearest_other() -> None:
    line = np.stack((np.array([0.0, 1.0, 3.0, 7.0]), np.zeros(4)), axis=-1)
    assert spacing(line[None]) == pytest.approx(1.5)
    assert spacing(np.stack((line, line, 10 * line))) == pytest.approx(3.0)
