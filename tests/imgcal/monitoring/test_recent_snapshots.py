"""Recent snapshots: the belief before each of them, and tests on those after it."""

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RecentSnapshots, RigFilter, absorb
from imgcal.monitoring.recent_snapshots import KEPT_SNAPSHOTS
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import DriftRate, Observations

NOISE = 0.1


@pytest.mark.parametrize("tolerance", [None, 0.1])
def test_what_was_believed_before_is_found_again(tolerance: float | None) -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(4)
    if tolerance is not None:
        obj = replace(obj, tolerance=torch.full((8,), tolerance, dtype=torch.float64))
    truth = simulate_truth(factory, obj, 12, generator, PhysicalDrift())
    follows = RigFilter(factory, obj, DriftRate(rotation=1e-2, position=3.0))
    first = Observations(
        truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64),
        torch.full(truth.uv.shape[:-1], NOISE, dtype=torch.float64),
        torch.ones(truth.uv.shape[:-1], dtype=torch.bool),
    )
    follows.belief = absorb(follows.belief, first, truth.rig_from_object).belief
    recent, believed = RecentSnapshots(follows.belief, follows.walk), [follows.belief]
    for s in range(KEPT_SNAPSHOTS + 10):
        pick = s % 12
        there = Observations(first.uv[[pick]], first.sigma[[pick]], first.seen[[pick]])
        pose = RigidTransform(
            *(part[[pick]] for part in (truth.rig_from_object.rotation, truth.rig_from_object.translation))
        )
        result = follows.follow(there, pose, seconds=0.1)
        recent.append(result, there, 0.1)
        believed.append(result.belief)
    assert len(recent) == KEPT_SNAPSHOTS
    for age in (1, 2, 7, 30, KEPT_SNAPSHOTS):
        was, found = believed[-1 - age], recent.belief_before(age)
        std = was.std()
        apart = (found.rig.local(was.rig) / std).abs().max()
        assert apart < 0.05
        assert (found.std() / std - 1).abs().max() < 0.08
        assert len(recent.latest(age)[0]) == age
