"""Crops against the whole frames that they are cut from."""

import pytest
import torch

from renderers import Smear, Spots, render_blobs, render_crops


def scene(crops, count, smeared):
    generator = torch.Generator().manual_seed(0)
    uv = 10 + 100 * torch.rand(crops, count, 2, generator=generator)
    one = torch.ones(crops, count)
    smear = Smear(torch.tensor([9.0, -5.0]).expand(crops, count, 2), 2.0 * one) if smeared else None
    return Spots(uv, 36.0 * torch.eye(2).expand(crops, count, 2, 2), one, one > 0, one, None, smear)


@pytest.mark.parametrize("smeared", [False, True])
@pytest.mark.parametrize("scale", [1, 8])
def test_a_crop_is_a_part_of_the_frame(scale, smeared):
    # Where blobs overlap within a coarse pixel, a crop knows only their means: one blob there.
    spots, size = scene(3, 1 if scale > 1 else 4, smeared), 128 // scale if scale > 1 else 32
    frame, _ = render_blobs(spots, (128, 128), 0.7)
    centre = (
        torch.full((3, 2), 63.5)
        if scale > 1
        else torch.tensor([[40.0, 50.0], [63.5, 20.5], [90.0, 99.0]]).round() + 0.5
    )
    crop, seen = render_crops(spots, centre, float(scale), (size, size), 0.7)
    assert seen.shape == spots.depth.shape
    for light, one, (u, v) in zip(frame, crop, centre.tolist(), strict=True):
        first = [round(x - (scale * size - 1) / 2) for x in (v, u)]
        part = light[first[0] : first[0] + scale * size, first[1] : first[1] + scale * size]
        expected = torch.nn.functional.avg_pool2d(part[None], scale)[0]
        torch.testing.assert_close(one, expected, atol=0.02 if scale > 1 else 1e-4, rtol=0)


def test_a_known_extent_changes_nothing():
    spots = scene(2, 3, True)
    centre = torch.full((2, 2), 63.5)
    known, _ = render_crops(spots, centre, 4.0, (32, 32), 0.7, extent=(1.6, 3.5))
    torch.testing.assert_close(known, render_crops(spots, centre, 4.0, (32, 32), 0.7)[0], atol=2e-3, rtol=0)
