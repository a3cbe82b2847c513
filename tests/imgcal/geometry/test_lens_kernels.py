"""Compiled images of lenses against the tensors that say the same."""

import numpy as np
import pytest
import torch

from imgcal.geometry import distort_by_coefficients, distort_with_jacobian, lens_codes
from imgcal.geometry.lens_kernels import by_coefficients, image_of, undistort, width_of
from renderers.compiling import njit
from tests.imgcal.geometry.lens_cases import LENSES, coefficients, mixed


@njit(cache=True)
def _everything(models, camera, point, radius_squared, k, rows):
    found = image_of(models, camera, point[0], point[1], point[2], radius_squared, k[camera])
    by_coefficients(models, camera, found[2], found[3], found[4], k[camera], 2.0, 3.0, 4, rows)
    return found, undistort(models, camera, found[5], found[6], k[camera]), width_of(models, k)


@pytest.mark.parametrize("radius", [0.0, 12.0])
@pytest.mark.parametrize("name", [*LENSES, "mixed"])
def test_image_derivatives_and_inverse_are_those_of_tensors(name: str, radius: float) -> None:
    models, k = mixed() if name == "mixed" else (name, coefficients(name))
    codes = lens_codes(models, *k.shape)
    for camera in range(len(k)):
        point = torch.tensor([310.0, -220.0, 1400.0], dtype=torch.float64, requires_grad=True)
        rows = np.full((2, 5 + k.shape[1]), np.nan)
        found, back, width = _everything(codes, camera, point.detach().numpy(), radius**2, k.numpy(), rows)
        per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy = found
        scale = point[2] / (point[2] * point[2] - radius**2)
        at = [(point[i] * scale).expand(len(k), 1) for i in range(2)]
        expected = [part[camera, 0] for part in distort_with_jacobian(*at, k, models)]
        assert (xd, yd, jxx, jxy, jyy, rr) == pytest.approx([part.item() for part in expected], abs=1e-14)
        for value, (along, across) in zip(expected[:2], ((jxx, jxy), (jxy, jyy)), strict=True):
            (slope,) = torch.autograd.grad(value, point, retain_graph=True)
            mine = (along * per_depth, across * per_depth, log_slope * (along * x + across * y))
            assert slope.tolist() == pytest.approx(mine, rel=1e-10)
        by_x, by_y = distort_by_coefficients(*at, k, models)
        assert rows[0, 4:-1] == pytest.approx(2 * by_x[camera, 0].detach().numpy(), abs=1e-14)
        assert rows[1, 4:-1] == pytest.approx(3 * by_y[camera, 0].detach().numpy(), abs=1e-14)
        assert np.isnan(rows[:, [0, 1, 2, 3, -1]]).all()  # the rest is left alone
        assert back == pytest.approx((x, y), abs=1e-7)
        assert width == k.shape[1]
