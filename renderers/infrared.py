"""Realistic monochrome infrared frames: blurred, exposed and noisy ellipses with clutter and occlusion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from renderers.clutter import Clutter
from renderers.compositing import Canvas, composite_windows, window_starts
from renderers.coverage import Windows, ellipse_coverage, smear_windows
from renderers.sensor import expose
from renderers.sensor_model import SensorModel
from renderers.spots import Spots

# Windows reach this many standard deviations of the blur beyond the ellipse: 3e-7 of the light lies outside.
REACH_SIGMAS = 5.0
# Slabs that an ellipse is divided into: thin compared with the blur, and enough for a round outline without blur.
SLABS_PER_BLUR = 6.0
SLABS = (48, 512)
FEW_SLABS = 24  # for blobs of a pixel or two
SLABS_PER_CUT = 2  # times as many for blobs with cuts: an edge is placed to within a slab
SHARP = 0.05  # least blur of the optics, in pixels; sharper optics are rendered with this blur
# Samples per pixel for smearing windows: (least blur whose spectrum they can represent, samples).
FINER = ((0.15, 2), (0.0, 4))


@dataclass(frozen=True)
class InfraredFrames:
    """Frames, and how much of each marker they show."""

    frames: Tensor  # (*B, H, W) uint8, or uint16 for 12 and 16 bit
    seen: Tensor  # (*B, N) share of each marker's area that is inside the frame and not hidden


def infrared_frames(
    markers: Spots,
    image_size: tuple[int, int],
    sensor: SensorModel | None = None,
    *,
    clutter: Clutter | None = None,
    generator: torch.Generator | None = None,
) -> InfraredFrames:
    """Render frames as an infrared camera would deliver them.

    Occluders hide markers, near markers hide far ones, and markers hide false blobs. Occlusion acts on the blurred
    outlines, which is exact except within the blur of a border between two blobs.

    Args:
        markers: (*B, N) ellipses in pixels; the last batch axis counts cameras.
        image_size: Height and width.
        sensor: Optics and sensor, default ``SensorModel()``.
        clutter: From ``sample_clutter``, default none.
        generator: Source of the noise, on the device of the markers.

    Returns:
        Frames and the visible share of each marker.

    Raises:
        ValueError: Shapes do not fit.
    """
    sensor = sensor or SensorModel()
    light, seen = render_blobs(markers, image_size, sensor.blur, clutter=clutter)
    return InfraredFrames(expose(light, sensor, generator=generator), seen)


def render_blobs(
    markers: Spots,
    image_size: tuple[int, int],
    blur: float,
    *,
    clutter: Clutter | None = None,
    extent: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor]:
    """Render the light on the sensor, before exposure: ellipses blurred by the lens and integrated over pixels.

    Differentiable in the markers' centres, shapes, intensities and paths.

    Args:
        markers: (*B, N) ellipses in pixels; invisible ones may hold NaN.
        image_size: Height and width.
        blur: Standard deviation of the lens blur in pixels.
        clutter: From ``sample_clutter``, default none.
        extent: Upper bounds of the markers' half extents in pixels, without and with their smear. By default the
            largest ones are looked up, for which a GPU has to synchronize.

    Returns:
        Light (*B, H, W), 0 on the background and the intensity inside a blob, and (*B, N), the share of each marker's
        area that is inside the frame and not hidden.

    Examples:
        >>> one = torch.ones(1, 1)
        >>> disc = Spots(torch.tensor([[[16.0, 12.0]]]), 9.0 * torch.eye(2).expand(1, 1, 2, 2), one, one > 0, one)
        >>> light, _ = render_blobs(disc, (24, 32), blur=0.7)
        >>> light.shape, bool(light[0, 12, 16] > light[0, 12, 20])
        (torch.Size([1, 24, 32]), True)
    """
    batch = markers.uv.shape[:-2]
    layers = [markers]
    if clutter is not None:
        layers = [clutter.occluders, markers, clutter.false_blobs, *clutter.large]
    canvas = Canvas.blank(math.prod(batch), 1, image_size, like=markers.uv)
    seen = [_composite(canvas, blobs, batch, image_size, max(blur, SHARP), extent) for blobs in layers]
    return canvas.images.view(*batch, *image_size), seen[min(len(layers) - 1, 1)].view(*batch, -1)


def _composite(
    canvas: Canvas,
    blobs: Spots,
    batch: torch.Size,
    image_size: tuple[int, int],
    blur: float,
    extent: tuple[float, float] | None,
) -> Tensor:
    """Draw blobs behind what is on the canvas; return the (B, N) share of each blob's area that is seen."""
    count = blobs.uv.shape[-2]
    if blobs.uv.shape != (*batch, count, 2) or blobs.shape.shape != (*batch, count, 2, 2):
        expected = f"({', '.join(map(str, batch))}, N, 2) and (..., N, 2, 2)"
        raise ValueError(f"blobs need {expected}, found {tuple(blobs.uv.shape)} and {tuple(blobs.shape.shape)}")
    images = math.prod(batch)
    height, width = image_size
    half = _half_extent(blobs)
    reach = half + REACH_SIGMAS * blur + 1
    size = torch.tensor([width, height], dtype=blobs.uv.dtype, device=blobs.uv.device)
    # A comparison with NaN is false, so blobs that are not finite, or not ellipses, are not drawn.
    near = ((blobs.uv > -reach) & (blobs.uv < size - 1 + reach)).all(-1)
    drawn = blobs.visible & near & (half > 0).all(-1) & (torch.linalg.det(blobs.shape) > 0)
    largest = (extent[0], extent[1], extent[1]) if extent is not None else _largest(blobs, half, drawn)
    most = count if extent is not None else int(drawn.sum(-1).max()) if drawn.numel() else 0
    if most == 0:
        return blobs.uv.new_zeros(images, count)
    ordered, order, shown = _sort_by_depth(blobs, drawn, images, most)
    alpha, light, rows, columns = _windows(ordered, image_size, blur, largest)
    alpha = alpha * shown[..., None, None]
    light = None if light is None else light * shown[..., None, None]
    seen = composite_windows(canvas, alpha, ordered.intensity[..., None], rows, columns, light)
    area = math.pi * torch.linalg.det(ordered.shape).clamp(min=0).sqrt()
    return seen.new_zeros(images, count).scatter(1, order, seen / area)


