"""Encoders of timm: any of them gives a map at a stride of 4 pixels, where things are in the image."""

import pytest
import torch

from imgcal.networks.timm_encoder import TimmEncoder
from tests.imgcal.networks.making import make, snapshots, views


@pytest.mark.parametrize(
    ("backbone", "options", "adds"),
    [
        ("swin_tiny_patch4_window7_224", {"embed_dim": 24, "depths": [1, 1], "num_heads": [1, 2]}, True),
        ("mobilenetv3_small_050", {}, True),
        ("resnet10t", {}, True),
        ("mixer_s32_224", {}, False),  # tokens, and none before the patches
        ("deit_tiny_distilled_patch16_224", {"depth": 1}, False),  # two tokens before the patches
    ],
)
def test_any_backbone_gives_a_map_at_the_same_stride(backbone, options, adds):
    torch.manual_seed(0)
    encoder = TimmEncoder(backbone, False, options, 8).eval()
    assert bool(encoder.levels) == adds
    images = torch.rand(1, 3, 224, 224, generator=torch.Generator().manual_seed(0)).repeat(2, 1, 1, 1)
    images[1, :, 112:, :112] = 0  # a corner of one image
    with torch.no_grad():
        one, other = encoder(images)
    assert one.shape == (8, 56, 56)
    apart = (one - other).abs().sum(0)
    assert apart[40:, :16].mean() > apart[:16, 40:].mean()


@pytest.mark.parametrize(
    ("backbone", "options", "size"),
    [("vit_tiny_patch16_384", {"depth": 1}, 384), ("vit_small_patch14_reg4_dinov2", {"depth": 1, "img_size": 70}, 70)],
)
def test_a_backbone_gets_images_of_its_own_size(backbone, options, size):
    network = make("vit", backbone=backbone, options=options)
    assert network.encoder.size == (size, size) and network.image_options.size == size
    with torch.no_grad():
        given = views(network, snapshots(network, 1))
        assert network.encoder(given.images[0]).shape[2:] == (-(-size // 4),) * 2
        assert len(network(given)) == network.trunk.passes


def test_images_are_normalized_as_the_model_was_trained():
    encoder = TimmEncoder("mobilenetv3_small_050", False, {}, 4)
    assert encoder.mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    other = TimmEncoder("vit_tiny_patch16_224", False, {"depth": 1}, 4)
    assert other.std.flatten().tolist() == pytest.approx([0.5, 0.5, 0.5])
    assert not [name for name in other.state_dict() if name in ("mean", "std")]
