"""Gradients through the solution, against finite differences of the whole estimation."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform
from imgcal.types import Observations

EXACT = {name: EstimationOptions(loss=name, tolerance=1e-18, max_iterations=40) for name in ("squared", "cauchy")}


def scaled(case, found) -> Tensor:
    """Solution in units of the prior's standard deviations and of the pose's natural ones."""
    camera = found.rig.local(case.factory) / case.prior_std
    return torch.cat((camera.flatten(), found.rig_from_object.translation.flatten() / 850))


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
@pytest.mark.parametrize("radius", [None, 15.0])
def test_gradient_by_observations(simulate, loss: str, radius: float | None) -> None:
    case = simulate(2, snapshots=2, cameras=2, fiducials=5, missing=0.1, noise=0.05, radius=radius)
    uv = case.observations.uv.clone().requires_grad_()
    sigma = case.observations.sigma.clone().requires_grad_()

    def solve(uv: Tensor, sigma: Tensor) -> Tensor:
        observations = Observations(uv, sigma, case.observations.seen)
        found = estimate(
            observations,
            case.factory,
            case.obj,
            case.poses,
            prior_std=case.prior_std,
            initial_rig=case.truth,
            options=EXACT[loss],
        )
        return scaled(case, found)

    assert torch.autograd.gradcheck(solve, (uv, sigma), eps=1e-4, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_gradient_by_factory_values_and_spread(simulate) -> None:
    case = simulate(1, snapshots=2, cameras=2, fiducials=5, noise=0.05)
    rig = case.factory
    step = torch.zeros(2, 15, dtype=torch.float64, requires_grad=True)
    logarithm = torch.zeros(2, 15, dtype=torch.float64, requires_grad=True)

    def solve(step: Tensor, logarithm: Tensor) -> Tensor:
        found = estimate(
            case.observations,
            rig.retract(step * case.prior_std),
            case.obj,
            case.poses,
            prior_std=case.prior_std * logarithm.exp(),
            options=EXACT["squared"],
        )
        return scaled(case, found)

    assert torch.autograd.gradcheck(solve, (step, logarithm), eps=1e-4, atol=1e-4, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize(("loss", "most"), [("huber", 0.02), ("cauchy", 0.1)])
def test_gradient_by_the_prior_needs_no_tighter_tolerance(simulate, loss: str, most: float) -> None:
    """It is proportional to the offsets, of which an estimate that stops early knows the small ones poorly."""
    case = simulate(3, snapshots=3, cameras=4, noise=0.05)
    weights = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def solve(**options: float) -> tuple[Tensor, Tensor]:
        """Offsets from the factory rig in units of the prior, and the gradient by its logarithm."""
        prior_std = case.prior_std.expand(3, -1, -1).clone().requires_grad_()
        estimation = EstimationOptions(loss=loss, max_iterations=200, **options)
        found = estimate(case.observations, case.factory, case.obj, prior_std=prior_std, options=estimation)
        (found.rig.focal_length * weights).sum().backward()
        return found.rig.local(case.factory).detach() / case.prior_std, prior_std.grad * case.prior_std

    (there, exact), (here, usual) = solve(tolerance=1e-18), solve()
    same = (here - there).abs().amax((1, 2)) < 0.02  # Cauchy's loss has several minima
    assert int(same.sum()) >= 2
    exact, usual = exact[same], usual[same]
    assert float((usual - exact).abs().max()) < 5e-3 * float(exact.abs().max())
    small = exact.abs() > 1e-4 * exact.abs().max()
    assert float(((usual - exact) / exact)[small].abs().max()) < most


def test_gradient_by_observations_when_snapshots_are_eliminated(simulate) -> None:
    case = simulate(1, snapshots=6, cameras=2, fiducials=5, noise=0.05)
    uv = case.observations.uv.clone().requires_grad_()

    def solve(uv: Tensor) -> Tensor:
        observations = replace(case.observations, uv=uv)
        return scaled(
            case,
            estimate(
                observations, case.factory, case.obj, case.poses, prior_std=case.prior_std, options=EXACT["squared"]
            ),
        )

    assert torch.autograd.gradcheck(solve, uv, eps=1e-4, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_gradient_through_an_object_that_is_estimated_too(simulate) -> None:
    case = simulate(1, snapshots=3, cameras=2, fiducials=5, noise=0.05, tolerance=0.3, bent=0.3, scale_tolerance=0.01)
    uv = case.observations.uv.clone().requires_grad_()

    def solve(uv: Tensor) -> Tensor:
        observations = replace(case.observations, uv=uv)
        found = estimate(
            observations, case.factory, case.obj, case.poses, prior_std=case.prior_std, options=EXACT["squared"]
        )
        return torch.cat((scaled(case, found), found.points_object.flatten()))

    assert torch.autograd.gradcheck(solve, uv, eps=1e-4, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_value_is_the_same_with_and_without_gradient(simulate) -> None:
    case = simulate(2, cameras=3)
    plain = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    uv = case.observations.uv.clone().requires_grad_()
    tracked = estimate(replace(case.observations, uv=uv), case.factory, case.obj, prior_std=case.prior_std)
    assert torch.equal(plain.rig.focal_length, tracked.rig.focal_length.detach())
    assert tracked.rig.focal_length.requires_grad and not plain.rig.focal_length.requires_grad
    with torch.no_grad():
        silent = estimate(replace(case.observations, uv=uv), case.factory, case.obj, prior_std=case.prior_std)
    assert not silent.rig.focal_length.requires_grad


def test_gradient_trains_every_pixel_that_is_seen(simulate) -> None:
    case = simulate(2, cameras=3, missing=0.2)
    uv = case.observations.uv.clone().requires_grad_()
    found = estimate(replace(case.observations, uv=uv), case.factory, case.obj, prior_std=case.prior_std)
    loss = (found.rig.focal_length - case.truth.focal_length).square().mean()
    (gradient,) = torch.autograd.grad(loss, uv)
    assert torch.isfinite(gradient).all()
    assert (gradient[case.observations.seen] != 0).all()
    assert not gradient[~case.observations.seen].any()


def test_object_points_are_constants(simulate) -> None:
    case = simulate(1, cameras=3)
    start = RigidTransform(case.poses.rotation.clone().requires_grad_(), case.poses.translation)
    found = estimate(case.observations, case.factory, case.obj, start, prior_std=case.prior_std)
    assert not found.rig.focal_length.requires_grad  # where the iteration starts does not matter
