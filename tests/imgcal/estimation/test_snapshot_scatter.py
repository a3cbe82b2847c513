"""Covariance by the scatter between blocks of snapshots: silent for white noise, right for errors of places."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import BlockScatter, block_scatter, camera_covariance, camera_std, estimate, snapshot_scatter
from imgcal.estimation.robust_losses import NamedLoss
from imgcal.estimation.snapshot_scatter import linearize_blocks
from imgcal.geometry import RigidTransform

LOSS = NamedLoss("huber", 3.0)


def scatter(found) -> BlockScatter:
    return block_scatter(found.problem, found.solution, LOSS)


@pytest.mark.parametrize("snapshots", [6, 40])
def test_white_noise_makes_no_more_scatter_than_it_should(simulate, snapshots: int) -> None:
    for seed in range(6):
        case = simulate(snapshots=snapshots, cameras=4, missing=0.2, seed=seed)
        found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
        assert scatter(found) == BlockScatter()


def test_too_few_snapshots_say_nothing(simulate) -> None:
    case = simulate(snapshots=5, cameras=4)
    assert scatter(estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)).length == 0


def wandering(simulate, blocks: int, each: int):
    """One rig, an object that wanders slowly sideways, and lens errors that change over some 70 px: (blocks, each)."""
    case = simulate(blocks, snapshots=each, cameras=4, noise=0.0, seed=2)
    count = blocks * each
    period = torch.tensor([17.0, 23.0, 29.0], dtype=torch.float64)
    path = 60 * torch.sin(2 * torch.pi * torch.arange(count)[:, None] / period).view(blocks, each, 3)
    poses = RigidTransform(case.poses.rotation[:1, :1].expand(blocks, each, 3, 3), case.poses.translation + path)
    truth = case.truth[0]
    points = poses.reshape(count).apply(case.obj.points)
    uv = truth.expand(count).project(points).uv.view(blocks, each, 4, 8, 2)
    generator = torch.Generator().manual_seed(3)
    noise = 0.03 * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
    uv = uv + 0.1 * torch.sin(uv.flip(-1) / 60 + torch.arange(4)[:, None, None]) + noise
    return replace(case, observations=replace(case.observations, uv=uv), poses=poses), truth


def test_blocks_of_a_capture_scatter_as_the_published_covariance_says(simulate) -> None:
    case, _ = wandering(simulate, 8, 48)
    focal, flat, published = [], [], []
    for row in range(8):
        one = case.observations.of_snapshots(row)
        one = replace(one, sigma=torch.full_like(one.sigma, 0.075))  # what the residuals show
        found = estimate(one, case.factory, case.obj, case.poses[row], prior_std=case.prior_std)
        measured = replace(found, inflation=scatter(found).factor)
        focal.append(found.rig.focal_length.flatten())
        flat.append(camera_std(found)[:, 6:8].flatten())
        published.append(camera_std(measured)[:, 6:8].flatten())
    prior_std = torch.stack(focal) - torch.stack(focal).mean(0)
    by_noise, by_blocks = (float((prior_std / torch.stack(std)).square().sum() / (7 * 8)) for std in (flat, published))
    assert by_noise > 2.0
    assert by_blocks < 0.7 * by_noise and by_blocks < 2.0


def test_inflation_leaves_the_prior_and_the_relations_alone(simulate) -> None:
    case = simulate(snapshots=10, cameras=3)
    case.observations.seen[:, 2] = False
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    plain, larger = (
        camera_covariance(replace(found, inflation=factor), curved=False)
        for factor in (None, torch.full((3,), 2.0, dtype=torch.float64))
    )
    std, more = (torch.as_tensor(np.sqrt(c.diagonal().numpy())).view(3, 15) for c in (plain, larger))
    torch.testing.assert_close(more[2], std[2])  # a camera that saw nothing knows what its prior knows
    assert (more[:2, 6:8] > 1.8 * std[:2, 6:8]).all()
    scale = larger.diagonal().sqrt()
    assert torch.linalg.eigvalsh(larger / (scale[:, None] * scale)).min() > 0


@pytest.mark.parametrize("snapshots", [3, 20])  # poses kept, cameras kept
def test_inflation_leaves_the_object_s_scale_as_uncertain_as_its_prior(simulate, snapshots: int) -> None:
    """No image shows a rig and an object that are larger together, so disagreeing images say nothing about them."""
    case = simulate(snapshots=snapshots, cameras=3, tolerance=0.3)
    found = estimate(case.observations, case.factory, case.obj, prior_std=1e3 * case.prior_std)
    away = found.rig.positions - found.rig.positions.mean(0)
    size = torch.zeros(3, 15, dtype=torch.float64)
    size[:, 3:6] = away / away.square().sum()
    plain, larger = (
        float(size.flatten() @ camera_covariance(replace(found, inflation=factor), curved=False) @ size.flatten())
        for factor in (None, torch.full((3,), 3.0, dtype=torch.float64))
    )
    points = case.obj.points - case.obj.points.mean(0)
    by_object = 0.3**2 / float(points.square().sum())
    assert by_object < larger < by_object + 10 * (plain - by_object)


def test_the_camera_whose_lens_is_bad_gets_the_larger_factor(simulate) -> None:
    case, _ = wandering(simulate, 1, 96)
    one = case.observations.of_snapshots(0)
    clean = case.truth[0].expand(96).project(case.poses[0].apply(case.obj.points)).uv
    uv = one.uv.clone()
    uv[:, 1:] = clean[:, 1:] + 0.075 * torch.randn(clean[:, 1:].shape, generator=torch.Generator().manual_seed(1))
    one = replace(one, uv=uv, sigma=torch.full_like(one.sigma, 0.075))
    factor = scatter(estimate(one, case.factory, case.obj, case.poses[0], prior_std=case.prior_std)).factor
    assert factor is not None
    assert factor[0] > 1.2 * factor[1:].max()


def test_errors_that_last_in_one_camera_of_many_widen_that_camera_alone(simulate) -> None:
    case = simulate(snapshots=128, cameras=8, noise=0.1, seed=1)
    generator, shift, memory = torch.Generator().manual_seed(2), torch.zeros(2, dtype=torch.float64), 0.9
    uv = case.observations.uv.clone()
    for row in range(128):  # on average over all cameras, there is no more scatter than noise would make
        noise = torch.randn(2, generator=generator, dtype=torch.float64)
        shift = memory * shift + (1 - memory**2) ** 0.5 * 0.3 * noise
        uv[row, 5] += shift
    seen = replace(case.observations, uv=uv, sigma=torch.full_like(case.observations.sigma, 0.1))
    factor = scatter(estimate(seen, case.factory, case.obj, prior_std=case.prior_std)).factor
    assert factor is not None and factor[5] > 1.2
    assert (factor[torch.arange(8) != 5] == 1).all()


@pytest.mark.parametrize("tolerance", [0.0, 0.05])
def test_the_total_information_is_that_of_all_blocks(simulate, tolerance: float) -> None:
    case = simulate(snapshots=9, cameras=4)
    obj = replace(case.obj, tolerance=torch.full((len(case.obj.points),), tolerance, dtype=torch.float64))
    found = estimate(case.observations, case.factory, obj, prior_std=case.prior_std)
    evidence = linearize_blocks(found.problem, found.solution.state, 3, LOSS)
    each, size = evidence.information(), found.problem.prior_std[0].numel()
    assert each.shape == (3, *2 * (size + (3 * len(obj.points) + 1 if tolerance else 0),))
    torch.testing.assert_close(evidence.total(), each.sum(0), rtol=1e-9, atol=1e-9 * float(each.abs().max()))


@pytest.mark.parametrize("size", [0.0, 0.03, 0.06])
def test_what_the_first_order_test_does_not_measure_has_no_excess(simulate, monkeypatch, size: float) -> None:
    measured, measure = 0, snapshot_scatter._scatter
    for seed in range(10):
        case = simulate(snapshots=40, cameras=4, seed=seed)
        lasting = torch.zeros(40, 2, dtype=torch.float64)
        steps = torch.randn(40, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        for s in range(1, 40):
            lasting[s] = 0.8 * lasting[s - 1] + 0.6 * steps[s]
        case.observations.uv[:, 1] += size * lasting[:, None]
        found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
        calls = []
        with monkeypatch.context() as patch:
            patch.setattr(
                snapshot_scatter, "_scatter", lambda *given, calls=calls: (calls.append(1), measure(*given))[1]
            )
            quick = scatter(found)
            patch.setattr(snapshot_scatter, "WORTH_MEASURING", -torch.inf)
            assert (quick.factor is None) == (scatter(found).factor is None)
        measured += quick.factor is None and len(calls) > 3  # both measured: three lengths each
    assert size > 0 or measured <= 3  # white noise
