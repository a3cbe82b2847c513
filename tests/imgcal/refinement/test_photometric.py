import math

import pytest
import torch

from imgcal.refinement.photometric import DAMPING, DotWindows, ShiftPrior, profile_and_slope, take_blurred_step
from renderers import splat

COLOURS = torch.tensor([[1.0, 1, 1], [1, 0, 0], [0.9, 0.7, 0.4], [0, 0.7, 0]], dtype=torch.float64)  # N = 4
SIZE, DOT = (44, 44), 1.4


def places(close: bool) -> torch.Tensor:
    """Two images of four dots; `close` ones overlap and saturate."""
    spread_out = torch.tensor([[10.3, 9.1], [30.2, 11.7], [12.4, 26.3], [33.1, 25.8]], dtype=torch.float64)
    together = torch.tensor([[20.3, 16.1], [22.1, 17.4], [19.4, 18.3], [23.9, 15.2]], dtype=torch.float64)
    return torch.stack((together, together + 0.3)) if close else torch.stack((spread_out, spread_out - 0.7))


def render(uv: torch.Tensor) -> torch.Tensor:
    return splat(uv, COLOURS, DOT, SIZE).clamp(0, 1)


def test_profiles_keep_their_mass_and_slopes_are_derivatives():
    centre = torch.tensor([[7.2, 9.9], [6.0, 11.3]], dtype=torch.float64, requires_grad=True)
    value, slope = profile_and_slope(centre, DOT, 20)
    torch.testing.assert_close(value.sum(-1), torch.full_like(centre, math.sqrt(2 * math.pi) * DOT), atol=1e-5, rtol=0)
    for pixel in (5, 8, 12):
        (expected,) = torch.autograd.grad(value[..., pixel].sum(), centre, retain_graph=True)
        torch.testing.assert_close(slope[..., pixel], expected)


@pytest.mark.parametrize("close", [False, True])
def test_a_near_step_is_the_dense_gauss_newton_step(close):
    truth = places(close)
    uv = truth + 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    images = render(truth)
    assert bool((images == 1).any()) == close
    fit = DotWindows(images, uv, COLOURS, DOT).fit(uv, torch.ones(2, 4, dtype=torch.bool), steps=1)
    for m in range(2):
        jacobian = torch.autograd.functional.jacobian(render, uv[m])  # (3, H, W, N, 2)
        rows = jacobian.movedim(-1, -2).reshape(-1, 8)
        hessian = rows.T @ rows
        hessian = hessian + torch.diag(DAMPING * hessian.diagonal())
        step = torch.linalg.solve(hessian, rows.T @ (images[m] - render(uv[m])).flatten()).view(2, 4).T
        torch.testing.assert_close(fit.uv[m] - uv[m], step, atol=2e-3, rtol=5e-3)
        variance = torch.linalg.inv(hessian).diagonal().view(2, 4).mean(0)
        torch.testing.assert_close(fit.variance[m], variance, atol=0, rtol=2e-2)


@pytest.mark.parametrize("close", [False, True])
def test_near_steps_converge_to_the_truth_and_absent_dots_do_not_matter(close):
    truth = places(close)
    images = splat(truth, COLOURS, DOT, SIZE, visible=torch.arange(4) != 2).clamp(0, 1)
    uv = truth + 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    present = (torch.arange(4) != 2).expand(2, 4)
    fit = DotWindows(images.float(), uv, COLOURS.float(), DOT).fit(uv, present, steps=6)
    torch.testing.assert_close(fit.uv[present], truth[present], atol=1e-4, rtol=0)
    torch.testing.assert_close(fit.uv[~present], uv[~present])
    assert float(fit.mean_square[present].max()) < 1e-8


@pytest.mark.parametrize("offset", [0.3, 2.0])
def test_a_blurred_step_goes_to_the_truth(offset):
    truth = places(close=False)
    uv = truth + offset * torch.tensor([0.8, -0.6], dtype=torch.float64)
    prior = ShiftPrior(together=8.0, alone=2.0)
    step, amplitude = take_blurred_step(render(truth), uv, COLOURS, DOT, 3.0, prior, trust=1e-3)
    assert float((uv + step - truth).norm(dim=-1).max()) < 0.25 * offset
    assert float((amplitude - 1).abs().max()) < 0.15


def test_a_blurred_step_stays_at_the_truth_and_sees_what_is_missing():
    truth = places(close=False)
    images = splat(truth, COLOURS, DOT, SIZE, visible=torch.arange(4) != 3)
    step, amplitude = take_blurred_step(images, truth, COLOURS, DOT, 1.0, ShiftPrior(8.0, 2.0), trust=0.1)
    assert float(step.abs().max()) < 0.02
    assert float(amplitude[:, 3].max()) < 0.2 and float(amplitude[:, :3].min()) > 0.95


def test_shift_prior_is_the_inverse_of_its_covariance():
    together, alone = 3.0, 0.5
    covariance = together**2 * torch.ones(4, 4).double() + alone**2 * torch.eye(4).double()
    precision = ShiftPrior(together, alone).precision(COLOURS)
    torch.testing.assert_close(precision @ torch.block_diag(covariance, covariance), torch.eye(8).double())
