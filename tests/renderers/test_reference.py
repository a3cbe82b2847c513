"""The slow renderers against integrals and areas that are known."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import dblquad

from renderers.reference import ellipse_reference, splat_reference


def test_a_pixel_holds_the_integral_of_the_gaussian() -> None:
    uv, colours = torch.tensor([[2.3, 1.6]], dtype=torch.float64), torch.tensor([[1.0, 0.5, 0.0]], dtype=torch.float64)
    image = splat_reference(uv, colours, 0.8, (4, 6), intensity=torch.tensor([0.7]).double())

    def light(v: float, u: float) -> float:
        return 0.7 * math.exp(-((u - 2.3) ** 2 + (v - 1.6) ** 2) / (2 * 0.8**2))

    for row, column in ((0, 0), (1, 2), (2, 2), (3, 5)):
        expected = dblquad(light, column - 0.5, column + 0.5, row - 0.5, row + 0.5)[0]
        np.testing.assert_allclose(image[:, row, column], expected * colours[0], atol=1e-9)


@pytest.mark.parametrize("mode", ["add", "over"])
def test_mass_does_not_depend_on_place_and_invisible_splats_draw_nothing(mode) -> None:
    uv = torch.tensor([[[20.0, 20.0]], [[20.37, 19.5]], [[21.0, 22.5]]], dtype=torch.float64)
    visible = torch.tensor([[True], [True], [False]])
    image = splat_reference(uv, torch.ones(1, 1).double(), 1.5, (41, 41), visible=visible, compositing=mode)
    mass = 2 * math.pi * 1.5**2
    torch.testing.assert_close(image.sum((1, 2, 3)), torch.tensor([mass, mass, 0]).double(), atol=1e-6, rtol=0)


def test_the_nearer_of_two_wide_splats_hides_the_other_whatever_their_order() -> None:
    uv = torch.full((2, 2), 10.0, dtype=torch.float64)
    colours = torch.eye(2, dtype=torch.float64)
    for depth, front in ((None, 0), ([1.0, 2.0], 0), ([2.0, 1.0], 1)):
        given = None if depth is None else torch.tensor(depth)
        image = splat_reference(uv, colours, 50.0, (21, 21), depth=given, compositing="over")
        assert image[front, 10, 10] > 0.99 and image[1 - front, 10, 10] < 0.01


@pytest.mark.parametrize("blur", [0.0, 0.9])
def test_an_ellipse_covers_its_area_about_its_centre(blur: float) -> None:
    centre = torch.tensor([15.2, 12.7], dtype=torch.float64)
    shape = torch.tensor([[25.0, 6.0], [6.0, 9.0]], dtype=torch.float64)
    image = ellipse_reference(centre, shape, (26, 31), blur=blur)
    area = math.pi * math.sqrt(float(torch.linalg.det(shape)))
    assert float(image.sum()) == pytest.approx(area, rel=2e-3)
    rows, columns = torch.meshgrid(torch.arange(26.0).double(), torch.arange(31.0).double(), indexing="ij")
    found = torch.stack(((image * columns).sum(), (image * rows).sum())) / image.sum()
    torch.testing.assert_close(found, centre, atol=0.02, rtol=0)
    assert image.min() >= 0 and image.max() <= 1 + 1e-9
    # Second moments: those of a filled ellipse, of the blur, and of the square pixel.
    variance = ((columns - centre[0]) ** 2 * image).sum() / image.sum()
    assert float(variance) == pytest.approx(25 / 4 + blur**2 + 1 / 12, rel=5e-3)
