from dataclasses import fields

import torch

from imgcal.synthesis import Patches, expose_patches, render_patches
from imgcal.synthesis.drawing import Draw
from imgcal.synthesis.patches import LEAST_CUT, Trouble, _chunk
from imgcal.types import PATCH_SIZE, BlobKind

QUIET = {"merged": False, "false": False, "company": False, "cut": False, "uneven": False, "smeared": False}


def chunk(count: int, **trouble: bool) -> Patches:
    return _chunk(count, Trouble(0.5, 3.0, **(QUIET | trouble)), Draw(torch.Generator().manual_seed(0)))


def centroid(images: torch.Tensor) -> torch.Tensor:
    steps = torch.arange(PATCH_SIZE) - (PATCH_SIZE - 1) / 2
    total = images.sum((1, 2))
    return torch.stack([(images.sum(1) @ steps) / total, (images.sum(2) @ steps) / total], dim=-1)


def test_whole_markers_lie_where_the_truth_says() -> None:
    made = chunk(40)
    torch.testing.assert_close(centroid(made.light), made.offset, atol=0.01, rtol=0)
    assert (made.kind == BlobKind.WHOLE).all()
    area = torch.pi * made.radius**2
    torch.testing.assert_close(made.light.sum((1, 2)), area, rtol=0.01, atol=0)


def test_smear_moves_no_centre_and_cuts_do() -> None:
    smeared, cut = chunk(40, smeared=True), chunk(40, cut=True)
    inside = smeared.offset.abs().amax(-1) < 1
    assert (
        centroid(smeared.light)[inside] - smeared.offset[inside]
    ).abs().max() < 0.1  # light beyond the patch is lost
    moved = (centroid(cut.light) - cut.offset).norm(dim=-1)
    assert moved.median() > 0.5
    lost = 1 - cut.light.sum((1, 2)) / (torch.pi * cut.radius**2)
    assert (lost[cut.kind == BlobKind.PARTIAL] > 0.04).all()
    assert (lost[cut.kind == BlobKind.WHOLE] < LEAST_CUT).all()


def test_kinds_are_what_is_wrong() -> None:
    assert (chunk(8, merged=True, cut=True).kind == BlobKind.MERGED).all()
    assert (chunk(8, false=True, smeared=True).kind == BlobKind.FALSE).all()
    assert (chunk(8, uneven=True).kind == BlobKind.PARTIAL).all()
    draws = torch.rand(2000, 8, generator=torch.Generator().manual_seed(0)).tolist()
    troubles = [Trouble.of(row) for row in draws]
    for name, share in (("merged", 0.12), ("false", 0.12), ("cut", 0.5), ("uneven", 0.3), ("smeared", 0.25)):
        assert abs(sum(getattr(trouble, name) for trouble in troubles) / 2000 - share) < 0.04


def test_pools_are_finite_and_always_the_same() -> None:
    made, again = (render_patches(130, torch.Generator().manual_seed(0)) for _ in range(2))
    assert made.light.isfinite().all()
    assert all(torch.equal(getattr(made, field.name), getattr(again, field.name)) for field in fields(Patches))


def test_turned_patches_keep_their_truth() -> None:
    """Noise apart, centroids move with the offsets; each call draws anew."""
    made, generator = chunk(64), torch.Generator().manual_seed(1)
    grey, radius, offset = expose_patches(made, generator)
    assert grey.isfinite().all()
    bright = (grey - grey.flatten(1).median(1).values[:, None, None]).clamp(min=0)
    bright = torch.where(bright > 0.5 * bright.amax((1, 2), keepdim=True), bright, 0.0)
    assert (centroid(bright) - offset).norm(dim=-1).median() < 0.15
    assert offset.norm(dim=-1).allclose(made.offset.norm(dim=-1), atol=1e-5)
    assert not torch.equal(expose_patches(made, generator)[0], grey)
    assert (radius / made.radius).min() >= 0.5
