import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from imgcal.matching.camera_fit import USUAL_MISFIT, cut, fit_camera

PASSES = np.array([4, 2])  # iterations of each


def image(uv, radius=6.0):
    v, u = np.mgrid[:120, :160].astype(float)
    return 20 + sum(90 / (1 + np.exp((np.hypot(u - x, v - y) - radius) / 0.6)) for x, y in uv).astype(np.float32)


def test_windows_are_resampled_bilinearly_about_their_places():
    rng = np.random.default_rng(0)
    grey, uv = rng.uniform(0, 255, (40, 50)).astype(np.float32), np.array([[20.3, 17.8], [1.2, 38.9]])
    scale, patches = np.array([1.0, 1.4]), np.empty((2, 11, 11), np.float32)
    cut(grey, uv, scale, 5, patches)
    steps = np.arange(-5, 6)
    for k in range(2):
        rows, columns = np.meshgrid(uv[k, 1] + scale[k] * steps, uv[k, 0] + scale[k] * steps, indexing="ij")
        expected = map_coordinates(grey, [rows, columns], order=1, mode="nearest")
        assert np.allclose(patches[k], expected, atol=1e-2)


def test_places_radius_and_who_does_not_look_like_the_others():
    uv = np.array([[30.4, 28.7], [80.1, 31.3], [128.6, 35.2], [52.2, 85.5], [110.7, 90.1]])
    grey = image(uv)
    grey[76:96, 53:63] = 20  # half of the fourth
    place, found, misfit = np.empty_like(uv), np.zeros((5, 5)), np.zeros(5)
    every = np.ones(5, bool)
    radius = fit_camera(grey, uv + 0.8, every, every, np.ones(5), 17, PASSES, place, found, misfit)
    whole = [0, 1, 2, 4]
    assert np.abs(place - uv)[whole].max() < 0.05 and radius == pytest.approx(6.0, rel=0.1)
    assert misfit[3] > USUAL_MISFIT > misfit[whole].max()


def test_where_nothing_is_there_is_no_size():
    uv = np.array([[40.0, 40.0], [90.0, 60.0]])
    every = np.ones(2, bool)
    flat = 130 - image(uv)
    assert fit_camera(flat, uv, every, every, np.ones(2), 17, PASSES, uv.copy(), np.zeros((2, 5)), np.zeros(2)) == 0


def test_what_is_known_to_be_near_is_measured_in_one_short_pass():
    uv = np.array([[30.4, 28.7], [80.1, 31.3], [128.6, 35.2]])
    grey, every = image(uv), np.ones(3, bool)
    place, found = np.empty_like(uv), np.zeros((3, 5))
    fit_camera(grey, uv + 0.3, every, every, np.ones(3), 17, PASSES[1:], place, found, np.zeros(3))
    assert np.abs(place - uv).max() < 0.05 and np.isfinite(found[:, 1:3]).all()