def _windows(
    blobs: Spots, image_size: tuple[int, int], blur: float, largest: tuple[float, float, float]
) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """Draw blobs (B, N) on windows inside the images: opacity, light if different, first rows, first columns."""
    radius, *reach = largest
    length = [2 * math.ceil(x + REACH_SIGMAS * blur) + 1 for x in reach]
    inside = [min(n, most) for n, most in zip(length, image_size[::-1], strict=True)]
    columns, rows = (window_starts(blobs.uv[..., i], inside[i], image_size[1 - i]) for i in (0, 1))
    slabs = min(max(math.ceil(SLABS_PER_BLUR * radius / blur), SLABS[0]), SLABS[1])
    if radius < 3.0:
        slabs = min(slabs, FEW_SLABS)
    if blobs.surface is not None and blobs.surface.cuts.shape[-2]:
        slabs *= SLABS_PER_CUT
    flat = blobs.of_each(lambda values: values.flatten(0, 1))
    if flat.smear is None:
        windows = Windows(rows.flatten(), columns.flatten(), (inside[1], inside[0]))
        drawn = ellipse_coverage(flat.uv, flat.shape, windows, blur, slabs, flat.surface)
    else:
        # Windows that hold all light, including what falls outside the image.
        finer = next(samples for least, samples in FINER if blur >= least)
        first = [(flat.uv[:, i].detach() - (length[i] - 1) / 2).round().long() for i in (0, 1)]
        windows = Windows(first[1], first[0], (length[1], length[0]), finer)
        drawn = smear_windows(
            ellipse_coverage(flat.uv, flat.shape, windows, blur, slabs, flat.surface), flat.smear, finer
        )
        drawn = _cut_out(drawn, rows.flatten() - first[1], inside[1], dim=-2)
        drawn = _cut_out(drawn, columns.flatten() - first[0], inside[0], dim=-1)
    drawn = drawn.unflatten(0, blobs.depth.shape)
    return drawn[:, :, 0], drawn[:, :, 1] if drawn.shape[2] > 1 else None, rows, columns


