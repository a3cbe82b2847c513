"""Kornia's distortions: batches, gradients, and values near the axis."""

import pytest
import torch
from kornia.geometry.camera import distort_points_kannala_brandt, undistort_points_kannala_brandt

from imgcal.geometry import LENS_MODELS
from imgcal.geometry.kornia_distortion import kannala_brandt_distortion, opencv_distortion
from imgcal.geometry.lenses import distort
from tests.imgcal.geometry.lens_cases import LENSES, coefficients, points


@pytest.mark.parametrize("name", LENSES)
def test_values_and_gradients_are_ours(name: str) -> None:
    xy = points(name)[:, 4:].expand(3, -1, -1).clone().requires_grad_()
    k = (coefficients(name) * torch.tensor([[1.0], [0.5], [0.0]])).requires_grad_()
    expected = torch.stack(distort(*xy.unbind(-1), k, name)[:2], dim=-1)
    found = LENS_MODELS[name].kornia(xy, k)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-14)
    upstream = torch.randn(found.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mine, others = (torch.autograd.grad(uv, (xy, k), upstream) for uv in (expected, found))
    for ours, kornias in zip(mine, others, strict=True):
        torch.testing.assert_close(ours, kornias, rtol=1e-9, atol=1e-10)


def test_their_functions_are_those_of_the_models() -> None:
    assert LENS_MODELS["rational"].kornia is LENS_MODELS["brown_conrady"].kornia is opencv_distortion
    assert LENS_MODELS["equidistant"].kornia is kannala_brandt_distortion


def test_wart_kornia_inverts_a_fisheye_only_roughly() -> None:
    lens = torch.tensor([1.0, 1.0, 0.0, 0.0, *LENSES["equidistant"][0]], dtype=torch.float64)
    xy = torch.tensor([4.0, 0.0], dtype=torch.float64)  # 76 degrees
    back = undistort_points_kannala_brandt(distort_points_kannala_brandt(xy, lens), lens)
    assert 0 <= float((back - xy).abs().max()) < 1e-3
