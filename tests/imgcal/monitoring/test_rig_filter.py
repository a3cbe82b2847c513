"""One snapshot after another, against the batch estimate."""

import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.monitoring import RigFilter
from imgcal.types import DriftRate, Observations
from tests.imgcal.monitoring.made_snapshots import NOISE, SQUARED, STEADY, batch, made_snapshots, snapshots, worst


@pytest.fixture(scope="module")
def made():
    return made_snapshots()


def test_one_snapshot_after_another_is_the_batch_estimate(made) -> None:
    factory, obj, _, _ = made
    follows = RigFilter(factory, obj, STEADY, SQUARED)
    for s in range(24):
        follows.update(*snapshots(made, s, s + 1))
    difference, ratio = worst(follows.belief, batch(made, 24))
    assert difference < 0.1
    assert ratio < 1.05


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
