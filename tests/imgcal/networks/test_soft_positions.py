"""Soft positions of colour-coded dots, against where they were drawn."""

import pytest
import torch

from imgcal.networks import find_soft_positions
from renderers import palette, splat

COLOURS = palette(8)


def draw(uv, size=96, dot=1.5, visible=None):
    images = splat(uv, COLOURS, dot, (size, size), visible=visible).clamp(0, 1)
    return (images * 255).round() / 255


@pytest.fixture
def apart():
    """Positions (5, 8, 2) that lie at least 12 pixels from each other."""
    generator = torch.Generator().manual_seed(0)
    grid = torch.stack(torch.meshgrid(torch.arange(3.0), torch.arange(3.0), indexing="ij"), -1).reshape(-1, 2)[:8]
    return 20 + 28 * grid + 8 * torch.rand((5, 8, 2), generator=generator)


def test_dots_that_lie_apart_are_found_to_a_hundredth_of_a_pixel(apart):
    uv, confidence = find_soft_positions(draw(apart), COLOURS, 1.5)
    assert (uv - apart).norm(dim=-1).max() < 0.02
    assert confidence.min() > 0.8


def test_a_missing_dot_has_no_confidence(apart):
    visible = torch.ones(5, 8, dtype=torch.bool)
    visible[2, 3] = False
    uv, confidence = find_soft_positions(draw(apart, visible=visible), COLOURS, 1.5)
    assert confidence[2, 3] == 0
    assert uv.isfinite().all()
    assert (confidence > 0.8).sum() == 39


def test_a_black_image_has_nothing():
    uv, confidence = find_soft_positions(torch.zeros(2, 3, 32, 32), COLOURS, 1.5)
    assert (uv == 0).all()
    assert (confidence == 0).all()


def test_positions_move_with_the_image(apart):
    one, _ = find_soft_positions(draw(apart), COLOURS, 1.5)
    other, _ = find_soft_positions(draw(apart + torch.tensor([1.0, 2.0])), COLOURS, 1.5)
    assert torch.allclose(other - one, torch.tensor([1.0, 2.0]).expand_as(one), atol=1e-3)


def test_belief_chooses_between_two_dots_of_one_colour():
    uv = torch.tensor([[[20.0, 20.0], [70.0, 70.0]]])
    images = splat(uv, COLOURS[:1].expand(2, 3), 1.5, (96, 96))
    heatmap_logits = torch.zeros(1, 1, 2, 2)
    heatmap_logits[..., 1, 1] = 8.0
    heatmap_logits[..., 0, 0] = -8.0
    found, confidence = find_soft_positions(images, COLOURS[:1], 1.5, heatmap_logits)
    assert torch.allclose(found[0, 0], uv[0, 1], atol=0.05)
    assert confidence[0, 0] > 0.8


def test_gradients_reach_the_belief():
    uv = torch.tensor([[[20.0, 20.0], [24.0, 20.0]]])
    images = splat(uv, COLOURS[:1].expand(2, 3), 1.5, (96, 96))
    heatmap_logits = torch.zeros(1, 1, 24, 24, requires_grad=True)
    found, _ = find_soft_positions(images, COLOURS[:1], 1.5, heatmap_logits)
    found.sum().backward()
    assert heatmap_logits.grad.isfinite().all()
    assert heatmap_logits.grad.abs().max() > 0
