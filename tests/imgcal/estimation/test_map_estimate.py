"""`estimate`: shapes, fixed parameters, priors, spheres, outliers, gaps, input errors."""

from dataclasses import replace

import pytest
import torch

from imgcal.errors import InputError
from imgcal.estimation import Estimate, EstimationOptions, equations_at, estimate, initial_state, minimize
from imgcal.estimation.map_estimate import equations_by_snapshot
from imgcal.estimation.robust_losses import NamedLoss
from imgcal.geometry import RigidTransform
from imgcal.synthesis import RelativeDrift
from imgcal.types import Observations, RigPrior

SQUARED = EstimationOptions(loss="squared", tolerance=1e-10)


def run(case, **changes) -> Estimate:
    return estimate(
        case.observations, case.factory, case.obj, **{"prior_std": case.prior_std, "options": SQUARED, **changes}
    )


@pytest.mark.parametrize(("batch", "snapshots", "cameras"), [((), 2, 4), ((1,), 3, 4), ((2, 3), 2, 4), ((4,), 1, 4)])
def test_batch_shapes(simulate, batch: tuple[int, ...], snapshots: int, cameras: int) -> None:
    case = simulate(*batch, snapshots=snapshots, cameras=cameras, missing=0.1)
    found = run(case)
    assert found.rig.batch_shape == found.chi2.shape == found.converged.shape == found.rms.shape == batch
    assert found.rig_from_object.translation.shape == (*batch, snapshots, 3)
    assert found.residual.shape == (*batch, snapshots, cameras, 8, 2)
    assert found.converged.all()
    assert not found.residual[~case.observations.seen].any()
    uv = found.rig.project(found.rig_from_object.apply(case.obj.points).flatten(-3, -2)).uv
    uv = uv.unflatten(-2, (snapshots, 8)).movedim(-3, -4)
    seen = case.observations.seen
    torch.testing.assert_close(found.residual[seen], (uv - case.observations.uv)[seen], rtol=0, atol=1e-8)
    torch.testing.assert_close(found.rms**2 * seen.sum((-1, -2, -3)), found.residual.square().sum((-1, -2, -3, -4)))


def test_shake_is_refused_instead_of_ignored(simulate) -> None:
    case = simulate(snapshots=2, cameras=4)
    shaken = replace(case.observations, shake=torch.full(case.observations.seen.shape[:2], 0.1))
    with pytest.raises(InputError, match="shake"):
        run(replace(case, observations=shaken))


def test_batch_equals_one_by_one(simulate) -> None:
    case = simulate(3, snapshots=2, cameras=4, missing=0.1)
    together = run(case)
    for b in range(3):
        observations = Observations(*(getattr(case.observations, name)[b] for name in ("uv", "sigma", "seen")))
        one = run(replace(case, observations=observations))
        torch.testing.assert_close(one.rig.local(together.rig[b]), torch.zeros(4, 15).double(), rtol=0, atol=1e-5)


def test_better_than_the_factory(simulate) -> None:
    case = simulate(10, snapshots=20)
    found = run(case)
    before, after = case.factory.local(case.truth), found.rig.local(case.truth)
    assert (after[..., 6:10].square().mean() < 0.05 * before[..., 6:10].square().mean()).all()
    assert found.chi2_per_dof.mean() == pytest.approx(1, abs=0.05)


def test_camera_that_sees_nothing_keeps_its_factory_values(simulate) -> None:
    case = simulate(2, cameras=4, snapshots=3)
    seen = case.observations.seen.clone()
    seen[..., 2, :] = False
    found = run(replace(case, observations=replace(case.observations, seen=seen)))
    assert found.converged.all()
    assert found.rig.local(case.factory)[:, 2].abs().max() < 1e-9
    assert found.rig.local(case.factory)[:, 1].abs().max() > 1


