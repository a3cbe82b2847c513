"""The rational lens where it is another one."""

import torch

from imgcal.geometry import distort_with_jacobian
from tests.imgcal.geometry.lens_cases import coefficients, points


def test_without_its_denominator_it_is_the_usual_lens() -> None:
    usual = coefficients("brown_conrady")
    wide = torch.cat((usual, torch.zeros(1, 3, dtype=torch.float64)), dim=-1)
    x, y = points("brown_conrady").unbind(-1)
    for mine, expected in zip(
        distort_with_jacobian(x, y, wide, "rational"), distort_with_jacobian(x, y, usual), strict=True
    ):
        torch.testing.assert_close(mine, expected, rtol=1e-14, atol=1e-15)


def test_equal_numerator_and_denominator_leave_points_where_they_are() -> None:
    lens = torch.tensor([[0.3, 0.2, 0.0, 0.0, 0.1, 0.3, 0.2, 0.1]], dtype=torch.float64)
    x, y = points("rational").unbind(-1)
    xd, yd, jxx, jxy, jyy, _ = distort_with_jacobian(x, y, lens, "rational")
    torch.testing.assert_close(torch.stack((xd, yd)), torch.stack((x, y)), rtol=1e-14, atol=0)
    torch.testing.assert_close(torch.stack((jxx, jxy, jyy)), torch.stack((x**0, 0 * x, x**0)), rtol=0, atol=1e-14)
