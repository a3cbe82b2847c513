"""Encoders by name: ours, and classes of the user's."""

import re

import pytest
import torch
from torch import nn

from imgcal.errors import InputError
from imgcal.networks import Images, NetworkConfig
from imgcal.networks.feature_maps import make_encoder
from tests.imgcal.networks.making import make, snapshots, views

HERE = "tests.imgcal.networks.test_feature_maps"


class Mine(nn.Module):
    """An encoder of somebody's."""

    def __init__(self, features=6):
        super().__init__()
        self.layer = nn.Conv2d(3, features, 4, stride=4)

    def forward(self, images):
        return self.layer(images)


class Coarse(Mine):
    """Of another stride."""

    def forward(self, images):
        return self.layer(images)[..., ::2, ::2]


class OfGrey(Mine):
    """Fails on an image of three colours."""

    def forward(self, images):
        return self.layer(images[:, :1])


class Particular(Mine):
    """Wants an option that nobody gives it."""

    def __init__(self, **options):
        super().__init__(options["features"])


class NoModule:
    """Something else."""


def test_an_encoder_of_somebodys_is_used():
    network = make("cnn", backbone=f"{HERE}:Mine", options={"features": 5})
    assert isinstance(network.encoder, Mine) and network.positions.locator.heatmaps.in_channels == 5
    with torch.no_grad():
        assert len(network(views(network, snapshots(network)))) == network.trunk.passes


@pytest.mark.parametrize(
    ("backbone", "options", "message"),
    [
        (f"{HERE}:Coarse", {}, "expected features of shape (1, F, 56, 56): a stride of 4"),
        (f"{HERE}:NoModule", {}, "expected a subclass of torch.nn.Module"),
        (f"{HERE}:OfGrey", {}, ": fails on images of shape (1, 3, 224, 224): RuntimeError: Given groups=1"),
        (f"{HERE}:Particular", {}, ": cannot be built with its options: KeyError: 'features'"),
        (f"{HERE}:Nothing", {}, ", which cannot be imported: AttributeError"),
        ("no.such.module:Mine", {}, "backbone: found `no.such.module:Mine`, which cannot be imported"),
        (f"{HERE}:Mine", {"depth": 3}, "cannot be built with its options"),
        ("cnn", {"embed_dim": 16}, "cannot be built with its options"),
        ("vit", {"embed_dim": 8192, "depth": 100}, "weights, expected at most"),
        ("vit", {"embed_dim": 10, "num_heads": 4}, "cannot be built with its options"),
    ],
)
def test_what_does_not_fit_is_one_line(backbone, options, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        make_encoder(Images(backbone=backbone, options=options), None)
    said = str(caught.value)
    assert "\n" not in said and len(said) < 500 and said.count("backbone") == 1


def test_only_models_of_timm_have_published_weights():
    with pytest.raises(InputError, match="but only timm models have pretrained weights"):
        make_encoder(Images(backbone="cnn", pretrained=True), None)


@pytest.mark.parametrize("preset", ["vit-pooled", "cnn-pooled", "vit", "cnn"])
@pytest.mark.parametrize("backbone", ["vit_tiny_patch16_224", "resnet18"])
def test_a_named_encoder_does_not_inherit_the_options_of_the_presets(preset, backbone):
    config = NetworkConfig(preset=preset, change={"backbone": backbone}).variant()
    assert config.backbone == backbone and config.options == {}
    mine = {"global_pool": "avg"}
    assert NetworkConfig(preset=preset, change={"backbone": backbone, "options": mine}).variant().options == mine


def test_a_named_encoder_is_the_one_of_that_name():
    network = make("vit-pooled", backbone="vit_tiny_patch16_224")
    assert network.encoder.model.embed_dim == 192 and len(network.encoder.model.blocks) == 12
    assert sum(p.numel() for p in make("cnn-pooled", backbone="resnet18").encoder.parameters()) == 11_176_512
