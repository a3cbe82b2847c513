"""Integrated autocorrelation time of series with gaps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from imgcal.estimation import autocorrelation, correlation_time


def _autoregressive(rho: float, count: int, width: int, seed: int = 0) -> np.ndarray:
    """Series (count, width) of unit variance whose autocorrelation at lag k is rho^k."""
    rng = np.random.default_rng(seed)
    steps = (1 - rho**2) ** 0.5 * rng.normal(size=(count + 500, width))
    return lfilter([1.0], [1.0, -rho], steps, axis=0)[500:]


def test_white_noise_has_time_one() -> None:
    tau = correlation_time(np.random.default_rng(1).normal(size=(400, 2000)))
    assert tau.min() >= 1
    assert (tau == 1).mean() > 0.97
    assert tau.mean() < 1.02


@pytest.mark.parametrize("rho", [0.3, 0.73, 0.9])
def test_autoregressive_noise(rho: float) -> None:
    expected = (1 + rho) / (1 - rho)
    tau = correlation_time(_autoregressive(rho, 4000, 40))
    assert tau.mean() == pytest.approx(expected, rel=0.1)


def test_variance_of_a_mean_grows_with_the_correlation_time() -> None:
    series = _autoregressive(0.8, 1000, 400, seed=3)
    predicted = (correlation_time(series) / len(series)).mean()
    assert series.mean(0).var() == pytest.approx(predicted, rel=0.2)


def test_gaps() -> None:
    whole = _autoregressive(0.8, 4000, 20, seed=5)
    gaps = whole.copy()
    gaps[np.random.default_rng(2).random(whole.shape) < 0.4] = np.nan  # single frames
    gaps[1000:1800] = np.nan  # and a long time
    assert correlation_time(gaps).mean() == pytest.approx(correlation_time(whole).mean(), rel=0.15)


def test_parallel_series_are_pooled() -> None:
    series = _autoregressive(0.7, 300, 30, seed=7).reshape(300, 3, 5, 2)
    tau = correlation_time(series)
    assert tau.shape == (3,)
    assert np.all((tau > 4) & (tau < 7.5))


def test_a_constant_offset_is_no_correlation() -> None:
    noise = np.random.default_rng(4).normal(size=(500, 3))
    assert np.array_equal(correlation_time(noise + np.array([0.0, 10.0, -1e6])), correlation_time(noise))


def test_outliers_do_not_hide_it() -> None:
    series = _autoregressive(0.8, 2000, 10, seed=9)
    clean = correlation_time(series).mean()
    series[::97] += 40.0
    assert correlation_time(series).mean() > 0.6 * clean


def test_what_is_too_short_or_empty_or_constant_has_time_one() -> None:
    assert correlation_time(np.zeros((1, 2))).tolist() == [1, 1]
    assert correlation_time(np.zeros((0, 2))).tolist() == [1, 1]
    assert correlation_time(np.full((50, 2), np.nan)).tolist() == [1, 1]
    assert correlation_time(np.zeros((50, 2))).tolist() == [1, 1]
    assert correlation_time(np.array([[1.0], [2.0], [3.0], [4.0], [5.0]])).tolist() == [1]


def test_alternating_noise_is_not_worth_more_than_independent_noise() -> None:
    assert correlation_time(np.tile([1.0, -1.0], 200)[:, None]).tolist() == [1]


def test_autocorrelation_counts_pairs_without_gaps() -> None:
    rho, pairs = autocorrelation(np.array([[1.0], [np.nan], [1.0], [-2.0]]), 3)
    assert pairs[:, 0].tolist() == [3, 1, 1, 1]
    assert rho[0, 0] == pytest.approx(1)
