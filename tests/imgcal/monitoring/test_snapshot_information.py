"""Information from single snapshots: the gain of the belief, and its balance at the estimate."""

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.monitoring import MeasurementUpdate, RigBelief, absorb
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations

NOISE = 0.1


def learnt(tolerance: float | None) -> MeasurementUpdate:
    """Absorb six snapshots, of which not everything is seen."""
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(5)
    if tolerance is not None:
        obj = replace(obj, tolerance=torch.full((8,), tolerance, dtype=torch.float64))
    truth = simulate_truth(factory, obj, 6, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = torch.rand(uv.shape[:-1], generator=generator) > 0.2
    sigma = torch.full(seen.shape, NOISE, dtype=torch.float64)
    return absorb(RigBelief.of_prior(factory, obj), Observations(uv, sigma, seen), truth.rig_from_object)


@pytest.mark.parametrize("tolerance", [None, 0.1])
def test_it_is_what_the_belief_gains(tolerance: float | None) -> None:
    result = learnt(tolerance)
    gained = result.belief.information - result.before.information
    assert (result.brought.information() - gained).abs().max() < 1e-9 * gained.abs().max()
    parts = [result.brought.select(slice(s, s + 1)) for s in range(6)]
    assert (sum(part.information() for part in parts) - gained).abs().max() < 1e-9 * gained.abs().max()


@pytest.mark.parametrize("tolerance", [None, 0.1])
def test_belief_and_pull_balance_where_the_estimate_is(tolerance: float | None) -> None:
    result = learnt(tolerance)
    brought, belief, before = result.brought, result.belief, result.before
    here = brought.distance_from(belief.rig, belief.object_offset)
    pull = brought.pull.sum(0) - brought.information() @ here
    back = before.information @ (brought.distance_from(before.rig, before.object_offset) - here)
    weight = torch.linalg.solve(belief.information, pull + back)
    assert float(weight @ (pull + back)) < 1e-3  # squared standard deviations
