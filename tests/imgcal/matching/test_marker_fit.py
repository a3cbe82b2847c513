import numpy as np

from imgcal.matching.marker_fit import MISFIT, fit_markers
from imgcal.matching.marker_shape import RINGS


def profile():
    radius = RINGS * np.arange(25)
    return np.append(1 / (1 + np.exp((radius - 5) / 0.7)), 0.0) / (1 / (1 + np.exp(-5 / 0.7)))


def image(places, amplitudes, side=61):
    """Markers on a ground of 20, drawn value by value."""
    v, u = np.mgrid[:side, :side].astype(float)
    total = np.full((side, side), 20.0)
    for (x, y), amplitude in zip(places, amplitudes, strict=True):
        total += amplitude * np.interp(np.hypot(u - x, v - y), RINGS * np.arange(26), profile())
    return total


def fitted(frame, start, close):
    uv, found, every = start.copy(), np.zeros((len(start), 5)), np.ones(len(start), bool)
    shape = (np.eye(2), profile())
    fit_markers(frame.astype(np.float32), every, 12, np.ones(len(start)), close, shape, len(MISFIT), uv, found)
    return uv, found


def test_places_are_exact_without_noise_and_neighbours_are_parted():
    places = np.array([[24.3, 30.8], [33.6, 28.1]])  # they overlap
    frame = image(places, (50.0, 80.0))
    start = places + np.array([[0.8, -0.7], [-0.6, 0.9]])
    uv, found = fitted(frame, start, ~np.eye(2, dtype=bool))
    assert np.abs(uv - places).max() < 0.1
    assert np.allclose(found[:, 0], (50, 80), rtol=0.05)
    alone, _ = fitted(frame, start, np.zeros((2, 2), bool))
    assert np.abs(alone - places).max() > 2 * np.abs(uv - places).max()


def test_the_variance_is_that_of_the_errors():
    rng, places = np.random.default_rng(0), np.array([[30.2, 29.7]])
    clean = image(places, (12.0,))
    errors, told = [], []
    for _ in range(200):
        uv, found = fitted(
            clean + rng.normal(0, 4.0, clean.shape), places + rng.normal(0, 0.5, (1, 2)), np.zeros((1, 1), bool)
        )
        errors.append(((uv - places) ** 2).sum() / 2)
        told.append(found[0, 2])
    assert 0.6 < np.mean(errors) / np.mean(told) < 1.6


def test_a_bright_thing_nearby_hardly_matters():
    places = np.array([[30.0, 30.0]])
    frame = image(places, (40.0,))
    frame[30:38, 40:44] += 150
    uv, _ = fitted(frame, places + 0.7, np.zeros((1, 1), bool))
    assert np.abs(uv - places).max() < 0.1
