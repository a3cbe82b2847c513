"""Posterior covariance: against dense inverses, under a change of reference, and against the spread of samples."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.estimation import (
    Estimate,
    EstimationOptions,
    camera_covariance,
    camera_std,
    estimate,
    joint_information,
    object_covariance,
    relative_covariance,
    relative_difference,
    relative_jacobian,
    retract,
    rig_at,
)
from imgcal.estimation.remaining_variance import remaining_variance
from imgcal.estimation.robust_losses import LOSSES, LossName
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis import PhysicalDrift

SQUARED = EstimationOptions(loss="squared", tolerance=1e-8)


def run(case) -> Estimate:
    return estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=SQUARED)


def dense_inverse(found: Estimate) -> torch.Tensor:
    """Inverse of the whole information in whitened units, without the object: (B, 15 C + 6 S, .)."""
    return torch.from_numpy(np.linalg.inv(dense_information(found).numpy()))


def dense_information(found: Estimate) -> torch.Tensor:
    equations = found.solution.equations
    count, snapshots, cameras = equations.coupling.shape[:3]
    split = 15 * cameras
    dense = torch.zeros(count, split + 6 * snapshots, split + 6 * snapshots, dtype=torch.float64)
    for c in range(cameras):
        dense[:, 15 * c : 15 * c + 15, 15 * c : 15 * c + 15] = equations.camera[:, c]
        for s in range(snapshots):
            rows, columns = slice(15 * c, 15 * c + 15), slice(split + 6 * s, split + 6 * s + 6)
            dense[:, columns, columns] = equations.pose[:, s]
            dense[:, rows, columns] = equations.coupling[:, s, c]
            dense[:, columns, rows] = equations.coupling[:, s, c].mT
    return dense


@pytest.mark.parametrize("snapshots", [1, 3, 10, 12])  # compiled, compiled, cameras kept, and many snapshots
def test_remaining_variance_is_the_diagonal_of_the_dense_inverse(simulate, snapshots: int) -> None:
    case = simulate(2, snapshots=snapshots, cameras=4, missing=0.1)
    case.prior_std[1, 10:] = 0  # fixed values keep all of nothing
    found = run(case)
    diagonal = dense_inverse(found).diagonal(dim1=-2, dim2=-1)[:, : 4 * 15].unflatten(-1, (4, 15))
    np.testing.assert_allclose(remaining_variance(found.solution), diagonal, rtol=1e-6)
    assert (remaining_variance(found.solution)[:, 1, 10:] == 1).all()


def test_remaining_variance_needs_a_determined_pose(simulate) -> None:
    found = run(simulate(2, snapshots=1, cameras=4))
    equations = replace(found.solution.equations, pose=found.solution.equations.pose * 0)
    with pytest.raises(RefusedError, match="do not determine"):
        remaining_variance(replace(found.solution, equations=equations))


@pytest.mark.parametrize("snapshots", [1, 3, 12])  # twelve snapshots of three cameras: snapshots are eliminated
def test_equals_the_dense_inverse(simulate, snapshots: int) -> None:
    case = simulate(2, snapshots=snapshots, cameras=3, missing=0.1)
    found = run(case)
    inverse = dense_inverse(found)
    # From whitened offsets to small left rotations about the estimate, and to physical units.
    state, problem = found.solution.state, found.problem
    zero = torch.zeros(2, 3, 15, dtype=torch.float64)
    here = rig_at(problem, state.offset)

    def physical(step: torch.Tensor) -> torch.Tensor:
        still = torch.zeros(2, snapshots, 6, dtype=torch.float64)
        return rig_at(problem, retract(problem, state, step, still).offset).local(here).sum(0).flatten()

    jacobian = torch.autograd.functional.jacobian(physical, zero).movedim(1, 0).flatten(2)  # (B, 45, 45)
    expected = jacobian @ inverse[:, :45, :45] @ jacobian.mT
    scale = expected.diagonal(dim1=-2, dim2=-1).sqrt()
    difference = (camera_covariance(found, curved=False) - expected) / (scale[..., None] * scale[:, None])
    assert difference.abs().max() < 1e-6
    torch.testing.assert_close(camera_std(found), scale.unflatten(1, (3, 15)), rtol=1e-2, atol=0)


@pytest.mark.parametrize("snapshots", [1, 12])  # cameras are eliminated, snapshots are
def test_with_an_object_equals_the_dense_inverse(simulate, snapshots: int) -> None:
    case = simulate(2, snapshots=snapshots, cameras=3, missing=0.1, tolerance=0.5, scale_tolerance=0.02)
    found = run(case)
    equations, problem = found.solution.equations, found.problem
    own = equations.object
    inner = dense_information(found)
    across = torch.cat((own.camera.flatten(1, 2), own.pose.flatten(1, 2)), 1)
    whole = torch.cat((torch.cat((inner, across), 2), torch.cat((across.mT, own.own), 2)), 1)
    inverse = torch.linalg.inv(whole)
    np.testing.assert_allclose(
        remaining_variance(found.solution),
        inverse.diagonal(dim1=-2, dim2=-1)[:, :45].unflatten(-1, (3, 15)),
        rtol=1e-5,
    )
    prior_std = problem.object_prior_std[0]
    by_offset = torch.cat((torch.diag(prior_std[:-1]), (problem.points.flatten() * prior_std[-1])[:, None]), 1)
    expected = by_offset @ inverse[:, -25:, -25:] @ by_offset.T
    torch.testing.assert_close(object_covariance(found), expected, rtol=1e-2, atol=1e-3)


def test_the_estimated_object_is_as_uncertain_as_it_says(simulate) -> None:
    case = simulate(200, snapshots=6, cameras=4, tolerance=0.3, bent=0.3, scale_tolerance=0.01, seed=5)
    found = run(case)
    error = (found.points_object - case.shape).flatten(1)
    values, vectors = torch.linalg.eigh(object_covariance(found))
    normalized = ((vectors.mT @ error[..., None]).squeeze(-1).square() / values).mean()
    assert normalized == pytest.approx(1, abs=0.08)
    cameras = found.rig.local(case.truth).flatten(1)
    solved = torch.linalg.solve(camera_covariance(found), cameras[..., None]).squeeze(-1)
    assert float((cameras * solved).sum(1).mean()) / 60 == pytest.approx(1, abs=0.08)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_shapes_and_definiteness(simulate, batch: tuple[int, ...]) -> None:
    found = run(simulate(*batch, cameras=3))
    covariance = camera_covariance(found)
    assert covariance.shape == relative_covariance(found).shape == (*batch, 45, 45)
    assert camera_std(found).shape == (*batch, 3, 15)
    torch.testing.assert_close(covariance, covariance.mT)
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert (torch.linalg.eigvalsh(covariance / (scale[..., None] * scale[..., None, :])) > 0).all()


def test_posterior_is_never_wider_than_the_prior(simulate) -> None:
    case = simulate(3, snapshots=4)
    assert (camera_std(run(case)) <= case.prior_std * (1 + 1e-3)).all()


def test_camera_that_sees_nothing_keeps_its_prior(simulate) -> None:
    case = simulate(1, cameras=4, snapshots=3)
    case.observations.seen[..., 2, :] = False
    torch.testing.assert_close(camera_std(run(case))[0, 2], case.prior_std[2])


@pytest.mark.parametrize("reference", [0, 2])
def test_relative_jacobian_is_the_derivative(simulate, reference: int) -> None:
    rig = simulate(cameras=3).truth

    def relative(step: torch.Tensor) -> torch.Tensor:
        return relative_difference(rig.retract(step), rig, reference).flatten()

    expected = torch.autograd.functional.jacobian(relative, torch.zeros(3, 15, dtype=torch.float64)).flatten(1)
    torch.testing.assert_close(relative_jacobian(rig, reference), expected, rtol=1e-8, atol=1e-8)


def test_relative_quantities_do_not_know_the_gauge(simulate) -> None:
    case = simulate(2, cameras=4, snapshots=5)
    found = run(case)
    turn = rotation_from_vector(torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64))
    elsewhere = RigidTransform(turn.expand(2, 3, 3), torch.tensor([50.0, -20.0, 30.0]).double().expand(2, 3))
    torch.testing.assert_close(
        relative_difference(found.rig.from_object(elsewhere), case.truth),
        relative_difference(found.rig, case.truth),
        rtol=1e-9,
        atol=1e-9,
    )
    covariance = relative_covariance(found, reference=1)
    assert not covariance[:, 15:21].any() and not covariance[:, :, 15:21].any()
    # A position relative to another camera is known far better than one in a frame that only the prior knows.
    relative, absolute = (
        c.diagonal(dim1=-2, dim2=-1)[:, 3:6].sum(-1).sqrt() for c in (covariance, camera_covariance(found))
    )
    assert (relative < absolute).all()


def test_matches_the_spread_of_samples(simulate) -> None:
    """Monte Carlo over noise alone, with the prior wide open where it would hold the answer back."""
    drift = PhysicalDrift(rotation_deg=0.05, position=0.5, focal_length=0.002, principal_point=2.0, distortion=0.002)
    case = simulate(250, snapshots=6, cameras=4, drift=drift, noise=0.2, sigma=0.2, seed=3)
    found = run(case)
    assert found.converged.all()
    error, std = found.rig.local(case.truth), camera_std(found)
    normalized = (error / std).square().mean((0, 1))
    assert ((normalized > 0.8) & (normalized < 1.2)).all()
    relative, variance = (
        relative_difference(found.rig, case.truth),
        relative_covariance(found).diagonal(dim1=-2, dim2=-1),
    )
    normalized = relative[:, 1:].flatten(1).square() / variance[:, 15:]
    assert normalized.mean() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("kept", [1.0, 0.4])
@pytest.mark.parametrize("relative", [False, True])
def test_one_snapshot_with_a_wide_prior_is_honest(simulate, kept: float, relative: bool) -> None:
    """Open directions bend the image: the flat posterior is up to seven times too narrow where others are sharp."""
    drift = PhysicalDrift(rotation_deg=0.57, position=10, focal_length=0.02, principal_point=10, distortion=0.05)
    case = simulate(60, snapshots=1, missing=1 - kept, drift=drift)
    found = run(case)
    if relative:
        error, covariance = relative_difference(found.rig, case.truth).flatten(1), relative_covariance(found)
        error, covariance = error[:, 15:], covariance[:, 15:, 15:]
    else:
        error, covariance = found.rig.local(case.truth).flatten(1), camera_covariance(found)
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    values, vectors = torch.linalg.eigh(covariance / (scale[..., None] * scale[:, None]))
    along = (vectors.mT @ (error / scale)[..., None]).squeeze(-1)
    assert float((along.square() / values).mean()) == pytest.approx(1, abs=0.2)


def test_undetermined_pose_is_refused(simulate) -> None:
    case = simulate(1, cameras=3, snapshots=2)
    case.observations.seen[:, 1] = False
    found = estimate(case.observations, case.factory, case.obj, case.poses, prior_std=case.prior_std)
    with pytest.raises(RefusedError, match="every snapshot"):
        camera_covariance(found)


@pytest.mark.parametrize("inflation", [(1.0, 1.0, 1.0, 1.0), (1.5, 1.5, 1.5, 1.5), (1.0, 1.4, 1.9, 1.2)])
def test_no_inflation_teaches_the_common_scale_of_rig_and_object(simulate, inflation: tuple[float, ...]) -> None:
    """A rig and an object that are larger together show the same images: only their priors know the scale."""
    case = simulate(snapshots=40, cameras=4, scale_tolerance=0.01, tolerance=0.3)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    found = replace(found, inflation=torch.tensor(inflation, dtype=torch.float64))
    larger = torch.zeros(4, 15, dtype=torch.float64)
    larger[:, 3:6] = found.rig.positions
    assert found.solution.state.object_offset is not None
    own = found.solution.state.object_offset[0].clone()  # displaced fiducials are displaced by more, and ...
    own[-1] += 1 / 0.01
    step = torch.cat((larger.flatten(), own))
    known = float((larger / case.prior_std).square().sum()) + float(own.square().sum())
    assert float(step @ joint_information(found) @ step) == pytest.approx(known, rel=1e-3)


def test_inflation_weakens_what_the_images_show_and_not_the_prior(simulate) -> None:
    case = simulate(snapshots=20, cameras=4)
    case.observations.seen[:, 3] = False
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    plain, wider = (
        torch.linalg.inv(joint_information(replace(found, inflation=factor))).diagonal().sqrt().view(4, 15)
        for factor in (None, torch.full((4,), 2.0, dtype=torch.float64))
    )
    assert (wider[:3, 6:8] > 1.8 * plain[:3, 6:8]).all()
    torch.testing.assert_close(wider[3], plain[3], rtol=1e-6, atol=0)  # saw nothing: what its prior knows


def test_inflation_of_one_camera_leaves_the_others_their_precision(simulate) -> None:
    case = simulate(snapshots=20, cameras=4)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    plain, wider = (
        torch.linalg.inv(joint_information(replace(found, inflation=factor))).diagonal().sqrt().view(4, 15)
        for factor in (None, torch.tensor([3.0, 1.0, 1.0, 1.0], dtype=torch.float64))
    )
    assert (wider[0, 6:8] > 2.0 * plain[0, 6:8]).all()
    assert (wider[1:, 6:8] < 1.2 * plain[1:, 6:8]).all()


@pytest.mark.parametrize("loss", LOSSES)
def test_a_label_that_the_loss_holds_off_counts_as_little_in_the_inflated_information(simulate, loss: LossName) -> None:
    """A factor of one on every camera is no factor, outliers or not."""
    case = simulate(snapshots=20, cameras=4)
    case.observations.uv[::3, 1, 2] += 2.0
    options = EstimationOptions(loss)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=options)
    ones = replace(found, inflation=torch.ones(4, dtype=torch.float64))
    torch.testing.assert_close(joint_information(ones), joint_information(found), rtol=1e-6, atol=1e-6)
