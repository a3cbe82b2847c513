"""Where the image of a Brown-Conrady lens folds over: constructed radii, and samples."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from imgcal.geometry.brown_conrady import blind_from
from imgcal.geometry.lenses import is_before_fold


def distortion_of_slope(a: float, b: float, c: float) -> Tensor:
    """Distortion whose radial slope is 1 + a s + b s^2 + c s^3."""
    return torch.tensor([[a / 3, b / 5, 0.0, 0.0, c / 7]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("roots", "complex_root"),
    [
        ((0.4,), None),  # k1 < 0 alone: folds at 1 / (3 |k1|)
        ((0.4, 0.9), None),
        ((0.4, 0.9, 2.0), None),  # the slope recovers and folds again
        ((0.4, -0.7), None),
        ((0.4, -0.7, -2.0), None),
        ((0.4, 1.5, -0.2), None),
        ((0.4,), 0.6 + 0.3j),
        ((0.4,), -0.6 + 0.3j),
    ],
)
def test_fold_at_constructed_radius(roots: tuple[float, ...], complex_root: complex | None) -> None:
    everything = list(roots) + ([complex_root, complex_root.conjugate()] if complex_root else [])
    coefficients = np.real(np.poly(1 / np.array(everything)))  # product of (1 - s / root), in powers of s
    a, b, c = np.pad(coefficients[1:], (0, 4 - len(coefficients)))
    fold = min(root for root in roots if root > 0)
    rr = fold * torch.tensor([[0.0, 0.5, 1 - 1e-9, 1 + 1e-9, 1.2, 3.0, 300.0]], dtype=torch.float64)
    before = is_before_fold(rr, distortion_of_slope(a, b, c))
    assert before.tolist() == [[True, True, True, False, False, False, False]]


@pytest.mark.parametrize("slope", [(0.0, 0.0, 0.0), (0.3, 0.1, 0.05), (-0.3, 0.1, 0.0), (1.0, -2.0, 1.5)])
def test_no_fold_where_the_slope_stays_positive(slope: tuple[float, float, float]) -> None:
    assert is_before_fold(torch.linspace(0, 50, 200, dtype=torch.float64)[None], distortion_of_slope(*slope)).all()


@given(st.tuples(*[st.floats(-2, 2).filter(lambda x: x == 0 or abs(x) > 1e-6)] * 3))
@settings(max_examples=100, deadline=None)
def test_fold_is_monotone_in_radius_and_agrees_with_sampling(slope: tuple[float, float, float]) -> None:
    a, b, c = slope
    rr = torch.linspace(0, 4, 4001, dtype=torch.float64)
    before = is_before_fold(rr[None], distortion_of_slope(*slope))[0]
    assert not (before[1:] & ~before[:-1]).any()
    lowest = torch.cummin(1 + rr * (a + rr * (b + rr * c)), 0).values
    clear = lowest.abs() > 1e-3  # sampling cannot tell a touch from a dip
    assert torch.equal(before[clear], (lowest > 0)[clear])


@pytest.mark.parametrize("lens", [(-0.4, 0.05, 0.0), (-0.4, 0.2, 0.1), (0.1, -0.3, 0.02), (0.1, 0.0, 0.0)])
def test_the_formula_of_compiled_code_says_the_same(lens: tuple[float, float, float]) -> None:
    rr = torch.linspace(0, 4, 401, dtype=torch.float64)
    k1, k2, k3 = lens
    before = is_before_fold(rr[None], torch.tensor([[k1, k2, 0, 0, k3]], dtype=torch.float64))[0]
    slope = 1 + rr * (3 * k1 + rr * (5 * k2 + rr * 7 * k3))
    with np.errstate(invalid="ignore", divide="ignore"):
        blind = blind_from(np.array([k1, k2, 0.0, 0.0, k3]))
    assert torch.equal(before, (slope > 0) & (rr < blind))
