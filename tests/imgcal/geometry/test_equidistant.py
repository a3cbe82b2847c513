"""The fisheye: angles from the axis."""

import math

import torch

from imgcal.geometry.equidistant import inverse
from imgcal.geometry.lenses import distort
from imgcal.geometry.projection import project


def test_without_coefficients_the_radius_is_the_angle() -> None:
    degrees = torch.tensor([0.0, 1e-6, 1.0, 45.0, 80.0, 89.0], dtype=torch.float64)
    angle = torch.deg2rad(degrees)
    xd, yd, _ = distort(angle.tan()[None], torch.zeros(1, 6).double(), torch.zeros(1, 4).double(), "equidistant")
    torch.testing.assert_close(xd[0], angle, rtol=1e-14, atol=1e-16)
    assert not yd.any()


def test_it_sees_up_to_ninety_degrees_and_no_further() -> None:
    angle = torch.deg2rad(torch.tensor([60.0, 85.0, 89.5, 90.0, 95.0, 170.0], dtype=torch.float64))
    points = 800 * torch.stack((angle.sin(), torch.zeros(6).double(), angle.cos()), dim=-1)[None]
    size = torch.tensor([[2000, 1000]])
    focal, centre = torch.full((1, 2), 400.0).double(), torch.tensor([[1000.0, 500.0]]).double()
    found = project(points, focal, centre, torch.zeros(1, 4).double(), size, models="equidistant")
    assert torch.isfinite(found.uv).all()
    assert found.visible.tolist() == [[True, True, True, False, False, False]]
    torch.testing.assert_close(found.uv[0, :3, 0], 1000 + 400 * angle[:3])


def test_the_inverse_needs_no_good_start() -> None:
    k = torch.tensor([0.2, -0.05, 0.03, -0.004], dtype=torch.float64).unbind()
    angle = torch.linspace(1e-9, 1.5, 50, dtype=torch.float64)
    u = angle**2
    distorted = angle * (1 + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3]))))
    factor = inverse(1.0, distorted.square(), k)
    torch.testing.assert_close((distorted * factor).arctan(), angle, rtol=1e-12, atol=1e-15)
    assert math.isfinite(float(inverse(1.0, torch.zeros(1).double(), k)))
