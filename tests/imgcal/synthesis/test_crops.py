import torch

from imgcal.synthesis import degrade_crops, render_crops, sample_scenes
from imgcal.types import CROP_SIZE


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_crops_show_the_markers_where_the_truth_says() -> None:
    draw = generator()
    truth = render_crops(sample_scenes(24, 2, 7, draw), draw)
    assert truth.crops.shape == (24, 2, CROP_SIZE, CROP_SIZE)
    assert truth.place.shape == (24, 2, 7, 2)
    images = truth.crops.flatten(0, 1)
    images = (images - images.flatten(1).nanmedian(1).values[:, None, None]).nan_to_num()
    place, seen = truth.place.flatten(0, 1), truth.seen.flatten(0, 1)

    def brightness(at: torch.Tensor) -> float:
        column, row = at.round().clamp(0, CROP_SIZE - 1).long().unbind(-1)
        return float(images.flatten(1).gather(1, row * CROP_SIZE + column)[seen].mean())

    assert brightness(place) > 4 * abs(brightness(place + 12))
    assert 0.6 < float(seen.float().mean()) < 0.98


def test_same_seed_same_crops() -> None:
    first, second = (render_crops(sample_scenes(2, 1, 5, draw), draw) for draw in (generator(3), generator(3)))
    assert torch.equal(first.crops.nan_to_num(), second.crops.nan_to_num())
    assert torch.equal(first.place, second.place)


def test_what_is_expected_is_near_and_wrong() -> None:
    draw = generator(1)
    truth = render_crops(sample_scenes(32, 2, 9, draw), draw)
    apart = (truth.place - truth.expected).norm(dim=-1)
    assert 3 < float(apart.median()) < 15
    # Drift and pose move all fiducials of a camera alike, mostly: that is what the windows are aligned for.
    common = (truth.place - truth.expected).mean(2, keepdim=True)
    assert float((truth.place - truth.expected - common).norm(dim=-1).median()) < 0.5 * float(apart.median())
    assert bool((truth.radius > 0).all())
    assert float(truth.depth.mean(-1).abs().max()) < 1e-4


def test_degraded_crops_hide_what_they_say_and_stay_empty_outside() -> None:
    generator, count = torch.Generator().manual_seed(0), 64
    place = torch.randint(20, 76, (count, 4, 2), generator=generator).float()
    steps = torch.arange(96.0)
    apart = (steps - place[..., 0, None]).square()[:, :, None] + (steps - place[..., 1, None]).square()[..., None]
    light = torch.exp(-apart / 8).sum(1)
    light[:, :, :10] = torch.nan
    seen = torch.ones(count, 4, dtype=torch.bool)
    crops, shown = degrade_crops(light, place, torch.full((count, 4), 3.0), seen, generator)
    assert torch.equal(crops.isnan(), light.isnan())
    assert 0.03 < 1 - shown.float().mean() < 0.3  # behind drapes
    column, row = place.long().unbind(-1)
    there = crops[torch.arange(count)[:, None], row, column]
    # A quarter of the crops or so is left nearly as it was; the others are darker, noisier, blurred.
    assert (there[shown] > 0.8).float().mean() > 0.3
    assert there[shown].std() > 0.1
