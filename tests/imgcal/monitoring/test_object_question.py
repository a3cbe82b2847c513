"""Snapshots that fit worse than is usual make one ask for the object, and that is answered."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import EstimationOptions
from imgcal.monitoring import RigFilter, absorb
from imgcal.monitoring.object_question import LEAST_USUAL, Misfit, never_fitted, object_explains
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations

NOISE = 0.1


def test_a_misfit_is_noticed_after_some_snapshots_and_counted() -> None:
    random, watch = np.random.default_rng(1), Misfit()
    assert [watch.take(random.chisquare(60), 60) for _ in range(500)] == [0] * 500
    taken = [watch.take(2 * random.chisquare(60), 60) for _ in range(10)]
    first = next(number for number, age in enumerate(taken) if age)
    assert first < 8 and first <= taken[first] <= first + 3


def test_one_wrong_snapshot_and_a_beginning_are_no_misfit() -> None:
    random, watch = np.random.default_rng(2), Misfit()
    assert [watch.take(9 * random.chisquare(60), 60) for _ in range(LEAST_USUAL - 1)] == [0] * (LEAST_USUAL - 1)
    watch = Misfit()
    for _ in range(100):
        watch.take(random.chisquare(60), 60)
    assert watch.take(1e4, 60) == 0


@pytest.mark.parametrize("bent", [False, True])
def test_an_object_that_never_was_as_its_file_says_explains_the_first_snapshots(bent: bool) -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(8)
    points = obj.points.clone()
    points[5] += bent * torch.tensor([0.6, -0.5, 0.6])
    truth = simulate_truth(factory, replace(obj, points=points), 16, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), torch.ones(uv.shape[:-1]) > 0)
    before = RigFilter(factory, obj).belief
    result = absorb(before, seen, truth.rig_from_object)
    assert never_fitted(result, 16) == bent
    assert not never_fitted(result, 15)  # not asked then
    parts = [(seen.of_snapshots([s]), truth.rig_from_object[s : s + 1]) for s in range(16)]
    found = object_explains(before, parts, EstimationOptions())
    assert (found is not None) == bent
    if found is not None:
        assert found[0].fiducial == 5
