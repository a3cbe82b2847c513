"""Integrated autocorrelation time of residuals, estimated from the series themselves.

Errors of real captures are correlated between frames: a half-hidden marker, a lens model that is off at one place in
the image. N such samples carry as much information as N / tau independent ones, where tau = 1 + 2 (rho_1 + rho_2 + ...)
and rho_k is the autocorrelation at lag k. The sum ends where the autocorrelation is no longer distinguishable from that
of white noise, so that tau of white noise is one except by chance.

Source: Politis and White, "Automatic block-length selection for the dependent bootstrap" (Econometric Reviews 2004),
with the correction by Patton, Politis and White (2009): the rule for the last lag, and the flat-top window.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imgcal.medians import median_of_known

LAG_THRESHOLD = 2.0
"""An autocorrelation is significant above `LAG_THRESHOLD` (log10 n / n)^1/2 for n pairs: three sigma of white noise."""
QUIET = 5
"""Consecutive lags without significant autocorrelation that end the sum."""
MOST_LAGS = 0.25
"""Largest lag, as a share of the series' length: longer lags have too few independent pairs."""
FIRST_LAGS = 32
"""Lags tried first; more are tried where the autocorrelation has not died away by then."""
LEAST_PAIRS = 16
"""Smallest number of pairs of samples from which an autocorrelation is computed."""
OUTLYING = 5.0
"""Standard deviations (from the median absolute deviation) at which samples are clipped: outliers whiten a series."""


def autocorrelation(series: NDArray[np.floating], lags: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Autocorrelation of series with gaps at lags 0 to `lags`, and the number of sample pairs behind it.

    Args:
        series: (S, C, ...) samples in temporal order, NaN where missing. The axes after C are parallel series of the
            same source, pooled with weights by their variance.
        lags: at most S - 1.

    Returns:
        (lags + 1, C) autocorrelation, NaN without pairs, and (lags + 1, C) pairs.

    Examples:
        >>> rho, pairs = autocorrelation(np.array([[1.0], [-1.0], [1.0], [-1.0]]), 1)
        >>> rho[:, 0].tolist(), pairs[:, 0].tolist()
        ([1.0, -1.0], [4.0, 3.0])
    """
    count, sources = series.shape[:2]
    x = _centre(np.asarray(series, dtype=np.float64).reshape(count, sources, -1))
    known = np.isfinite(x)
    wide = x.shape[2]
    samples, there = _rows(np.where(known, x, 0.0)), _rows(known.astype(np.float64))
    products, pairs = np.empty((lags + 1, sources)), np.empty((lags + 1, sources))
    complete = bool(known.all())
    for lag in range(lags + 1):
        ahead, behind = np.s_[:, lag * wide :], np.s_[:, : (count - lag) * wide]
        products[lag] = np.einsum("cn,cn->c", samples[ahead], samples[behind])
        pairs[lag] = (count - lag) * wide if complete else np.einsum("cn,cn->c", there[ahead], there[behind])
    mean = np.divide(products, pairs, out=np.full_like(products, np.nan), where=pairs > 0)
    variance = mean[0]
    rho = np.divide(mean, variance, out=np.full_like(mean, np.nan), where=variance > 0)
    return rho, pairs


def _rows(series: NDArray[np.float64]) -> NDArray[np.float64]:
    """Arrange series (S, C, D) as one long row for each source, so that sums run along the memory: (C, S D)."""
    return np.ascontiguousarray(series.swapaxes(0, 1)).reshape(series.shape[1], -1)


def correlation_time(series: NDArray[np.floating]) -> NDArray[np.float64]:
    """Integrated autocorrelation time of each source, in samples; at least one.

    Args:
        series: (S, C, ...) samples in temporal order, NaN where missing; see `autocorrelation`. The samples must have
            comparable variance (divide them by their standard deviations where those differ).

    Returns:
        (C,) number of successive samples that carry as much information as one independent sample; one for white noise
        and where the samples are too few.

    Examples:
        >>> rng = np.random.default_rng(1)
        >>> white = rng.normal(size=(2000, 1))
        >>> repeated = np.repeat(white, 10, axis=0)  # each value ten times
        >>> float(correlation_time(white)[0]), 8 < float(correlation_time(repeated)[0]) < 12
        (1.0, True)
    """
    count, sources = series.shape[:2]
    most = int(MOST_LAGS * count)
    lags, tau = min(FIRST_LAGS, most), np.ones(sources)
    while lags > 0:
        rho, pairs = autocorrelation(series, lags)
        last = [_last_lag(rho[:, source], pairs[:, source]) for source in range(sources)]
        if lags == most or 2 * max(last, default=0) + QUIET <= lags:
            return np.array([_integrate(rho[:, c], pairs[:, c], last[c]) for c in range(sources)]).reshape(sources)
        lags = min(4 * lags, most)
    return tau


def _centre(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Subtract the medians of series (S, C, D) and clip outliers."""
    known = np.isfinite(x)
    if not known.any():
        return x
    filled = np.where(known, x, np.nan)
    empty = ~known.any(0)
    filled[:, empty] = 0.0
    centre = median_of_known(filled)
    spread = 1.4826 * median_of_known(np.abs(filled - centre))
    limit = np.where(spread > 0, OUTLYING * spread, np.inf)
    clipped = np.clip(filled - centre, -limit, limit)
    clipped -= np.nanmean(clipped, axis=0)
    return np.where(known, clipped, np.nan)


def _last_lag(rho: NDArray[np.float64], pairs: NDArray[np.float64]) -> int:
    """Last significant lag before `QUIET` insignificant ones; 0 = none. Arrays (L + 1,) are from `autocorrelation`."""
    noise = LAG_THRESHOLD * np.sqrt(np.log10(np.maximum(pairs, 10)) / np.maximum(pairs, 1))
    counts = (pairs >= LEAST_PAIRS) & (np.nan_to_num(rho) > noise)
    last = 0
    for lag in range(1, len(rho)):
        if counts[lag]:
            last = lag
        elif lag - last >= QUIET:
            break
    return last


def _integrate(rho: NDArray[np.float64], pairs: NDArray[np.float64], last: int) -> float:
    """Sum of an autocorrelation (L + 1,) over both signs of the lag by the flat-top window; at least one.

    The window is one up to the last significant lag, and falls to zero at twice that lag. It ends earlier where the
    autocorrelation falls to zero: lasting errors do not oscillate, but subtracting the mean of a short series makes its
    long lags negative (Geyer, "Practical Markov chain Monte Carlo", Statistical Science 1992).
    """
    lag = np.arange(1, min(2 * last, len(rho)))
    window = np.clip(2 * (1 - lag / (2 * max(last, 1))), 0.0, 1.0)
    known = np.where(pairs[lag] >= LEAST_PAIRS, np.nan_to_num(rho[lag]), 0.0)
    positive = np.logical_and.accumulate((known > 0) | (lag <= 1))
    return max(1.0, 1 + 2 * float((window * known * positive).sum()))