def test_zero_spread_fixes_a_parameter_exactly(simulate) -> None:
    case = simulate(2, cameras=4)
    prior_std = case.prior_std.clone()
    prior_std[:, 10:] = 0
    prior_std[1] = 0
    guess = case.factory.retract(0.1 * prior_std + 1e-3)  # a guess does not move what is fixed
    found = run(case, prior_std=prior_std, initial_rig=guess)
    assert torch.equal(found.rig.distortion, case.factory.distortion.expand(2, -1, -1))
    assert torch.equal(found.rig.focal_length[:, 1], case.factory.focal_length[1].expand(2, -1))
    torch.testing.assert_close(
        found.rig.cam_from_rig.rotation[:, 1], case.factory.cam_from_rig.rotation[1].expand(2, 3, 3)
    )
    assert (found.rig.focal_length[:, 0] != case.factory.focal_length[0]).all()


def test_prior_of_the_rig_is_the_default_spread(simulate) -> None:
    case = simulate(cameras=4)
    prior = RigPrior(focal_length=0.005, principal_point=3.0)
    rig = replace(case.factory, prior=prior)
    implicitly, explicitly = (
        estimate(case.observations, rig, case.obj, prior_std=prior_std) for prior_std in (None, prior.std(rig))
    )
    assert torch.equal(implicitly.rig.focal_length, explicitly.rig.focal_length)


