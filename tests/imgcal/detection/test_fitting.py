"""Fits of discs against SciPy's least squares on the same model, known centres, and the limit that the noise sets."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import ndtr

from imgcal.detection import fitting
from imgcal.detection.fitting import MOST, PARAMETERS, ROWS, fit_centre, start_ellipse
from tests.imgcal.detection import reference
from tests.imgcal.detection.discs import draw_discs

HALF = 16
Y, X = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(np.float64)


def disc(centre, radius, noise=0.0, seed=0, **known):
    at = np.array([centre]) + HALF
    light = draw_discs(X.shape, at, radius, background=0.0, **known)
    return light + noise * np.random.default_rng(seed).standard_normal(light.shape)


def fitted(grey, start, noise, clipped=False, rows=None):
    rows = np.ones(grey.shape, bool) if rows is None else rows
    scratch = np.zeros((ROWS, MOST), np.float32)
    pixels = int(rows.sum())
    for row, values in zip(scratch[-3:], (X[rows], Y[rows], grey[rows]), strict=True):
        row[:pixels] = values
    return fit_centre(scratch, pixels, np.asarray(start, dtype=float), clipped, noise)


def begin(grey, radius, centre, clipped=False):
    mass = np.minimum(grey, grey.max() / 2)
    dx, dy = X - centre[0], Y - centre[1]
    moments = [(mass * a * b).sum() / mass.sum() for a, b in ((dx, dx), (dx, dy), (dy, dy))]
    return start_ellipse(grey.max(), radius, clipped, tuple(moments), tuple(centre))


def model(p):
    """A Phi(steepness times the distance within the edge), as the module says it, by SciPy's normal distribution."""
    dx, dy = X - p[5], Y - p[6]
    gx, gy = p[2] * dx + p[3] * dy, p[3] * dx + p[4] * dy
    along = dx * gx + dy * gy
    steep = np.sqrt((1 + np.sqrt(max(p[2] * p[4] - p[3] ** 2, 1e-9)) * along) / (1 + gx**2 + gy**2))
    return p[0] * ndtr(steep * (p[1] - np.sqrt(1 + np.maximum(along, 0))))


@pytest.mark.parametrize("radius", [2.0, 4.0, 8.0])
@pytest.mark.parametrize("squeeze", [1.0, 0.6])
def test_the_centre_of_a_clean_disc_is_found(radius: float, squeeze: float) -> None:
    centre = np.array([0.37, -0.21])
    grey = disc(centre, radius, squeeze=squeeze, angle=0.5)
    start = begin(grey, radius * np.sqrt(squeeze), centre + np.array([0.15, -0.1]))
    u, v, known, residual, _ = fitted(grey, start, 1.0)
    np.testing.assert_allclose((u, v), centre, atol=0.01)
    assert known > 0 and residual < (0.01 * 200) ** 2


@pytest.mark.parametrize("radius", [4.0, 8.0])
@pytest.mark.parametrize("blur", [0.7, 1.5, 2.5])
def test_the_blur_of_the_edge_is_found(radius: float, blur: float) -> None:
    grey = disc((0.37, -0.21), radius, blur=blur)
    *_, found = fitted(grey, begin(grey, np.sqrt(grey.sum() / grey.max() / np.pi), (0.37, -0.21)), 1.0)
    np.testing.assert_allclose(found, np.hypot(blur, 12**-0.5), rtol=0.06)  # with the pixel's own width


@pytest.mark.parametrize("seed", range(4))
def test_noisy_discs_end_where_scipy_ends(seed: int) -> None:
    centre = np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
    grey = disc(centre, 5.0, noise=3.0, seed=seed)
    start = begin(disc(centre, 5.0), 5.0, (0.0, 0.0))
    u, v, known, residual, _ = fitted(grey, start, 3.0)
    best = least_squares(lambda p: (model(p) - grey).ravel(), start, x_scale="jac")
    assert np.hypot(u - best.x[5], v - best.x[6]) < 0.1 / np.sqrt(known) * 3.0  # a tenth of its sigma
    assert residual == pytest.approx(2 * best.cost / (grey.size - PARAMETERS), rel=0.01)
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    assert known == pytest.approx(2 / np.trace(covariance[5:, 5:]), rel=0.03)


def test_centres_spread_as_much_as_they_say() -> None:
    centre, noise = np.array([0.2, 0.3]), 4.0
    start = begin(disc(centre, 4.0), 4.0, (0.0, 0.0))
    found = np.array([fitted(disc(centre, 4.0, noise, seed), start, noise) for seed in range(150)])
    sigma = noise / np.sqrt(np.median(found[:, 2]))
    spread = np.sqrt(((found[:, :2] - centre) ** 2).mean())
    assert spread == pytest.approx(sigma, rel=0.12)


def test_a_clipped_disc_is_found_without_its_top() -> None:
    centre = np.array([-0.3, 0.4])
    grey = np.minimum(disc(centre, 5.0, contrast=600.0), 235.0)
    rows = grey < 234.0
    u, v, known, *_ = fitted(grey, begin(grey, 5.0, (0.0, 0.0), clipped=True), 1.0, True, rows)
    np.testing.assert_allclose((u, v), centre, atol=0.03)
    assert known > 0


def test_what_is_no_blob_says_that_nothing_is_known() -> None:
    grey = np.random.default_rng(0).normal(0, 3.0, X.shape)
    known = fitted(grey, begin(disc((0.0, 0.0), 4.0), 4.0, (0.0, 0.0)), 3.0)[2]
    assert known < 0.1 * fitted(disc((0.0, 0.0), 4.0), begin(disc((0.0, 0.0), 4.0), 4.0, (0.0, 0.0)), 3.0)[2]


def test_a_start_is_near_the_end() -> None:
    for radius in (2.0, 5.0, 9.0):
        grey = disc((0.0, 0.0), radius)
        start = begin(grey, radius, (0.0, 0.0))
        assert np.abs(model(start) - grey).max() < 0.2 * grey.max()
        assert start[2] * start[4] > start[3] ** 2


def test_the_edge_is_a_normal_distribution() -> None:
    t = np.linspace(-6, 6, 1201)
    rise, density = reference.phi(t)
    np.testing.assert_allclose(rise, ndtr(t), atol=2.5e-4)
    np.testing.assert_allclose(density, np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi), atol=3e-3)
    assert (np.diff(rise) > -1e-7).all()
    powers = np.clip(t, -fitting.END, fitting.END)[:, None] ** np.arange(1, 13, 2)
    np.testing.assert_allclose(0.5 + powers @ fitting.PHI.astype(float), ndtr(t), atol=2.5e-4)
