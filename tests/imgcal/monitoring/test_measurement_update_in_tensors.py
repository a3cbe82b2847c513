"""The obvious way of learning from snapshots against the batch estimate; the compiled way: test_absorption_cpu."""

import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.monitoring import RigBelief
from tests.imgcal.monitoring.made_snapshots import SQUARED, batch, made_snapshots, snapshots, worst
from tests.imgcal.monitoring.measurement_update_in_tensors import update_in_tensors


def test_it_is_the_batch_estimate() -> None:
    made = made_snapshots()
    factory, obj, _, _ = made
    result = update_in_tensors(RigBelief.of_prior(factory, obj), *snapshots(made, 0, 2), SQUARED)
    difference, ratio = worst(result.belief, batch(made, 2))
    assert difference < 0.01
    assert ratio < 1.001


def test_a_belief_that_nothing_is_known_of_is_refused() -> None:
    made = made_snapshots()
    factory, obj, _, _ = made
    belief = RigBelief.of_prior(factory, obj)
    unknown = RigBelief(belief.rig, obj, belief.object_offset, torch.zeros_like(belief.factor), belief.unit)
    with pytest.raises(RefusedError, match="do not determine the rig"):
        update_in_tensors(unknown, *snapshots(made, 0, 1), SQUARED)
