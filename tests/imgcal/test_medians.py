"""Quick medians and quantiles equal NumPy's to the bit."""

import numpy as np
import pytest

from imgcal.medians import median, median_of_known, quantile_of_known


@pytest.mark.parametrize("count", [1, 2, 7, 10])
def test_median_is_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3))
    assert median(values) == np.median(values)
    assert median(values.astype(np.int64)) == np.median(values.astype(np.int64))
    values[0, 1] = np.nan
    assert np.isnan(median(values)) and np.isnan(np.median(values))


def test_median_of_nothing_is_unknown() -> None:
    assert np.isnan(median([]))


@pytest.mark.parametrize("count", [1, 6, 7])
def test_unknown_values_do_not_count(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 5, 3))
    values[1:, ::2] = np.where(values[1:, ::2] > 0, np.nan, values[1:, ::2])
    assert np.array_equal(median_of_known(values), np.nanmedian(values, axis=0))
    for share in (0.0, 0.3, 0.5, 0.75, 0.99, 1.0):
        assert np.array_equal(quantile_of_known(values, share), np.nanquantile(values, share, axis=0))


def test_a_series_without_a_known_value_has_no_median() -> None:
    values = np.array([[np.nan, 1.0], [np.nan, 2.0]])
    assert np.array_equal(median_of_known(values), [np.nan, 1.5], equal_nan=True)
    assert np.array_equal(quantile_of_known(values, 0.5), [np.nan, 1.5], equal_nan=True)
