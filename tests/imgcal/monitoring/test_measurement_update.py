"""What is learnt from some snapshots at once, against the batch estimate."""

from dataclasses import replace

import pytest
import torch

from imgcal.monitoring import RigBelief, absorb
from tests.imgcal.monitoring.made_snapshots import SQUARED, batch, made_snapshots, part, snapshots, worst


@pytest.fixture(scope="module")
def made():
    return made_snapshots()


@pytest.mark.parametrize("count", [1, 3])
def test_what_is_absorbed_together_is_the_batch_estimate(made, count: int) -> None:
    factory, obj, _, _ = made
    result = absorb(RigBelief.of_prior(factory, obj), *snapshots(made, 0, count), SQUARED)
    difference, ratio = worst(result.belief, batch(made, count))
    assert difference < 0.01
    assert ratio < 1.001


def test_an_object_with_tolerances_is_learnt_along(made) -> None:
    factory, obj, _, _ = made
    loose = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64), scale_tolerance=1e-3)
    result = absorb(RigBelief.of_prior(factory, loose), *snapshots(made, 0, 4), SQUARED)
    fit = batch(made, 4, loose)
    difference, ratio = worst(result.belief, fit)
    assert difference < 0.01
    assert ratio < 1.001
    torch.testing.assert_close(result.belief.points_object, fit.points_object, atol=1e-3, rtol=0)


def test_a_snapshot_has_one_pose(made) -> None:
    factory, obj, truth, observations = made
    with pytest.raises(ValueError, match="found 2 poses of 1 snapshots"):
        absorb(RigBelief.of_prior(factory, obj), part(observations, 0, 1), truth.rig_from_object[:2])
