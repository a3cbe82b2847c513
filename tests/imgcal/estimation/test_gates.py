"""Targets of the estimation: accuracy, efficiency, correct covariance, convergence."""

import pytest
import torch
from torch import Tensor

from imgcal.estimation import (
    EstimationOptions,
    camera_covariance,
    estimate,
    initial_state,
    levenberg_marquardt_cpu,
    map_cost,
    relative_covariance,
    relative_difference,
)
from imgcal.estimation.map_estimate import RESTART_AFTER
from imgcal.estimation.robust_losses import LOSSES
from imgcal.synthesis import Drift, PhysicalDrift, RelativeDrift

SQUARED = EstimationOptions(loss="squared")


def test_noise_free_snapshot_is_met_exactly(simulate) -> None:
    case = simulate(100, snapshots=1, noise=0.0, sigma=0.001, drift=RelativeDrift())
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=SQUARED)
    assert found.converged.all()
    assert found.rms.max() <= 0.001


def normalized_square(error: Tensor, covariance: Tensor) -> Tensor:
    """Squared Mahalanobis distance for each degree of freedom: (B,). Parameters without any variance do not count."""
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    free = (std > 1e-12).all(0)
    error, std, covariance = (error / std)[:, free], std[:, free], covariance[:, free][:, :, free]
    correlation = covariance / (std[:, :, None] * std[:, None])
    factor, failed = torch.linalg.cholesky_ex(correlation)
    if not failed.any() and factor.diagonal(dim1=-2, dim2=-1).min() > 1e-4:
        whitened = torch.linalg.solve_triangular(factor, error[..., None], upper=False)
        return whitened.square().mean((1, 2))
    # Relative to a reference camera, parameters that are fixed tie others together: those directions do not count.
    values, vectors = torch.linalg.eigh(correlation)
    along = (vectors.mT @ error[..., None]).squeeze(-1)
    kept = values > 1e-8
    return torch.where(kept, along.square() / values, 0.0).sum(-1) / kept.sum(-1)


@pytest.mark.parametrize("drift", [RelativeDrift(0.025, 0.025), PhysicalDrift()])
def test_efficient_and_honest(simulate, drift: Drift) -> None:
    case = simulate(60, snapshots=20, noise=0.05, sigma=0.05, drift=drift)  # ratios are known to 1.5 %
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=SQUARED)
    assert found.converged.all()
    error = found.rig.local(case.truth)
    covariance = camera_covariance(found)
    bound = covariance.diagonal(dim1=-2, dim2=-1).unflatten(1, (10, 15))[..., 6:8].mean().sqrt()
    assert error[..., 6:8].square().mean().sqrt() <= 1.1 * bound
    full = normalized_square(error.flatten(1), covariance)
    relative = normalized_square(relative_difference(found.rig, case.truth).flatten(1), relative_covariance(found))
    for ratio in (full, relative, found.chi2_per_dof):
        assert 0.9 <= float(ratio.mean()) <= 1.1


def test_converges_from_ten_percent(simulate) -> None:
    options = EstimationOptions()
    case = simulate(2000, snapshots=1, noise=0.05, drift=RelativeDrift(0.1, 0.1))
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=options)
    problem = case.problem()
    at_truth = map_cost(problem, initial_state(problem, case.poses, case.truth), LOSSES[options.loss])
    right = found.converged & (0.5 * found.chi2 <= at_truth)
    assert float(right.double().mean()) >= 0.999


@pytest.mark.parametrize(("snapshots", "count"), [(1, 60), (5, 30)])
def test_converges_from_far_beyond_usual_drift(simulate, snapshots: int, count: int) -> None:
    drift = PhysicalDrift(rotation_deg=6, position=60, focal_length=0.2, principal_point=60, distortion=0.02)
    case = simulate(count, snapshots=snapshots, noise=0.05, drift=drift)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=SQUARED)
    problem = case.problem()
    at_truth = map_cost(problem, initial_state(problem, case.poses, case.truth), LOSSES["squared"])
    right = found.converged & (0.5 * found.chi2 <= at_truth)
    assert float(right.double().mean()) >= 0.95  # 0.7 of the single snapshots without beginning again


def test_beginning_again_leaves_the_others_alone(simulate) -> None:
    case = simulate(40, snapshots=1, noise=0.05, drift=PhysicalDrift(4, 40, 0.15, 40, 0.02))
    together = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=SQUARED)
    problem, start = case.problem(), initial_state(case.problem(), together.rig_from_object, None)
    assert (
        0
        < int((~levenberg_marquardt_cpu.minimize(problem, start, "squared", 3.0, RESTART_AFTER, 1e-4).converged).sum())
        < 40
    )
    for row in range(0, 40, 5):
        observations = case.observations.of_snapshots(row)
        alone = estimate(observations, case.factory, case.obj, prior_std=case.prior_std, options=SQUARED)
        torch.testing.assert_close(together.chi2[row], alone.chi2)
        torch.testing.assert_close(together.rig[row].focal_length, alone.rig.focal_length)
