"""Our own encoders: one output stride, matched sizes."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from imgcal.networks.encoders import STRIDE, Cells, CnnEncoder, Pyramid, VitEncoder, resize_images
from imgcal.training.optimization import layer_scales


def encoders(size=224):
    torch.manual_seed(0)
    return {"cnn": CnnEncoder(64), "vit": VitEncoder(64, size)}


@pytest.mark.parametrize("size", [32, 50, 224])
def test_both_give_a_map_at_the_same_stride(size):
    for encoder in encoders(size).values():
        with torch.no_grad():
            features = encoder(torch.rand(2, 3, size, size))
        side = -(-size // STRIDE)
        assert features.shape == (2, 64, side, side)


def test_both_cost_about_the_same():
    weights, flops = [], []
    for encoder in encoders().values():
        weights.append(sum(parameter.numel() for parameter in encoder.parameters()))
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            encoder(torch.rand(1, 3, 224, 224))
        flops.append(counter.get_total_flops())
    for pair in (weights, flops):
        assert max(pair) / min(pair) < 1.2
    assert min(weights) > 0.9e6 and max(flops) < 0.7e9


@pytest.mark.parametrize("name", ["cnn", "vit"])
def test_the_map_is_where_the_image_is(name):
    """What changes in one corner changes the features most in that corner."""
    encoder = encoders(64)[name]
    images = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0)).repeat(2, 1, 1, 1)
    images[1, :, 48:, :16] = 0
    with torch.no_grad():
        one, other = encoder(images)
    apart = (one - other).abs().sum(0)
    corners = {(v, u): float(apart[v : v + 4, u : u + 4].mean()) for v in (0, 12) for u in (0, 12)}
    assert max(corners, key=corners.__getitem__) == (12, 0)


def test_a_token_becomes_the_cells_of_its_patch():
    cells = Cells(2, 1, 3)
    tokens = torch.zeros(1, 2, 2, 2)
    tokens[0, :, 0, 1] = 1
    with torch.no_grad():
        touched = cells(tokens) - cells(torch.zeros_like(tokens))
    assert touched.shape == (1, 1, 6, 6)
    assert (
        touched[0, 0, :3, 3:].abs().min() > 0 and touched[0, 0, 3:].abs().max() == touched[0, 0, :, :3].abs().max() == 0
    )


def test_a_pyramid_adds_coarse_maps_to_fine_ones():
    pyramid = Pyramid((3, 5), 4)
    with torch.no_grad():
        fine, coarse = torch.rand(1, 3, 6, 6), torch.rand(1, 5, 3, 3)
        summed = pyramid((fine, coarse)) - pyramid((fine, torch.zeros_like(coarse)))
        expected = torch.nn.functional.conv2d(coarse, pyramid.lateral[1].weight).repeat_interleave(2, 2)
    torch.testing.assert_close(summed, expected.repeat_interleave(2, 3))


def test_images_of_the_right_size_are_left_alone():
    images = torch.rand(1, 3, 8, 8)
    assert resize_images(images, (8, 8)) is images and resize_images(images, (4, 6)).shape == (1, 3, 4, 6)


@pytest.mark.parametrize("name", ["cnn", "vit"])
def test_layers_near_the_images_may_learn_more_slowly(name):
    encoder = encoders(32)[name]
    scales = {name: layer_scales(encoder, 0.5)[p] for name, p in encoder.named_parameters()}
    first = "stem.weight" if name == "cnn" else "patches.weight"
    last = "pyramid.lateral.0.weight" if name == "cnn" else "cells.linear.weight"
    assert scales[first] == min(scales.values()) < scales[last] == 1
    assert len(set(scales.values())) >= 5
