"""The correction for curvature is even in the step, of fourth order, and never negative."""

from dataclasses import replace

import pytest
import torch

from imgcal.estimation import EstimationOptions, camera_covariance, curvature, estimate
from imgcal.estimation.curvature import curvature_covariance
from imgcal.synthesis import PhysicalDrift, RelativeDrift

SQUARED = EstimationOptions(loss="squared")
NARROW, WIDE = torch.zeros(1, 1), torch.full((1, 1), 1e9)  # Gaussian posteriors


def at_truth(simulate, scale: float, tolerance: float | None = None):
    """An estimate from exact data: noise and prior are as small as said, residuals zero."""
    case = simulate(
        2, snapshots=1, cameras=3, noise=0.0, sigma=0.3 * scale, drift=RelativeDrift(0.0, 0.0), tolerance=tolerance
    )
    obj = case.obj if tolerance is None else replace(case.obj, tolerance=case.obj.tolerance * scale)
    prior_std = scale * PhysicalDrift().std(case.factory)
    return estimate(case.observations, case.factory, obj, case.poses, prior_std=prior_std, options=SQUARED)


def pixels(found):
    """Where a point of each rig is seen, relative to where the estimate sees it."""
    point = torch.tensor([[30.0, -20.0, 800.0]]).double()
    centre = found.rig.map_tensors(lambda tensor, _: tensor.unsqueeze(1))
    return lambda rigs, _: (rigs.project(point).uv - centre.project(point).uv).flatten(-3)


@pytest.mark.parametrize("tolerance", [None, 0.3])
def test_it_is_of_fourth_order_in_noise_and_prior(simulate, tolerance) -> None:
    large, small = (at_truth(simulate, scale, tolerance) for scale in (1.0, 0.1))
    one, other = (curvature_covariance(found, pixels(found), NARROW) for found in (large, small))
    assert one.shape == (2, 6, 6)
    trace, less = (part.diagonal(dim1=-2, dim2=-1).sum(-1) for part in (one, other))
    assert (trace > 0).all()
    torch.testing.assert_close(less * 1e4, trace, rtol=0.2, atol=0)


def test_it_is_a_covariance_and_always_the_same(simulate) -> None:
    found = at_truth(simulate, 1.0)
    one = curvature_covariance(found, pixels(found), NARROW)
    torch.testing.assert_close(one, one.mT)
    assert torch.linalg.eigvalsh(one).min() > -1e-9 * one.abs().max()
    assert torch.equal(one, curvature_covariance(found, pixels(found), NARROW))


def test_what_nothing_moves_has_none_and_what_moves_twice_as_much_has_four_times_as_much(simulate) -> None:
    found = at_truth(simulate, 1.0)
    nothing = curvature_covariance(found, lambda rigs, _: torch.zeros(*rigs.focal_length.shape[:2], 4).double(), WIDE)
    assert not nothing.any()
    point = pixels(found)
    doubled = curvature_covariance(found, lambda rigs, points: 2 * point(rigs, points), NARROW)
    torch.testing.assert_close(doubled, 4 * curvature_covariance(found, point, NARROW))


def test_numbers_too_many_to_keep_are_drawn_again(simulate, monkeypatch) -> None:
    found = at_truth(simulate, 1.0)
    kept = curvature_covariance(found, pixels(found), NARROW)
    monkeypatch.setattr(curvature, "MOST_KEPT_NUMBERS", 0)
    assert torch.equal(kept, curvature_covariance(found, pixels(found), NARROW))


def test_fewer_pairs_serve_where_the_posterior_is_hardly_curved(simulate, monkeypatch) -> None:
    found = at_truth(simulate, 1.0)
    precise, rough = (curvature_covariance(found, pixels(found), flat) for flat in (NARROW, WIDE))
    torch.testing.assert_close(rough.diagonal(dim1=1, dim2=2), precise.diagonal(dim1=1, dim2=2), rtol=0.5, atol=0)
    assert not torch.equal(rough, precise)
    monkeypatch.setattr(curvature, "MOST_PAIRS", curvature.LEAST_PAIRS)
    assert torch.equal(rough, curvature_covariance(found, pixels(found), NARROW))


@pytest.mark.parametrize("tolerance", [None, 0.3])
def test_that_of_the_cameras_parameters_is_the_one_of_rigs_that_step(simulate, tolerance) -> None:
    found = at_truth(simulate, 1.0, tolerance)
    centre = found.rig.map_tensors(lambda tensor, _: tensor.unsqueeze(1))
    flat = camera_covariance(found, curved=False)
    by_rigs = curvature_covariance(found, lambda rigs, _: rigs.local(centre).flatten(-2), flat)
    assert (by_rigs.diagonal(dim1=1, dim2=2) > 1e-6 * flat.diagonal(dim1=1, dim2=2)).any()
    # The logarithm of a rotation by several vectors is their sum only to first order.
    std = flat.diagonal(dim1=1, dim2=2).sqrt()
    error = (camera_covariance(found) - flat - by_rigs) / (std[:, :, None] * std[:, None])
    assert error.abs().max() < 1e-4
