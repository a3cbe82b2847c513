import torch

from imgcal.synthesis import sample_patches
from imgcal.synthesis.drawing import Draw
from imgcal.synthesis.patches import SIZE, _blurred, _spots


def test_markers_lie_where_the_truth_says() -> None:
    made = sample_patches(200, torch.Generator().manual_seed(0))
    assert made.images.shape == (200, SIZE, SIZE)
    images = made.images - made.images.flatten(1).median(1).values[:, None, None]
    column, row = (made.offset + (SIZE - 1) / 2).round().clamp(0, SIZE - 1).long().unbind(-1)
    here = images.flatten(1).gather(1, (row * SIZE + column)[:, None])[:, 0]
    assert float(here[made.seen].mean()) > 5 * abs(float(images.mean()))
    assert 0.6 < float(made.seen.float().mean()) < 0.95


def test_a_plain_disc_has_its_area_and_centroid() -> None:
    class Even(Draw):
        """No mischief: nothing that happens now and then happens."""

        def often(self, share: float, largest: float, *shape: int) -> torch.Tensor:
            return torch.zeros(shape)

        def between(self, low: float, high: float, *shape: int) -> torch.Tensor:
            return torch.full(shape, high)

        def unit(self, *shape: int) -> torch.Tensor:
            return torch.ones(shape)

    centre = torch.tensor([[[1.3, -0.6]]])
    light, visible = _spots(centre, torch.tensor([[4.0]]), torch.ones(1, 1), torch.zeros(1, 2), Even(torch.Generator()))
    image = _blurred(light, torch.tensor([0.7]))[0]
    steps = torch.arange(SIZE) - (SIZE - 1) / 2
    total = image.sum()
    assert abs(float(total) - torch.pi * 16) < 0.5
    assert abs(float((image.sum(0) * steps).sum() / total) - 1.3) < 0.03
    assert abs(float((image.sum(1) * steps).sum() / total) + 0.6) < 0.03
    assert float(visible) > 0.999
