import torch

from imgcal.synthesis import render_crops, sample_scenes
from imgcal.synthesis.crops import SIZE


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_crops_show_the_markers_where_the_truth_says() -> None:
    draw = generator()
    truth = render_crops(sample_scenes(24, 2, 7, draw), draw)
    assert truth.crops.shape == (24, 2, SIZE, SIZE)
    assert truth.place.shape == (24, 2, 7, 2)
    images = truth.crops.flatten(0, 1)
    images = (images - images.flatten(1).nanmedian(1).values[:, None, None]).nan_to_num()
    place, seen = truth.place.flatten(0, 1), truth.seen.flatten(0, 1)

    def brightness(at: torch.Tensor) -> float:
        column, row = at.round().clamp(0, SIZE - 1).long().unbind(-1)
        return float(images.flatten(1).gather(1, row * SIZE + column)[seen].mean())

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