@pytest.mark.parametrize("snapshots", [1, 8])
def test_start_does_not_change_the_answer(simulate, snapshots: int) -> None:
    case = simulate(5, snapshots=snapshots)
    cold = run(case)
    warm = run(case, rig_from_object=case.poses, initial_rig=case.truth)
    torch.testing.assert_close(cold.chi2, warm.chi2, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(cold.rig.focal_length, warm.rig.focal_length, rtol=0, atol=1e-3)


def test_sphere_centres_are_not_ellipse_centres(simulate) -> None:
    case = simulate(4, snapshots=20, noise=0.0, sigma=0.001, radius=25.0)
    aware = run(case)
    ignorant = run(replace(case, obj=replace(case.obj, radius=None)))
    error = (aware.rig.focal_length - case.truth.focal_length).abs().max()
    biased = (ignorant.rig.focal_length - case.truth.focal_length).abs().max()
    assert aware.rms.max() < 1e-3
    assert error < 0.1
    assert biased > 5 * error


def test_robust_loss_survives_outliers(simulate) -> None:
    case = simulate(5, snapshots=10)
    uv = case.observations.uv.clone()
    uv[:, ::3, 1::4, 2] += 30
    spoiled = replace(case, observations=replace(case.observations, uv=uv))
    clean = run(case)
    robust, plain = run(spoiled, options=EstimationOptions(loss="cauchy", max_iterations=100)), run(spoiled)
    assert (robust.rig.focal_length - clean.rig.focal_length).abs().max() < 1.5
    assert (plain.rig.focal_length - clean.rig.focal_length).abs().max() > 15


def test_sigma_weighs(simulate) -> None:
    case = simulate(5, snapshots=10, noise=0.0)
    uv, sigma = case.observations.uv.clone(), case.observations.sigma.clone()
    uv[..., 0, :] += 1.0
    sigma[..., 0] = 1e3
    found = run(replace(case, observations=Observations(uv, sigma, case.observations.seen)))
    assert found.residual[..., 1:, :].abs().max() < 0.05
    torch.testing.assert_close(
        found.residual[..., 0, 1], torch.full_like(found.residual[..., 0, 1], -1.0), rtol=0, atol=0.05
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types_follow_the_observations(simulate, dtype: torch.dtype) -> None:
    case = simulate(2, snapshots=2)
    found = run(replace(case, observations=case.observations.to(dtype)), options=EstimationOptions())
    assert found.rig.focal_length.dtype == found.chi2.dtype == found.residual.dtype == dtype
    assert found.converged.all()
    assert found.rms.max() < 0.06


@pytest.mark.parametrize("count", [1, 3])
def test_nan_does_not_converge(simulate, count: int) -> None:
    case = simulate(count, cameras=4)
    uv = case.observations.uv.clone()
    uv[0, 0, 0, 0, 0] = torch.nan
    seen = torch.ones_like(case.observations.seen)
    observations = replace(case.observations, uv=uv, seen=seen)
    problem = replace(case, observations=observations).problem()
    found = minimize(problem, initial_state(problem, case.poses, None), SQUARED)
    assert found.converged.tolist() == [False] + [True] * (count - 1)
    with pytest.raises(InputError, match=r"uv\[0, 0, 0, 0\]: found nan"):
        estimate(observations, case.factory, case.obj, case.poses)


@pytest.mark.parametrize("given", [False, True])
def test_a_snapshot_that_nobody_saw_does_not_converge(simulate, given: bool) -> None:
    case = simulate(3, cameras=4)
    seen = case.observations.seen.clone()
    seen[1, 0] = False
    poses = case.poses if given else None
    found = run(replace(case, observations=replace(case.observations, seen=seen)), rig_from_object=poses)
    assert found.converged.tolist() == [True, False, True]
    assert found.rig.focal_length.isfinite().all() and found.rig_from_object.translation.isfinite().all()


def test_options_out_of_range_are_input_errors() -> None:
    for name, value in (("loss", "x"), ("threshold", 0.0), ("threshold", -3.0), ("tolerance", float("nan"))):
        with pytest.raises(InputError, match=name):
            EstimationOptions(**{name: value})


def test_priors_and_poses_that_cannot_be_are_input_errors(simulate) -> None:
    case = simulate(cameras=4)
    for prior_std in (torch.ones(15), torch.ones(4, 10), -torch.ones(4, 15), torch.full((4, 15), torch.nan)):
        with pytest.raises(InputError, match="prior_std"):
            run(case, prior_std=prior_std)
    with pytest.raises(InputError, match="rig_from_object"):
        run(case, rig_from_object=RigidTransform.identity(3, dtype=torch.float64))
    alone = Observations(*(part[0] for part in (case.observations.uv, case.observations.sigma, case.observations.seen)))
    with pytest.raises(InputError, match="snapshots"):
        estimate(alone, case.factory, case.obj)


def test_start_behind_the_cameras_does_not_converge_silently(simulate) -> None:
    case = simulate(1, cameras=4)
    behind = RigidTransform(case.poses.rotation, -case.poses.translation)
    assert not run(case, rig_from_object=behind).converged.any()


def test_shapes_that_do_not_fit_are_input_errors(simulate, o10) -> None:
    case = simulate(cameras=4)
    with pytest.raises(InputError, match="10 cameras"):
        estimate(case.observations, o10, case.obj)
    with pytest.raises(InputError, match="5 fiducials"):
        run(replace(case, obj=replace(case.obj, points=case.obj.points[:5])))


def test_relative_drift_prior(simulate) -> None:
    """Parameters that are zero in the factory have no spread under relative drift, and stay zero."""
    case = simulate(2, drift=RelativeDrift())
    assert (case.prior_std == 0).any()
    moved = run(case).rig.local(case.factory)
    assert not moved[:, case.prior_std == 0][..., 3:].abs().gt(1e-9).any()


@pytest.mark.parametrize("tolerance", [0.0, 0.4])
def test_equations_of_the_snapshots_add_up_to_those_of_the_rig(simulate, tolerance: float) -> None:
    case = simulate(snapshots=5, cameras=3, missing=0.1, tolerance=tolerance, bent=tolerance)
    found = run(case)
    problem, state, loss = found.problem, found.solution.state, NamedLoss("huber", 2.0)
    single, whole = equations_by_snapshot(problem, state, loss), equations_at(problem, state, loss)
    prior = torch.eye(15, dtype=torch.float64)
    torch.testing.assert_close((single.camera - prior).sum(0), whole.camera[0] - prior)
    gradient = (single.camera_gradient - state.offset).sum(0) + state.offset[0]
    torch.testing.assert_close(gradient, whole.camera_gradient[0], rtol=1e-9, atol=1e-6)
    for name in ("coupling", "pose", "pose_gradient", "residual"):
        torch.testing.assert_close(getattr(single, name)[:, 0], getattr(whole, name)[0], rtol=1e-9, atol=1e-6)
