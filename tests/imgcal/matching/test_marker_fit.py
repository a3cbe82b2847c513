import numpy as np

from imgcal.matching.marker_fit import FEW, LEAST_NOISE, MISFIT, ROBUST, fit_markers
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
    fit_markers(frame.astype(np.float32), every, 12, np.ones(len(start)), close, shape, len(MISFIT), True, uv, found)
    return uv, found


def slow_step(frame, uv, half, whitening):
    """One step of one marker, array by array: its place, amplitude, and the variance of the place."""
    v, u = np.mgrid[-half : half + 1, -half : half + 1] + np.rint(uv[::-1])[:, None, None]
    values = frame[v.astype(int), u.astype(int)].ravel()
    along = np.stack((u - uv[0], v - uv[1]), -1).reshape(-1, 2)

    def shape(moved):
        place = np.linalg.norm((along - moved) @ whitening.T, axis=1)
        return np.interp(place, RINGS * np.arange(26), profile(), right=0.0)

    linear = np.stack((np.ones_like(values), shape(np.zeros(2))), -1)
    first = np.linalg.lstsq(linear, values, rcond=None)[0]
    off = values - linear @ first
    spread = max(1.4826 * np.median(abs(off)), LEAST_NOISE)
    weight = 1 / (1 + (off / (ROBUST * max(spread, MISFIT[-1] * first[1]))) ** 2)
    ground, amplitude = np.linalg.solve(linear.T * weight @ linear, linear.T * weight @ values)
    slopes = [amplitude * (shape(step) - shape(-step)) / 2e-6 for step in 1e-6 * np.eye(2)]
    jacobian = np.column_stack((linear, *slopes))
    residual = weight * (values - ground - amplitude * linear[:, 1])
    inverse = np.linalg.inv(jacobian.T * weight @ jacobian)
    octant = (along > 0) @ (1, 2) + 4 * (abs(along[:, 0]) > abs(along[:, 1]))
    pulls = np.stack([jacobian[octant == k].T @ residual[octant == k] for k in range(8)])
    variance = (residual**2 / weight).sum() / (weight.sum() - 4)
    told = np.maximum(variance * np.diag(inverse), FEW * ((pulls @ inverse) ** 2).sum(0))
    return uv + (inverse @ jacobian.T @ residual)[2:], amplitude, told[2:].mean()


def test_a_step_is_the_slow_one():
    rng, places = np.random.default_rng(1), np.array([[29.6, 31.2]])
    whitening = np.array([[0.9, 0.1], [0.1, 1.1]])
    for smear in (0.0, 40.0):  # which pulls to one side
        frame = image(places, (60.0,)) + rng.normal(0, 2, (61, 61))
        frame[33:36, 30:40] += smear
        uv, found, every = places + 0.2, np.zeros((1, 5)), np.ones(1, bool)
        alone, shape = np.zeros((1, 1), bool), (whitening, profile())
        fit_markers(frame.astype(np.float32), every, 12, np.ones(1), alone, shape, 1, True, uv, found)
        expected, amplitude, variance = slow_step(frame, places[0] + 0.2, 12, whitening)
        assert np.allclose(uv[0], expected, atol=1e-3)
        assert np.allclose(found[0, [0, 2]], (amplitude, variance), rtol=1e-2)


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
