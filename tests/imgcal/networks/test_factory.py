"""Networks from their configuration."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.networks import NetworkConfig, build
from tests.imgcal.networks.making import DRIFT, make


def test_a_rig_without_working_distance_is_refused():
    from dataclasses import replace

    factory = replace(read_rig("T4").to(torch.float32), working_distance=None)
    with pytest.raises(InputError, match="working_distance"):
        build(NetworkConfig(preset="points"), factory, load_object("cube8"), DRIFT.std(factory), torch.Generator())


def test_weights_come_from_the_generator_alone():
    torch.manual_seed(5)
    before = torch.get_rng_state()
    one, same = make("points"), make("points")
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), same.parameters(), strict=True))
    first = one.trunk.first.embed[0]
    torch.manual_seed(0)  # as torch would draw them after a seed of its own
    assert torch.equal(first.weight, torch.nn.Linear(first.in_features, first.out_features).weight)
