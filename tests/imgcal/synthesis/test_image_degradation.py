"""Difficulty levels of colour-coded images."""

import pytest
import torch

from imgcal.io import load_object
from imgcal.synthesis import LEVELS, Corruption, Degradation, ImageOptions, render_views
from imgcal.types import Views

SIZE = torch.tensor([[400, 300], [400, 300]])
OPTIONS = ImageOptions(size=48)


def views(rigs=3):
    uv = torch.rand(rigs, 2, 8, 2, generator=torch.Generator().manual_seed(0)) * SIZE[:, None]
    return Views(uv, torch.ones(rigs, 2, 8, dtype=torch.bool))


def draw(level, seed=1, given=None):
    thing = load_object("asymmetric8")
    return level.draw(given or views(), SIZE, thing, OPTIONS, torch.Generator().manual_seed(seed))


def test_level_0_is_what_is_rendered():
    images, drawn = draw(LEVELS[0])
    given = views()
    plain = render_views(given.uv, given.seen, SIZE, load_object("asymmetric8"), OPTIONS, quantise=True)
    assert torch.equal(images, plain) and torch.equal(drawn.views.uv, given.uv) and drawn.inlier.all()


@pytest.mark.parametrize("level", LEVELS)
def test_images_are_8_bit_seeded_and_as_large_as_is_asked_for(level):
    images, drawn = draw(level)
    assert images.shape == (3, 2, 3, 48, 48) and images.min() >= 0 and images.max() <= 1
    torch.testing.assert_close(images * 255, (images * 255).round(), rtol=0, atol=1e-4)
    again, redrawn = draw(level)
    assert torch.equal(images, again) and torch.equal(drawn.views.uv, redrawn.views.uv)
    assert level == LEVELS[0] or not torch.equal(images, draw(level, seed=2)[0])


def test_each_level_is_farther_from_clean_images_than_the_one_before():
    clean, _ = draw(LEVELS[0], given=views(40))
    apart = [float((draw(level, given=views(40))[0] - clean).abs().mean()) for level in LEVELS]
    assert apart == sorted(apart) and apart[0] == 0


def test_what_is_missing_is_not_drawn_and_what_is_moved_is_drawn_there():
    """Everything but dots is left out, so that an image is the sum of those that are said to be there."""
    level = Degradation(points=Corruption(noise=2.0, missing=0.3, swapped=0.2, false=0.2))
    images, drawn = draw(level)
    assert not drawn.inlier.all()
    thing = load_object("asymmetric8")
    expected = render_views(drawn.views.uv, drawn.views.seen, SIZE, thing, OPTIONS, quantise=True)
    torch.testing.assert_close(images, expected, rtol=0, atol=1.5 / 255)


def test_a_stray_that_merges_touches_a_fiducial():
    def light(merged):
        images, _ = draw(Degradation(strays=1, merged=merged), given=views(200))
        plain, _ = draw(LEVELS[0], given=views(200))
        added, old = (images - plain).flatten(0, 1).sum(1), plain.flatten(0, 1).sum(1)
        return float((added.clamp_min(0) * (old > 0.02)).sum() / added.clamp_min(0).sum())

    assert light(1.0) > 0.9 > 0.6 > light(0.0)


def test_blur_keeps_light_and_spreads_it():
    given = Views(torch.full((64, 2, 8, 2), 200.0), torch.ones(64, 2, 8, dtype=torch.bool))
    given.seen[..., 1:] = False
    sharp, _ = draw(LEVELS[0], given=given)
    blurred, _ = draw(Degradation(blur=2.0), given=given)
    kept = blurred.sum((-1, -2, -3)) / sharp.sum((-1, -2, -3))
    assert (kept - 1).abs().max() < 0.1
    assert (blurred.amax((-1, -2, -3)) < 0.9 * sharp.amax((-1, -2, -3))).float().mean() > 0.5


def test_unknown_and_impossible_values_are_refused():
    with pytest.raises(Exception, match="jpeg"):
        Degradation(jpeg=101)
    with pytest.raises(Exception, match="merged"):
        Degradation(merged=2.0)
