"""Rolling shutters and crops agree with the whole frame."""

import math
from dataclasses import replace

import pytest
import torch

from renderers import Smear, Spots, Surface, in_crop, render_blobs, roll_rows

DTYPE = torch.float64


def discs(uv, radius):
    one = torch.ones(uv.shape[:-1], dtype=DTYPE)
    return Spots(uv, radius**2 * torch.eye(2, dtype=DTYPE).expand(*uv.shape, 2), one, one > 0, one)


def test_rolling_rows_show_each_row_at_its_own_time():
    """Row by row: a frame whose row v shows the disc where it is at the time of row v."""
    spot, speed = discs(torch.tensor([[20.0, 18.0]], dtype=DTYPE), 6.0), torch.tensor([[0.3, 0.1]], dtype=DTYPE)
    rolled, _ = render_blobs(roll_rows(spot, speed, 10.0), (40, 45), 0.7)
    for row in range(40):
        then = replace(spot, uv=spot.uv + (row - 10.0) * speed)
        # Light within a row comes from the rows of its blur, exposed a little earlier and later.
        torch.testing.assert_close(rolled[row], render_blobs(then, (40, 45), 0.7)[0][row], atol=0.06, rtol=0)


def test_what_stands_still_is_not_sheared():
    spot = discs(torch.tensor([[20.0, 18.0]], dtype=DTYPE), 6.0)
    still = roll_rows(spot, torch.zeros(1, 2, dtype=DTYPE), 10.0)
    assert torch.equal(still.uv, spot.uv)
    assert torch.equal(still.shape, spot.shape)


@pytest.mark.parametrize("scale", [1, 4])
def test_a_crop_averages_the_pixels_of_the_frame(scale):
    generator = torch.Generator().manual_seed(0)
    spots = discs(20 + 24 * torch.rand(1, 3, 2, generator=generator, dtype=DTYPE), 5.0)
    cut = torch.tensor([0.8, 0.6, 1.0], dtype=DTYPE).expand(1, 3, 1, 3)
    path = torch.tensor([6.0, 2.0], dtype=DTYPE).expand(1, 3, 2)
    spots = replace(spots, surface=Surface(cut), smear=Smear(path, torch.full((1, 3), 1.5, dtype=DTYPE)))
    frame, _ = render_blobs(spots, (64, 64), 1.2)
    middle, size = torch.full((1, 2), 31.5, dtype=DTYPE), 64 // scale
    crop, _ = render_blobs(in_crop(spots, middle, scale, (size, size)), (size, size), 1.2 / scale)
    average = torch.nn.functional.avg_pool2d(frame[None], scale)[0]
    torch.testing.assert_close(crop, average, atol=0.02, rtol=0)
    assert crop.sum().item() * scale**2 == pytest.approx(frame.sum().item(), rel=5e-3)


def test_every_tensor_is_changed():
    spots = discs(torch.zeros(4, 2, 2, dtype=DTYPE), 3.0)
    spots = replace(spots, surface=Surface(torch.zeros(4, 2, 1, 3)), smear=Smear(spots.uv, spots.depth))
    half = spots.of_each(lambda values: values[:2])
    assert half.surface.cuts.shape == (2, 2, 1, 3)
    assert half.smear.path.shape == (2, 2, 2)
    assert half.surface.limb is None
    assert math.prod(half.shape.shape) == 2 * 2 * 4