def _cut_out(windows: Tensor, first: Tensor, length: int, dim: int) -> Tensor:
    """Take `length` entries, starting at `first` (P,), along an axis of windows (P, K, h, w); 0 beyond the ends."""
    index = first[:, None] + torch.arange(length, device=first.device)  # (P, length)
    within = (index >= 0) & (index < windows.shape[dim])
    index, within = (x[:, None, :, None] if dim == -2 else x[:, None, None, :] for x in (index, within))
    shape = [*windows.shape]
    shape[dim] = length
    return windows.gather(dim, index.clamp(0, windows.shape[dim] - 1).expand(shape)) * within


def _half_extent(blobs: Spots) -> Tensor:
    """Half the extent of blobs along u and v: (*B, N, 2) px."""
    half = torch.diagonal(blobs.shape, dim1=-2, dim2=-1).clamp(min=0).sqrt()
    if blobs.smear is None:
        return half
    return half + blobs.smear.path.abs() / 2 + blobs.smear.defocus[..., None]


def _largest(blobs: Spots, half: Tensor, drawn: Tensor) -> tuple[float, float, float]:
    """Look up the largest half extent of an ellipse, and those with smear along u and v."""
    if not drawn.numel():
        return 0.0, 0.0, 0.0
    alone = torch.diagonal(blobs.shape, dim1=-2, dim2=-1).amax(-1, keepdim=True).clamp(min=0).sqrt()
    both = torch.cat([alone, half], dim=-1).detach()
    radius, along_u, along_v = torch.where(drawn[..., None], both, 0.0).flatten(0, -2).amax(dim=0).tolist()
    return radius, along_u, along_v


def _sort_by_depth(blobs: Spots, drawn: Tensor, images: int, most: int) -> tuple[Spots, Tensor, Tensor]:
    """Sort the blobs of each image by depth; those that are not drawn come last, as invisible unit discs.

    Returns:
        Blobs (B, most), their columns (B, most) and which of them are drawn.
    """
    depth = torch.where(drawn, blobs.depth.clamp(max=torch.finfo(blobs.depth.dtype).max), math.inf)
    order = depth.reshape(images, -1).argsort(dim=-1, stable=True)[:, :most]

    def arranged(values: Tensor) -> Tensor:
        mask = drawn.reshape(*drawn.shape, *[1] * (values.ndim - drawn.ndim))
        flat = torch.where(mask, values, torch.zeros_like(values)).reshape(images, drawn.shape[-1], -1)
        return flat.gather(1, order[..., None].expand(-1, -1, flat.shape[-1])).reshape(
            images, most, *values.shape[drawn.ndim :]
        )

    eye = torch.eye(2, dtype=blobs.uv.dtype, device=blobs.uv.device)
    shape = torch.where(drawn[..., None, None], blobs.shape, eye)
    # `arranged` sets the shapes of blobs that are not drawn to zero: replace them by unit discs.
    ordered = blobs.of_each(arranged)
    flat = shape.reshape(images, -1, 4).gather(1, order[..., None].expand(-1, -1, 4)).unflatten(-1, (2, 2))
    return replace(ordered, shape=flat), order, drawn.reshape(images, -1).gather(1, order)
