"""Heads on an encoder's map: where a fiducial is, and how sure that is."""

import pytest
import torch
from torch import nn

from imgcal.networks import PositionNetwork
from imgcal.networks.locator import CROP, _centre, _crops
from imgcal.synthesis import ImageOptions


class Painted(nn.Module):
    """A map whose heatmaps are already there: one feature a fiducial, a peak at a given cell."""

    def __init__(self, cells, shape):
        super().__init__()
        self.map = torch.zeros(1, len(cells), *shape)
        for fiducial, (column, row) in enumerate(cells):
            self.map[0, fiducial, row, column] = 20.0

    def forward(self, images):
        return self.map.expand(len(images), -1, -1, -1)


def network(cells, shape=(12, 15)):
    torch.manual_seed(0)
    made = PositionNetwork(Painted(cells, shape), len(cells), len(cells))
    with torch.no_grad():
        nn.init.zeros_(made.locator.heatmaps.bias)
        made.locator.heatmaps.weight.copy_(torch.eye(len(cells))[..., None, None])
        nn.init.zeros_(made.locator.nowhere.weight)
        made.locator.nowhere.bias.copy_(torch.tensor([0.0] * (len(cells) - 1) + [40.0]))
    return made.eval()


def test_the_centre_of_a_heatmap_is_between_its_cells():
    logits = torch.full((1, 2, 9, 11), -30.0)
    logits[0, 0, 4, 6], logits[0, 0, 4, 7] = 0.0, float(torch.tensor(3.0).log())  # a quarter and three quarters
    logits[0, 1, 8, 0] = 0.0  # in the corner: the window stays inside
    centre, mass = _centre(logits, torch.full((1, 2), -30.0))
    torch.testing.assert_close(centre[0], torch.tensor([[6.75, 4.0], [0.0, 8.0]]), rtol=0, atol=1e-3)
    torch.testing.assert_close(mass, torch.ones(1, 2), rtol=0, atol=1e-3)
    assert _centre(logits, torch.tensor([[5.0, 5.0]]))[1].max() < 0.03  # nowhere is likelier


def test_pixels_around_a_place_are_those():
    images = torch.arange(2 * 3 * 20 * 24.0).view(2, 3, 20, 24)
    near = torch.tensor([[[4.0, 4.0], [19.0, 15.0]], [[10.0, 7.0], [12.0, 9.0]]])
    crops, place = _crops(images, near)
    half = CROP // 2
    for image in range(2):
        for point in range(2):
            u, v = near[image, point].int().tolist()
            expected = images[image, :, v - half : v + half + 1, u - half : u + half + 1]
            torch.testing.assert_close(crops[image, point].mT.unflatten(1, (CROP, CROP)), expected)
    assert place[0].tolist() == [-half, -half] and place[1].tolist() == [1 - half, -half]


def test_where_is_looked_is_where_the_map_says():
    """Even in images that are not square, at the border too; a fiducial that is nowhere is not trusted."""
    cells = [(7, 5), (0, 11), (14, 0)]
    found = network(cells)(torch.rand(2, 3, 48, 60))
    assert found.uv.shape == (2, 3, 2) and found.logits.shape == (2, 3, 12, 15)
    near = [[30.0, 22.0], [4.0, 43.0], [55.0, 4.0]]
    torch.testing.assert_close(found.near[0], torch.tensor(near), rtol=0, atol=1.01)
    assert ((found.uv - found.near).abs() <= CROP // 2 + 0.5).all()
    assert found.confidence[:, :2].min() > 0.99 and found.confidence[:, 2].max() < 0.01
    assert torch.isfinite(found.log_scale).all()


@pytest.mark.parametrize("size", [32, 224])
def test_gradients_of_positions_reach_every_layer(size):
    from imgcal.networks.encoders import CnnEncoder

    torch.manual_seed(0)
    made = PositionNetwork(CnnEncoder(16, (8, 8, 8, 8), (1, 1, 1, 1)), 16, 4)
    for parameter in made.locator.correct[-1].parameters():
        nn.init.normal_(parameter, std=0.1)
    images = torch.rand(2, 3, size, size, requires_grad=True)
    found = made(images)
    (found.uv.square().sum() + found.log_scale.sum() + found.confidence.log().sum()).backward()
    assert images.grad is not None and torch.isfinite(images.grad).all() and images.grad.any()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all() and parameter.grad.any(), name


def test_heads_are_in_single_precision_behind_an_encoder_that_is_not():
    from imgcal.networks.encoders import VitEncoder

    torch.manual_seed(0)
    made = PositionNetwork(VitEncoder(8, 32, embed_dim=16, depth=1, num_heads=2), 8, 3)
    with torch.autocast("cpu", torch.bfloat16):
        found = made(torch.rand(1, 3, ImageOptions(size=32).size, 32))
    assert all(tensor.dtype == torch.float32 for tensor in vars(found).values())
