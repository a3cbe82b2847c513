"""Clutter is where its ground truth says, and drapes cut spots next to them."""

import math
from dataclasses import replace

import pytest
import torch

from renderers import NO_BLOBS, BlobRange, ClutterModel, drape_spots, render_blobs, sample_clutter
from tests.renderers.scenes import blobs, centroid, tilted

SIZE = (64, 80)


def test_clutter_is_where_it_says() -> None:
    none = BlobRange(0, (1, 1), (1, 1), (1, 1))
    model = ClutterModel(reflections=BlobRange(1, (4.0, 9.0), (2.0, 3.0), (0.5, 1.0)), blobs=none, occluded=0.0)
    markers = blobs(torch.full((20, 1, 2), math.nan), 3.0)
    clutter = sample_clutter(model, markers, SIZE, generator=torch.Generator().manual_seed(4))
    light, _ = render_blobs(markers, SIZE, 0.7, clutter=clutter)
    assert clutter.false_blobs.uv.shape == (20, 1, 2)
    axes = torch.linalg.eigvalsh(clutter.false_blobs.shape).sqrt()
    assert axes[..., 1].min() >= 4
    assert axes[..., 1].max() <= 9
    assert (axes[..., 1] / axes[..., 0]).min() >= 2 - 1e-4
    inside = ((clutter.false_blobs.uv > 12) & (clutter.false_blobs.uv < torch.tensor([67.0, 51.0]))).all(-1)[:, 0]
    assert inside.sum() >= 5
    for one, uv in zip(light[inside], clutter.false_blobs.uv[inside, 0], strict=True):
        assert (centroid(one) - uv).abs().max() < 0.003


def test_occluders_cover_the_promised_part_of_each_marker() -> None:
    markers = blobs(torch.full((30, 1, 2), 30.0), tilted(6.0, 4.0, 0.3).expand(30, 1, 2, 2).float())
    seen = {}
    for share in (0.1, 0.4, 0.7):
        model = ClutterModel(occluded=1.0, occluded_diameter=(share, share))
        clutter = sample_clutter(model, markers, SIZE, generator=torch.Generator().manual_seed(4))
        assert clutter.occluders.visible.all()
        _, seen[share] = render_blobs(markers, SIZE, 0.7, clutter=clutter)
        torch.testing.assert_close(seen[share], seen[share][:1].expand(30, 1), atol=0.03, rtol=0)
    assert 1 > seen[0.1].mean() > 0.9 > seen[0.4].mean() > 0.5 > seen[0.7].mean() > 0.1

    never = sample_clutter(ClutterModel(occluded=0.0), markers, SIZE, generator=torch.Generator().manual_seed(4))
    assert not never.occluders.visible.any()


def test_the_number_of_blobs_is_drawn():
    model = ClutterModel(NO_BLOBS, BlobRange(9, (2.0, 3.0), (1.0, 1.0), (1.0, 1.0), fewest=4), occluded=0.0)
    markers = blobs(torch.full((400, 1, 2), 30.0), 3.0)
    counts = sample_clutter(model, markers, SIZE, generator=torch.Generator().manual_seed(0)).false_blobs.visible.sum(
        -1
    )
    assert counts.unique().tolist() == [4, 5, 6, 7, 8, 9]
    assert counts.double().mean().item() == pytest.approx(6.5, abs=0.3)


def test_neighbours_touch_their_markers():
    model = ClutterModel(NO_BLOBS, NO_BLOBS, occluded=0.0, neighbours=0.5, neighbour_distance=(1.0, 1.6))
    markers = blobs(torch.full((200, 2, 2), 30.0), 5.0)
    beside = sample_clutter(model, markers, SIZE, generator=torch.Generator().manual_seed(0)).false_blobs
    distance = (beside.uv - markers.uv).norm(dim=-1) / 5.0
    assert distance.min() >= 1.0
    assert distance.max() <= 1.6
    assert beside.visible.float().mean().item() == pytest.approx(0.5, abs=0.1)


def test_drapes_hide_what_lies_behind_them():
    """One square drape: spots inside are gone, spots on its edges are cut along them, spots outside are whole."""
    normals = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    offsets = torch.tensor([40.0, 50.0, -20.0, -10.0])  # 20 <= u <= 40, 10 <= v <= 50
    drapes = torch.cat([normals, offsets[:, None]], dim=-1)[None]
    spots = blobs(torch.tensor([[30.0, 30.0], [40.0, 30.0], [60.0, 30.0], [20.0, 20.0]]), 4.0)
    cut = drape_spots(spots, drapes)
    light, seen = render_blobs(cut, SIZE, 0.5)
    torch.testing.assert_close(seen, torch.tensor([0.0, 0.5, 1.0, 0.5]), atol=2e-3, rtol=0)
    assert light[10:50, 22:38].max() < 1e-3
    assert light[30, 42] > 0.99
    twice = drape_spots(replace(cut, visible=cut.visible), drapes)
    torch.testing.assert_close(render_blobs(twice, SIZE, 0.5)[0], light)


def test_streaks_and_textures_are_drawn_behind():
    line = BlobRange(2, (20.0, 30.0), (15.0, 20.0), (0.5, 0.5))
    model = ClutterModel(
        NO_BLOBS,
        BlobRange(0, (1.0, 2.0), (1.0, 1.0), (1.0, 1.0)),
        occluded=0.0,
        streaks=line,
        textures=BlobRange(1, (15.0, 15.0), (1.0, 1.0), (0.3, 0.3)),
        speckles=5,
        drapes=1,
    )
    markers = blobs(torch.full((6, 1, 2), 30.0), 5.0)
    clutter = sample_clutter(model, markers, SIZE, generator=torch.Generator().manual_seed(0))
    assert [part.uv.shape[1] for part in clutter.large] == [2, 1]
    assert clutter.false_blobs.uv.shape == (6, 5, 2)
    assert clutter.drapes.shape == (6, 1, 4, 3)
    inside = (clutter.false_blobs.uv - clutter.large[1].uv).norm(dim=-1)
    assert inside.max() < 15
    light, seen = render_blobs(markers, SIZE, 0.7, clutter=clutter)
    torch.testing.assert_close(seen, torch.ones(6, 1), atol=1e-3, rtol=0)
    torch.testing.assert_close(light[:, 30, 30], torch.ones(6), atol=1e-3, rtol=0)


def test_impossible_clutter_is_named():
    for values, expected in (
        ({"neighbours": 2.0}, "neighbours must be a share"),
        ({"drapes": -1}, "drapes must be"),
        ({"drape_size": (2.0, 1.0)}, "drape_size must be"),
    ):
        with pytest.raises(ValueError, match=expected):
            ClutterModel(**values)
    with pytest.raises(ValueError, match="fewest must be from 0 to count = 3, found 4"):
        replace(NO_BLOBS, count=3, fewest=4)
