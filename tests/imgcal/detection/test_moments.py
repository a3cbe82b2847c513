"""Moments in a window agree with NumPy's sums, and estimated shapes with known ones."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from imgcal.detection.moments import WAIST, find_centroid, find_ramp, find_shape, find_waist
from tests.imgcal.detection.discs import draw_discs, draw_patches

HALF = 20
Y, X = (grid.astype(np.float32) for grid in np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1])


def window(uv, radius, **known):
    """Discs about the middle (M, 2), in grey levels above the background."""
    at = np.asarray(uv, dtype=float) + HALF
    return draw_discs((2 * HALF + 1,) * 2, at, radius, background=0.0, **known).astype(np.float32)


def shape(grey, patch=False):
    weight = np.ones_like(grey)
    return find_shape(grey, weight, X.ravel(), Y.ravel(), grey.max() / 2, patch)


def test_the_centroid_and_its_sums_are_those_of_numpy() -> None:
    random = np.random.default_rng(0)
    grey = window([[1.3, -2.2]], 5.0) + random.normal(0, 2, X.shape).astype(np.float32)
    weight = np.clip(grey / 60 - 0.3, 0, 1).astype(np.float32)
    weight[:3] = weight[-3:] = weight[:, :3] = weight[:, -3:] = 0
    ramp = np.empty_like(grey)
    find_ramp(grey, weight, np.float32(1 / 60), ramp)
    expected_ramp = np.where((weight > 0) & (weight < 1), grey / 60, 0)
    np.testing.assert_allclose(ramp, expected_ramp, rtol=1e-5)
    x0, y0, gained, spread = find_centroid(grey, weight, ramp, X.ravel(), Y.ravel())
    mass = (weight * grey).astype(np.float64)
    centre = (mass * X).sum() / mass.sum(), (mass * Y).sum() / mass.sum()
    np.testing.assert_allclose((x0, y0), centre, atol=1e-4)
    squared = (X - centre[0]) ** 2 + (Y - centre[1]) ** 2
    gain = weight + uniform_filter(expected_ramp, 3)
    assert gained == pytest.approx((gain**2 * squared)[1:-1, 1:-1].sum(), rel=1e-3)
    assert spread == pytest.approx((weight * squared).sum(), rel=1e-3)
    np.testing.assert_allclose(centre, (1.3, -2.2), atol=0.1)


@pytest.mark.parametrize(("squeeze", "angle"), [(1.0, 0.0), (0.6, 0.4), (0.4, -1.1)])
def test_moments_and_elongation_of_an_ellipse(squeeze: float, angle: float) -> None:
    grey = window([[0.4, -0.7]], 9.0, squeeze=squeeze, angle=angle)
    elongation, two_peaked, middle, (xx, xy, yy) = shape(grey)
    mass = np.minimum(grey, grey.max() / 2).astype(np.float64)
    centre = np.array([(mass * X).sum(), (mass * Y).sum()]) / mass.sum()
    np.testing.assert_allclose(middle, centre, atol=1e-4)
    np.testing.assert_allclose(middle, (0.4, -0.7), atol=0.02)
    away = np.stack((X - centre[0], Y - centre[1]))
    expected = np.einsum("hw,ihw,jhw->ij", mass, away, away) / mass.sum()
    np.testing.assert_allclose([[xx, xy], [xy, yy]], expected, rtol=1e-3, atol=1e-3)
    assert np.arctan2(2 * xy, xx - yy) / 2 == pytest.approx(angle, abs=0.03) or squeeze == 1
    assert elongation == pytest.approx(1 / squeeze, rel=0.12)
    assert not two_peaked


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.3, 2.4])
@pytest.mark.parametrize("gap", [1.0, 1.3])
def test_two_discs_are_two_wherever_they_lie(angle: float, gap: float) -> None:
    apart = gap * 5.0 * np.array([np.cos(angle), np.sin(angle)])
    elongation, two_peaked, middle, _ = shape(window([apart, -apart], 5.0))
    assert two_peaked and elongation > 1.5
    np.testing.assert_allclose(middle, 0, atol=0.05)


def test_a_square_seen_at_an_angle_has_no_waist_and_two_discs_have() -> None:
    corners = np.array([[[-12.0, -4], [12, -4], [12, 4], [-12, 4]]]) + HALF
    patch = draw_patches((2 * HALF + 1,) * 2, corners, background=0.0).astype(np.float32)
    assert not shape(patch, patch=True)[1] and shape(patch)[0] > 2
    pair = window([[-6.0, 0], [6, 0]], 5.5)

    def waist(grey) -> float:
        _, _, (x0, _), (xx, _, _) = shape(grey)
        weight = np.ones_like(grey)
        return find_waist(grey, weight, X.ravel(), Y.ravel(), grey.max() / 2, (1.0, 0.0), x0, np.sqrt(xx))

    assert waist(patch) > WAIST > 0.7 > waist(pair)
    assert shape(pair, patch=True)[1]


def test_a_flipped_window_has_flipped_moments() -> None:
    grey = window([[3.1, -1.4]], 6.0, squeeze=0.5, angle=0.6)
    one, other = shape(grey), shape(np.ascontiguousarray(grey[:, ::-1]))
    assert other[0] == pytest.approx(one[0], rel=1e-4) and other[1] == one[1]
    np.testing.assert_allclose(other[2], (-one[2][0], one[2][1]), atol=1e-3)
    np.testing.assert_allclose(other[3], (one[3][0], -one[3][1], one[3][2]), rtol=1e-3, atol=1e-2)
