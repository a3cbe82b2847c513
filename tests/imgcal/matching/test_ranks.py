import cv2
import numpy as np
import pytest
from scipy.stats import rankdata

from imgcal.matching.ranks import MOST, average, raise_ranks, rank_spots


def values(seed=0, size=(200, 300)):
    return np.random.default_rng(seed).normal(0, 1, size).astype(np.float32)


def ranked(values, tries=1):
    ranks = np.zeros_like(values)
    raise_ranks(values, np.array(values.shape[::-1]), tries, ranks)
    return ranks


def exact(values, tries=1):
    above = values.size - rankdata(values) + 0.5
    return np.clip(-np.log(above * tries / values.size), 0, MOST).reshape(values.shape)


@pytest.mark.parametrize("tries", [1, 3])
@pytest.mark.parametrize("seen", [values(), 7 * values(1), 40 * values(2) ** 3 - 5, values(3) + 200])
def test_ranks_are_those_of_sorting(seen, tries):
    surprise, expected = ranked(seen, tries), exact(seen, tries)
    low = expected < 6  # of the few beyond, several may share a bin
    assert np.abs(surprise - expected)[low].max() < 0.2 and np.abs(surprise - expected)[low].mean() < 5e-3
    assert (np.diff(surprise.ravel()[seen.ravel().argsort()]) >= 0).all()


def test_ranks_of_noise_are_exponential_whatever_its_size():
    surprise = ranked(values())
    for level in (0.5, 1.0, 3.0, 5.0):
        assert (surprise > level).mean() == pytest.approx(np.exp(-level), rel=0.15)
    assert np.allclose(surprise, ranked(7 * values()), atol=0.2)
    assert (ranked(np.ones((4, 4), np.float32)) == 0).all()


def test_only_a_part_counts_and_nothing_is_lowered():
    seen, ranks = values(), np.full((200, 300), 2.0, np.float32)
    seen[150:] = 50
    raise_ranks(seen, np.array([300, 150]), 1, ranks)
    assert np.allclose(ranks[:150], np.maximum(ranked(seen[:150].copy()), 2)) and (ranks[150:] == 2).all()


def test_spots_are_told_in_standard_deviations_of_the_noise_but_for_what_is_covered():
    response, covered = np.stack((3 * values(), 0.1 * values(1))), np.zeros((200, 300), np.uint8)
    response[1, 20, 30] = 2
    response[0, 60:80, 60:80], covered[60:80, 60:80] = 100, 1
    ranks = np.zeros((200, 300), np.float32)
    rank_spots(response, covered, np.array([300, 200]), ranks)
    assert np.std(response[:, :50], axis=(1, 2)) == pytest.approx([1, 1], abs=0.05)
    assert response[1, 20, 30] == pytest.approx(20, rel=0.05) and ranks.argmax() == 20 * 300 + 30
    assert (response[:, 60:80, 60:80] == 0).all() and ranks[60:80, 60:80].max() < 1


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_cells_are_means_of_blocks(kind):
    frame = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (90, 110), endpoint=True).astype(kind)
    cells = np.empty((20, 25), np.float32)
    average(frame, np.array([8, 4]), 4, cells)
    part = frame[4:84, 8:108].astype(np.float64)
    assert np.allclose(cells, cv2.resize(part, (25, 20), interpolation=cv2.INTER_AREA), rtol=1e-6)


@pytest.mark.parametrize("other", [1e-9, -1e-9, 0.0])
def test_values_that_differ_by_less_than_rounding_have_no_rank(other):
    flat = np.zeros((4, 5), np.float32)
    flat[1, 2] = other
    assert not ranked(flat).any()
