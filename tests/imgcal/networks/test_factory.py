"""Networks from their configuration."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.networks import NetworkConfig, build
from imgcal.synthesis import ImageOptions
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


@pytest.mark.parametrize("preset", ["cnn", "vit", "cnn-pooled"])
def test_images_that_are_too_small_for_an_encoder_are_refused(preset):
    rig, obj = read_rig("T4").to(torch.float32), load_object("cube8")
    with pytest.raises(InputError, match=f"^images: size: found 16, expected 20 or more for network {preset}$"):
        build(NetworkConfig(preset=preset), rig, obj, DRIFT.std(rig), torch.Generator(), ImageOptions(size=16))
