import torch

from imgcal.types import CropPlacement


def test_there_and_back() -> None:
    placement = CropPlacement(torch.tensor([[9.5, -3.5], [0.5, 7.5]]), torch.tensor([3.0, 8.0]), 96)
    uv = torch.rand(2, 5, 2, generator=torch.Generator().manual_seed(0)) * 300
    torch.testing.assert_close(placement.to_image(placement.to_crop(uv)), uv)


def test_points_and_margin_fit() -> None:
    uv = torch.rand(4, 6, 2, generator=torch.Generator().manual_seed(1)) * 500
    seen = torch.ones(4, 6, dtype=torch.bool)
    seen[0, 0] = seen[3] = False
    uv[0, 0] = 1e5  # does not count
    placement = CropPlacement.around(uv, seen, torch.full((4,), 30.0), 96)
    room = 30 / placement.scale[:, None, None] - 1  # a pixel for whole numbers
    crop = placement.to_crop(uv)
    fits = ((crop > -0.5 + room) & (crop < 95.5 - room)).all(-1)
    assert bool(fits[seen].all())
    assert bool((placement.scale == placement.scale.round()).all())
    assert bool(placement.corner.isfinite().all())
