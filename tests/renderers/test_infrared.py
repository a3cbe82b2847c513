"""Infrared frames: geometry against brute force, noise and levels against their statistics."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from renderers import (
    BlobRange,
    ClutterModel,
    SensorModel,
    Spots,
    ellipse_reference,
    expose,
    infrared_frames,
    render_blobs,
    sample_clutter,
)

SIZE = (64, 80)
QUIET = SensorModel(read_noise=0.0, background=0.0, contrast=0.9, bit_depth=16)


def blobs(uv: Tensor, shape: Tensor | float, depth: Tensor | None = None, intensity: float = 1.0) -> Spots:
    """Make visible blobs; a number is the radius of discs."""
    if not isinstance(shape, Tensor):
        shape = shape**2 * torch.eye(2, dtype=uv.dtype).expand(*uv.shape, 2)
    ones = torch.ones_like(uv[..., 0])
    return Spots(uv, shape, intensity * ones, ones > 0, ones if depth is None else depth)


def tilted(major: float, minor: float, angle: float) -> Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    root = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64) * torch.tensor([major, minor])
    return root @ root.mT


def centroid(frame: Tensor) -> Tensor:
    light = frame.double()
    v, u = (torch.arange(n, dtype=torch.float64) for n in frame.shape)
    return torch.stack([light.sum(0) @ u, light.sum(1) @ v]) / light.sum()


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


@pytest.mark.parametrize(("bit_depth", "dtype"), [(8, torch.uint8), (12, torch.uint16), (16, torch.uint16)])
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_levels_and_noise(bit_depth: int, dtype: torch.dtype, polarity: str) -> None:
    full = 2**bit_depth - 1
    sensor = SensorModel(
        bit_depth=bit_depth,  # type: ignore[arg-type]
        polarity=polarity,  # type: ignore[arg-type]
        background=0.2,
        contrast=0.5,
        gradient=(0.1, -0.06),
        read_noise=3.0,
        shot_noise=4.0,
    )
    light = torch.zeros(4, 100, 200)
    light[2:] = 1.0
    frames = expose(light, sensor, generator=torch.Generator().manual_seed(3))
    assert frames.dtype == dtype
    levels = torch.from_numpy(frames.numpy().astype("float64"))
    assert levels.max() <= full
    for part, level in ((levels[:2], 0.2), (levels[2:], 0.7)):
        level, sign = (level, 1) if polarity == "bright" else (1 - level, -1)
        assert part.mean().item() == pytest.approx(level * full, abs=0.1)
        across_u = part[..., -20:].mean() - part[..., :20].mean()
        across_v = part[:, -10:].mean() - part[:, :10].mean()
        assert across_u.item() == pytest.approx(sign * 0.1 * 180 / 199 * full, abs=0.5)
        assert across_v.item() == pytest.approx(-sign * 0.06 * 90 / 99 * full, abs=0.5)
        noise = (part[0] - part[1]).std().item() / math.sqrt(2)
        assert noise == pytest.approx(math.sqrt(9 + 16 * level + 1 / 12), rel=0.05)


def test_exposure_saturates() -> None:
    light = torch.tensor([[0.0, 0.3, 0.6, 1.0]])
    quiet = SensorModel(read_noise=0.0, background=0.1, contrast=0.5)
    assert expose(light, quiet).tolist() == [[26, 64, 102, 153]]
    assert expose(light, dataclasses.replace(quiet, exposure=2.0)).tolist() == [[51, 128, 204, 255]]
    assert expose(light, dataclasses.replace(quiet, exposure=2.0, saturation=0.6)).tolist() == [[51, 128, 153, 153]]


def test_hot_pixels_belong_to_the_camera() -> None:
    sensor = SensorModel(hot_pixels=0.01, read_noise=0.0, background=0.0)
    frames = expose(torch.zeros(3, 2, 50, 60), sensor)
    assert (frames == 255).sum(dim=(-1, -2)).float().mean().item() == pytest.approx(30, abs=2)
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0, 0], frames[0, 1])
    assert not torch.equal(frames, expose(torch.zeros(3, 2, 50, 60), dataclasses.replace(sensor, hot_pixel_seed=1)))


def test_the_generator_decides_everything() -> None:
    markers = blobs(torch.rand(2, 4, 2, generator=torch.Generator().manual_seed(0)) * 60, 3.0)

    def frames(seed: int) -> Tensor:
        random = torch.Generator().manual_seed(seed)
        clutter = sample_clutter(ClutterModel(), markers, SIZE, generator=random)
        return infrared_frames(markers, SIZE, clutter=clutter, generator=random).frames

    assert torch.equal(frames(5), frames(5))
    assert not torch.equal(frames(5), frames(6))


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


def test_unusable_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="bit_depth must be 8, 12 or 16, found 10"):
        SensorModel(bit_depth=10)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="polarity must be"):
        SensorModel(polarity="grey")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="read_noise must be from 0"):
        SensorModel(read_noise=math.nan)
    with pytest.raises(ValueError, match=r"blobs need \(2, N, 2\)"):
        render_blobs(blobs(torch.zeros(2, 3, 2), torch.ones(2, 4, 2, 2)), SIZE, 0.7)
