"""The filter against the batch estimate, and what it must never learn."""

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.estimation import (
    EstimationOptions,
    RigBelief,
    RigFilter,
    absorbed,
    aged,
    camera_covariance,
    displaced,
    estimate,
)
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import DriftRate, Observations

NOISE = 0.05
SQUARED = EstimationOptions(loss="squared", tolerance=1e-8)
STEADY = DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def made():
    """A drifted rig of four cameras and 24 snapshots of an object."""
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(3)
    truth = simulate_truth(factory, obj, 24, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = torch.rand(uv.shape[:-1], generator=generator) > 0.1
    observations = Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen)
    return factory, obj, truth, observations


def part(observations: Observations, first: int, last: int) -> Observations:
    return Observations(*(x[first:last] for x in (observations.uv, observations.sigma, observations.seen)))


def snapshots(made, first: int, last: int):
    """Observations and poses of some snapshots."""
    _, _, truth, observations = made
    return part(observations, first, last), truth.rig_from_object[first:last]


def batch(made, count: int, obj=None):
    factory, given, truth, observations = made
    poses = truth.rig_from_object[:count]
    return estimate(part(observations, 0, count), factory, obj or given, poses, options=SQUARED)


def worst(belief: RigBelief, fit) -> tuple[float, float]:
    """Largest difference from a batch estimate in its standard deviations, and largest ratio of these, above 1."""
    std = camera_covariance(fit, curved=False).diagonal().sqrt()
    ratio = belief.std().flatten() / std
    difference = belief.rig.local(fit.rig).flatten() / std
    return float(difference.abs().max()), float(torch.maximum(ratio, 1 / ratio).max())


@pytest.mark.parametrize("count", [1, 3])
def test_what_is_absorbed_together_is_the_batch_estimate(made, count: int) -> None:
    factory, obj, _, _ = made
    result = absorbed(RigBelief.of_prior(factory, obj), *snapshots(made, 0, count), SQUARED)
    difference, ratio = worst(result.belief, batch(made, count))
    assert difference < 0.01
    assert ratio < 1.001


def test_an_object_with_tolerances_is_learnt_along(made) -> None:
    factory, obj, _, _ = made
    loose = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64), scale_tolerance=1e-3)
    result = absorbed(RigBelief.of_prior(factory, loose), *snapshots(made, 0, 4), SQUARED)
    fit = batch(made, 4, loose)
    difference, ratio = worst(result.belief, fit)
    assert difference < 0.01
    assert ratio < 1.001
    torch.testing.assert_close(result.belief.points_object, fit.points_object, atol=1e-3, rtol=0)


def test_one_snapshot_after_another_is_the_batch_estimate(made) -> None:
    factory, obj, _, _ = made
    follows = RigFilter(factory, obj, STEADY, SQUARED)
    for s in range(24):
        follows.update(*snapshots(made, s, s + 1))
    difference, ratio = worst(follows.belief, batch(made, 24))
    assert difference < 0.1
    assert ratio < 1.05


def test_nothing_is_learnt_of_motions_of_the_whole_rig(made) -> None:
    factory, obj, _, _ = made
    prior = belief = RigBelief.of_prior(factory, obj)
    for s in range(24):  # each linearized elsewhere
        belief = absorbed(belief, *snapshots(made, s, s + 1), SQUARED).belief
    whole = torch.cat((torch.eye(6, dtype=torch.float64), torch.zeros(9, 6, dtype=torch.float64))).repeat(4, 1)
    whole = whole / belief.unit.reshape(-1, 1)
    before, after = (whole.mT @ b.information @ whole for b in (prior, belief))
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4 * float(before.max()))


def test_time_widens_what_is_known_and_moves_nothing(made) -> None:
    factory, obj, _, _ = made
    rate = DriftRate(focal_length=1e-3, principal_point=2.0, distortion=1e-3, rotation=1e-3, position=1.0)
    known = absorbed(RigBelief.of_prior(factory, obj), *snapshots(made, 0, 6), SQUARED).belief
    later = aged(known, 4 * 3600.0, rate)
    expected = (known.std().square() + 4 * rate.std(known.rig).square()).sqrt()
    torch.testing.assert_close(later.std(), expected, rtol=1e-6, atol=0)
    assert later.rig is known.rig


def test_a_rig_that_wanders_is_followed(made) -> None:
    factory, obj, truth, _ = made
    generator = torch.Generator().manual_seed(7)
    rate = DriftRate(focal_length=2e-3, principal_point=2.0, distortion=0.0, rotation=1e-3, position=0.5)
    follows, rig = RigFilter(factory, obj, rate), truth.rig
    for s in range(24):
        rig = rig.retract(rate.std(rig) * torch.randn(4, 15, generator=generator, dtype=torch.float64))
        points = truth.rig_from_object[s].apply(obj.points)
        uv = rig.project(points, obj.radius).uv[None]
        uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=torch.float64)
        seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
        there = Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen)
        follows.update(there, truth.rig_from_object[s : s + 1], seconds=3600.0)
    error = follows.belief.rig.local(rig).flatten()
    squared = float(error @ torch.linalg.solve(follows.belief.covariance(), error)) / 60
    assert 0.6 < squared < 1.5  # 60 degrees of freedom: sd 0.18


def test_a_snapshot_that_says_nothing_of_the_pose_is_refused_and_changes_nothing(made) -> None:
    factory, obj, _, _ = made
    follows = RigFilter(factory, obj, STEADY, SQUARED)
    follows.update(*snapshots(made, 0, 1))
    second, pose = snapshots(made, 1, 2)
    before = follows.belief
    few = torch.zeros_like(second.seen)
    few[0, 0, :2] = True
    with pytest.raises(RefusedError, match="pose"):
        follows.update(Observations(second.uv, second.sigma, few), pose)
    assert follows.belief is before
    follows.update(second, pose)
    assert worst(follows.belief, batch(made, 2))[0] < 0.05


def test_a_snapshot_has_one_pose(made) -> None:
    factory, obj, truth, observations = made
    with pytest.raises(ValueError, match="found 2 poses of 1 snapshots"):
        absorbed(RigBelief.of_prior(factory, obj), part(observations, 0, 1), truth.rig_from_object[:2])


def test_a_belief_may_be_moved_as_a_whole(made) -> None:
    factory, obj, _, _ = made
    belief = RigBelief.of_prior(factory, obj)
    assert torch.allclose(belief.std(), (factory.prior or imgcal.types.RigPrior()).std(factory), rtol=1e-6)
    assert displaced(belief.rig, torch.zeros(4, 15, dtype=torch.float64)).camera_names == factory.camera_names
