"""Encoders of timm: any of them fits, none comes from a place."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.networks.backbone import Backbone
from tests.imgcal.networks.making import make, snapshots, views


@pytest.mark.parametrize(
    ("backbone", "options"),
    [
        ("swin_tiny_patch4_window7_224", {"embed_dim": 24, "depths": [1, 1], "num_heads": [1, 2]}),
        ("mobilenetv3_small_050", {}),  # a pooled feature of another width than the map's
    ],
)
def test_any_backbone_fits(backbone, options):
    network = make("vit-pooled", backbone=backbone, options=options)
    with torch.no_grad():
        pooled = network.encoder(torch.rand(2, 3, 224, 224, generator=torch.Generator().manual_seed(0)))
        assert pooled.shape == (2, network.bottleneck.in_features)
        assert len(network(views(network, snapshots(network)))) == network.trunk.passes


@pytest.mark.parametrize(
    ("backbone", "options", "size"),
    [
        ("vit_small_patch14_dinov2", {"depth": 1}, 518),
        ("vit_small_patch14_reg4_dinov2", {"depth": 1, "img_size": 224}, 224),
        ("eva02_tiny_patch14_336", {"depth": 1}, 336),
    ],
)
def test_a_backbone_knows_the_size_of_its_images(backbone, options, size):
    assert Backbone(backbone, False, options, size=96).size == (size, size)
    network = make("vit-pooled", backbone=backbone, options=options)
    assert network.encoder.size == (size, size) and network.image_options.size == size


def test_convolutions_see_images_of_any_size_as_they_are():
    options = {"layers": [1, 1, 1, 1], "channels": [8, 8, 8, 8]}
    assert Backbone("resnet18", False, options).size == (224, 224)
    small = Backbone("resnet18", False, options, size=64).eval()
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = small.model.forward_head(small.model.forward_features(images), pre_logits=True)
        assert torch.equal(small(images), expected)


@pytest.mark.parametrize(
    "backbone", ["local-dir:/tmp/evil", "hf-hub:evil/vit", "/tmp/evil", "../vit_tiny_patch16_224", "x" * 150]
)
def test_a_backbone_is_no_place(backbone, monkeypatch):
    monkeypatch.setattr("imgcal.networks.backbone.timm.create_model", None)
    with pytest.raises(InputError, match="expected a timm model"):
        make("vit", backbone=backbone, options={})


def test_options_that_do_not_go_together_are_one_line():
    for options in ({"embed_dim": 100, "num_heads": 3}, {"patch_size": 0}, {"dims": [8]}, {"depth": [1, 2]}):
        with pytest.raises(InputError, match="backbone vit_tiny_patch16_224") as caught:
            make("vit-pooled", options=options)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_the_weights_of_a_backbone_are_counted_before_they_are_made(monkeypatch):
    with pytest.raises(InputError, match=r"1,842,\d+,\d+ weights, expected at most"):
        make("vit", backbone="vit_gigantic_patch14_224", options={})


def test_an_unknown_backbone_is_refused():
    with pytest.raises(InputError, match="nearest: vit_tiny_patch16_224"):
        make("vit", backbone="vit_tiny_patch16_225")


def test_pretrained_weights_that_cannot_be_loaded_say_what_to_do(monkeypatch, tmp_path):
    def offline(*_, **__):
        raise OSError("no route to host")

    monkeypatch.setattr("imgcal.networks.backbone.timm.create_model", offline)
    with pytest.raises(InputError, match="HF_HOME"):
        make("vit-pooled", pretrained=True)
