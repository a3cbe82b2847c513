"""Networks of images."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, load_rig
from imgcal.networks import NetworkConfig, build
from imgcal.synthesis.colour_coding import ImageOptions
from imgcal.types import Views
from tests.imgcal.networks.making import DRIFT, make, snapshots, views


def test_images_are_drawn_as_is_asked_for():
    factory, thing = load_rig("T4").to(torch.float32), load_object("asymmetric8")
    given = (factory, thing, DRIFT.std(factory), torch.Generator(), ImageOptions(size=64, dot=2.0))
    assert build(NetworkConfig(preset="vit"), *given).image_options == ImageOptions(size=64, dot=2.0)
    with pytest.raises(InputError, match="the network points takes points"):
        build(NetworkConfig(preset="points"), *given)


def test_images_are_what_is_asked_of_the_views():
    network = make("vit")
    made = snapshots(network)
    with pytest.raises(ValueError, match=r"needs views\.images, found points only"):
        network(Views(uv=made.projection.uv, seen=made.projection.visible))


def test_positions_alone_move_the_networks_that_are_told_them():
    """A pooled variant sees the images through its encoder only: with a silent bottleneck all images are one."""
    for preset, told in (("vit", True), ("vit-pooled", False)):
        network = make(preset)
        with torch.no_grad():
            for parameter in network.trunk.parameters():
                parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
            for parameter in network.bottleneck.parameters():
                parameter.zero_()
            found = network(views(network, snapshots(network)))[0].rig.focal_length
        assert torch.equal(found[0], found[1]) != told
