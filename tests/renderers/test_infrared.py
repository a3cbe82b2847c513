"""Infrared frames: geometry against brute force, noise and levels against their statistics."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from renderers import (
    ClutterModel,
    SensorModel,
    ellipse_reference,
    infrared_frames,
    render_blobs,
    sample_clutter,
)
from tests.renderers.scenes import blobs, centroid, tilted

SIZE = (64, 80)
QUIET = SensorModel(read_noise=0.0, background=0.0, contrast=0.9, bit_depth=16)


@pytest.mark.parametrize("radius", [1.0, 1.5, 3.0, 6.0, 10.0])
def test_the_centroid_of_a_disc_is_its_centre(radius: float) -> None:
    random = torch.Generator().manual_seed(1)
    centres = 32 + torch.rand(6, 1, 2, generator=random)
    frames = infrared_frames(blobs(centres, radius), SIZE, QUIET).frames
    for frame, centre in zip(frames, centres[:, 0], strict=True):
        assert (centroid(frame) - centre).abs().max() < 0.003


@pytest.mark.parametrize(
    "shape", [(1.0, 1.0, 0.0), (3.0, 3.0, 0.0), (8.0, 2.0, 0.6), (6.0, 3.0, 2.5), (10.0, 10.0, 0.0)]
)
@pytest.mark.parametrize("blur", [0.4, 0.7, 2.0])
def test_ellipses_equal_brute_force(shape: tuple[float, float, float], blur: float) -> None:
    centre, matrix = torch.tensor([22.3, 19.8], dtype=torch.float64), tilted(*shape)
    light, seen = render_blobs(blobs(centre[None], matrix[None]), (40, 45), blur)
    expected = ellipse_reference(centre, matrix, (40, 45), blur=blur)
    torch.testing.assert_close(light, expected, atol=0.008, rtol=0)
    assert light.sum().item() == pytest.approx(math.pi * shape[0] * shape[1], rel=1e-4)
    assert seen.item() == pytest.approx(1.0, abs=1e-4)


def test_a_sharp_edge_covers_pixels_by_area() -> None:
    light, _ = render_blobs(blobs(torch.tensor([[20.0, 20.0]]), 8.0), (41, 41), 0.0)
    assert light.sum().item() == pytest.approx(64 * math.pi, rel=1e-4)
    assert light[20, 20].item() == pytest.approx(1.0, abs=1e-4)
    assert light[20, 28].item() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_batches_equal_single_frames(batch: tuple[int, ...]) -> None:
    random = torch.Generator().manual_seed(2)
    uv = torch.rand(*batch, 5, 2, generator=random, dtype=torch.float64) * 60
    depth = torch.rand(*batch, 5, generator=random, dtype=torch.float64)
    light, seen = render_blobs(blobs(uv, 4.0, depth), SIZE, 0.7)
    assert light.shape == (*batch, *SIZE)
    for one, one_seen, points, near in zip(
        light.view(-1, *SIZE), seen.view(-1, 5), uv.view(-1, 5, 2), depth.view(-1, 5), strict=True
    ):
        expected, expected_seen = render_blobs(blobs(points, 4.0, near), SIZE, 0.7)
        torch.testing.assert_close(one, expected)
        torch.testing.assert_close(one_seen, expected_seen)


def test_gradcheck() -> None:
    uv = torch.tensor([[9.3, 8.1], [12.2, 9.4]], dtype=torch.float64, requires_grad=True)
    shape = torch.stack([tilted(3.0, 2.0, 0.4), tilted(2.5, 2.5, 0.0)]).requires_grad_()

    def render(uv: Tensor, shape: Tensor) -> Tensor:
        return render_blobs(blobs(uv, shape, torch.tensor([2.0, 1.0])), (18, 20), 0.7)[0]

    assert torch.autograd.gradcheck(render, (uv, shape), fast_mode=True)


def test_near_markers_hide_far_ones() -> None:
    uv = torch.tensor([[30.0, 30.0], [32.0, 30.0]])
    for depth, nearer in ((torch.tensor([1.0, 2.0]), 0), (torch.tensor([2.0, 1.0]), 1)):
        markers = dataclasses.replace(blobs(uv, 5.0, depth), intensity=torch.tensor([0.5, 1.0]))
        light, seen = render_blobs(markers, SIZE, 0.7)
        assert light[30, 31].item() == pytest.approx((0.5, 1.0)[nearer], abs=1e-3)
        assert seen[nearer].item() == pytest.approx(1.0, abs=1e-3)
        overlap = 2 * math.acos(0.2) / math.pi - 2 * math.sqrt(24) * 2 / (2 * 25 * math.pi)  # of two discs, distance 2
        assert seen[1 - nearer].item() == pytest.approx(1 - overlap, abs=0.05)


def test_markers_that_are_not_visible_or_not_finite_draw_nothing() -> None:
    markers = blobs(torch.tensor([[30.0, 30.0], [40.0, 30.0], [math.nan, 5.0], [1e30, 5.0], [-40.0, 5.0]]), 5.0)
    markers = dataclasses.replace(markers, visible=torch.tensor([True, False, True, True, True]))
    light, seen = render_blobs(markers, SIZE, 0.7)
    alone = render_blobs(blobs(torch.tensor([[30.0, 30.0]]), 5.0), SIZE, 0.7)[0]
    torch.testing.assert_close(light, alone)
    for bad in (math.nan, 0.0, 9.0, -9.0):  # on the diagonal 9: a line; not an ellipse
        matrices = torch.tensor([[25.0, 0.0], [0.0, 25.0]]).repeat(5, 1, 1)
        matrices[1:] = torch.tensor([[9.0, bad], [bad, 9.0]]) if bad else 0.0
        other = dataclasses.replace(blobs(torch.full((5, 2), 30.0), matrices), uv=markers.uv)
        torch.testing.assert_close(render_blobs(other, SIZE, 0.7)[0], alone)
        clutter = sample_clutter(ClutterModel(occluded=1.0), other, SIZE)
        assert render_blobs(other, SIZE, 0.7, clutter=clutter)[0].isfinite().all()
    torch.testing.assert_close(seen, torch.tensor([1.0, 0, 0, 0, 0]), atol=1e-4, rtol=0)


def test_half_of_a_marker_on_the_border_is_seen() -> None:
    light, seen = render_blobs(blobs(torch.tensor([[-0.5, 30.0]]), 5.0), SIZE, 0.7)
    assert seen.item() == pytest.approx(0.5, abs=1e-3)
    assert light[30, 0] > 0.7


def test_the_generator_decides_everything() -> None:
    markers = blobs(torch.rand(2, 4, 2, generator=torch.Generator().manual_seed(0)) * 60, 3.0)

    def frames(seed: int) -> Tensor:
        random = torch.Generator().manual_seed(seed)
        clutter = sample_clutter(ClutterModel(), markers, SIZE, generator=random)
        return infrared_frames(markers, SIZE, clutter=clutter, generator=random).frames

    assert torch.equal(frames(5), frames(5))
    assert not torch.equal(frames(5), frames(6))


def test_unusable_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="bit_depth must be 8, 12 or 16, found 10"):
        SensorModel(bit_depth=10)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="polarity must be"):
        SensorModel(polarity="grey")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="read_noise must be from 0"):
        SensorModel(read_noise=math.nan)
    with pytest.raises(ValueError, match=r"blobs need \(2, N, 2\)"):
        render_blobs(blobs(torch.zeros(2, 3, 2), torch.ones(2, 4, 2, 2)), SIZE, 0.7)
