import cv2
import numpy as np
import pytest

from imgcal.formats import Lens
from imgcal.formats.fitting import pixel_grid

DRAW = np.random.default_rng(4)
POINTS = DRAW.normal(size=(300, 3)) * [0.4, 0.3, 0.1] + [0, 0, 1.5]
NUMBERS = (-0.21, 0.09, 0.0012, -0.0007, 0.02, 0.03, -0.02, 0.011, 0.002, -0.001, 0.0015, 0.0009, 0.02, -0.03)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_opencv_s_lens(count: int) -> None:
    lens = Lens((901.0, 905.5), (640.25, 400.5), NUMBERS[:count])
    expected, _ = cv2.projectPoints(
        POINTS, np.zeros(3), np.zeros(3), lens.matrix, np.array(NUMBERS[:count] or (0.0,) * 4)
    )
    assert np.abs(lens.project(POINTS) - expected[:, 0]).max() < 1e-9
    assert np.abs(lens.rays(expected[:, 0]) - POINTS / POINTS[:, 2:]).max() < 1e-9


def test_opencv_s_fisheye() -> None:
    lens = Lens((501.0, 505.5), (640.25, 400.5), (-0.0103, -0.0074, 0.0025, -0.0007), "fisheye")
    points = POINTS * [3.0, 3.0, 1.0]
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.coefficients)
    )[0]
    assert np.abs(lens.project(points) - expected[:, 0]).max() < 1e-9
    assert np.abs(lens.rays(expected[:, 0]) - points / points[:, 2:]).max() < 1e-8
    assert np.allclose(lens.project(np.array([[0.0, 0.0, 2.0]])), lens.principal_point)
    assert np.isfinite(lens.project(np.array([[1.0, 0.0, -0.2]]))).all()  # beside the camera: a fisheye sees it


def test_an_image_that_is_straightened() -> None:
    """A point of the image goes away from the centre by 1 + k1 r^2 + k2 r^4, r in pixels from the centre of that."""
    lens = Lens((900.0, 900.0), (640.0, 400.0), (3e-8, 1e-14, 0.0, 2.0, -1.0), "to_ideal")
    uv = np.array([[642.0, 399.0], [942.0, 799.0]])
    square = 500.0**2
    factor = 1 + 3e-8 * square + 1e-14 * square**2
    ideal = np.array([[642.0, 399.0], [642.0 + 300 * factor, 399.0 + 400 * factor]])
    rays = lens.rays(uv)
    assert np.allclose(rays[:, :2] * 900 + [640, 400], ideal, atol=1e-9)
    assert np.allclose(lens.project(rays * 3.0), uv, atol=1e-9)


def test_there_are_no_rays_beyond_the_fold() -> None:
    folded = Lens((500.0, 500.0), (640.0, 480.0), (-0.4,))  # folds at r = 0.91, 0.61 in the image
    rays = folded.rays(np.array([[640.0, 480.0], [640 + 300.0, 480.0], [640 + 310.0, 480.0]]))
    assert np.isfinite(rays[:2]).all()
    assert np.isnan(rays[2, :2]).all()
    assert np.isnan(folded.project(np.array([[0.0, 0.0, -1.0]]))).all()


def test_every_pixel_comes_back() -> None:
    uv = pixel_grid((1280, 800), 21)
    for lens in (
        Lens((900.0, 905.0), (640.0, 400.0), NUMBERS, skew=1.5),
        Lens((500.0, 505.0), (640.0, 400.0), (0.02, -0.01), "fisheye"),
        Lens((900.0, 905.0), (640.0, 400.0), (-3e-8, 2e-14, 1e-20), "to_ideal"),
    ):
        assert np.abs(lens.project(lens.rays(uv)) - uv).max() < 1e-8


def test_how_many_coefficients_count() -> None:
    assert Lens((1, 1), (0, 0), (0.1, 0.0, 0.0, 0.0, 0.0)).length == 1
    assert Lens((1, 1), (0, 0), (0.0,) * 14).length == 0
    assert Lens((1, 1), (0, 0), (0.1, 0.2)).pad(4) == [0.1, 0.2, 0.0, 0.0]
