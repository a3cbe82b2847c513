"""Robust losses: derivatives, and limits near zero and far away."""

import pytest
import torch

from imgcal.estimation.robust_losses import LOSSES, cauchy, geman_mcclure, huber


@pytest.mark.parametrize("name", list(LOSSES))
def test_second_value_is_the_derivative(name: str) -> None:
    d2 = torch.tensor([1e-6, 0.5, 4.0, 8.9, 9.1, 50.0, 1e4], dtype=torch.float64, requires_grad=True)
    value, slope = LOSSES[name](d2)
    (derivative,) = torch.autograd.grad(value.sum(), d2)
    torch.testing.assert_close(slope, derivative)
    assert (slope > 0).all() and (slope <= 1).all()
    assert (slope.diff() <= 0).all()


@pytest.mark.parametrize("name", list(LOSSES))
def test_losses_are_quadratic_near_zero(name: str) -> None:
    d2 = torch.tensor([0.0, 1e-8], dtype=torch.float64)
    value, slope = LOSSES[name](d2)
    torch.testing.assert_close(value, d2, rtol=1e-6, atol=0)
    torch.testing.assert_close(slope, torch.ones_like(d2), rtol=1e-6, atol=0)


def test_losses_far_away() -> None:
    d2 = torch.tensor([1e8], dtype=torch.float64)
    assert float(huber(d2, 2.0)[0]) == pytest.approx(2 * 2 * 1e4 - 4)
    assert float(cauchy(d2, 2.0)[0]) == pytest.approx(4 * torch.log(torch.tensor(1 + 1e8 / 4)).item(), rel=1e-6)
    assert float(geman_mcclure(d2, 2.0)[0]) == pytest.approx(4, rel=1e-6)


def test_huber_is_continuous_at_its_threshold() -> None:
    value, slope = huber(torch.tensor([9 - 1e-9, 9 + 1e-9], dtype=torch.float64))
    torch.testing.assert_close(value[0], value[1])
    torch.testing.assert_close(slope[0], slope[1])
