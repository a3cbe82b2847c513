"""Clutter in frames besides the markers: reflections, streaks, textures, neighbours, occluders and drapes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from renderers.clutter_model import BlobRange, ClutterModel
from renderers.spots import Spots, Surface

Uniform = Callable[..., Tensor]  # uniform(interval, *shape) draws (*B, *shape)
EDGES = 4  # of a drape


@dataclass(frozen=True)
class Clutter:
    """Ground truth of a frame's clutter."""

    false_blobs: Spots  # (*B, M), behind all markers
    occluders: Spots  # (*B, N), one for each marker, in front of all markers; visible where it partly covers its marker
    large: tuple[Spots, ...] = ()  # streaks and textures, behind everything else
    drapes: Tensor | None = None  # (*B, D, 4, 3) normal n (unit) and offset o of the edges: hidden where all n p <= o


def sample_clutter(
    model: ClutterModel, markers: Spots, image_size: tuple[int, int], *, generator: torch.Generator | None = None
) -> Clutter:
    """Draw reflections, clutter blobs and occluders for every frame.

    Args:
        model: Counts and intervals.
        markers: (*B, N) markers, for the batch shape and for the occluders.
        image_size: Height and width.
        generator: On the device of the markers.

    Returns:
        The clutter, which is also its ground truth. ``false_blobs`` has reflections first, then small blobs, speckles
        of textures, neighbours of markers. It is already cut by the drapes; ``drape_spots`` cuts the markers.
    """
    batch = markers.uv.shape[:-2]

    def uniform(interval: tuple[float, float], *shape: int) -> Tensor:
        unit = torch.rand(*batch, *shape, generator=generator, dtype=markers.uv.dtype, device=markers.uv.device)
        return interval[0] + (interval[1] - interval[0]) * unit

    small = [_scatter(kind, image_size, uniform) for kind in (model.reflections, model.blobs)]
    occluders = _occluders(model, markers, uniform)
    large = []
    if model.streaks.count:
        large.append(_scatter(model.streaks, image_size, uniform))
    if model.textures.count:
        large.append(_scatter(model.textures, image_size, uniform))
        small.append(_speckles(model, large[-1], uniform))
    if model.neighbours > 0:
        small.append(_neighbours(model, markers, uniform))
    false_blobs = join_spots(small)
    if not model.drapes:
        return Clutter(false_blobs, occluders, tuple(large))
    drapes = _drapes(model, image_size, uniform)
    return Clutter(
        drape_spots(false_blobs, drapes), occluders, tuple(drape_spots(part, drapes) for part in large), drapes
    )


def drape_spots(spots: Spots, drapes: Tensor) -> Spots:
    """Cut spots at the edges of drapes that they lie next to.

    A drape is large compared with a spot, so only the nearest edge cuts it. Exact except at a drape's corners.

    Args:
        spots: (*B, N).
        drapes: (*B, D, EDGES, 3) from ``Clutter.drapes``.
    """
    distance = torch.einsum("...dek,...nk->...dne", drapes[..., :2], spots.uv) - drapes[..., None, :, 2]
    outside, edge = distance.max(dim=-1)  # (*B, D, N) px, positive outside of a drape
    normals = drapes[..., None, :, :2].expand(*distance.shape, 2)
    normal = normals.gather(-2, edge[..., None, None].expand(*edge.shape, 1, 2)).squeeze(-2)
    # Keep what lies beyond the edge: n (p - uv) >= -outside.
    cuts = torch.cat([-normal, outside[..., None]], dim=-1).movedim(-3, -2)
    old = spots.surface
    surface = Surface(cuts) if old is None else replace(old, cuts=torch.cat([old.cuts, cuts], dim=-2))
    return replace(spots, surface=surface)


def join_spots(parts: list[Spots]) -> Spots:
    """Put plain spots (*B, N) of one batch side by side."""
    return Spots(
        torch.cat([part.uv for part in parts], dim=-2),
        torch.cat([part.shape for part in parts], dim=-3),
        torch.cat([part.intensity for part in parts], dim=-1),
        torch.cat([part.visible for part in parts], dim=-1),
        torch.cat([part.depth for part in parts], dim=-1),
    )


def _scatter(kind: BlobRange, image_size: tuple[int, int], uniform: Uniform) -> Spots:
    """Put blobs anywhere in the frame."""
    height, width = image_size
    major = uniform(kind.radius, kind.count)
    axes = torch.stack([major, major / uniform(kind.aspect, kind.count)], dim=-1)
    angle = uniform((0.0, math.pi), kind.count)
    cos, sin = angle.cos(), angle.sin()
    rotated = torch.stack([cos, -sin, sin, cos], dim=-1).unflatten(-1, (2, 2)) * axes[..., None, :]
    centre = uniform((-0.5, width - 0.5), kind.count), uniform((-0.5, height - 0.5), kind.count)
    uv, shape, intensity = torch.stack(centre, dim=-1), rotated @ rotated.mT, uniform(kind.intensity, kind.count)
    there = torch.ones_like(intensity, dtype=torch.bool)
    if kind.fewest is not None:
        number = uniform((float(kind.fewest), kind.count + 1.0), 1).floor()
        there = torch.arange(kind.count, device=uv.device) < number
    return Spots(uv, shape, intensity, there, torch.full_like(intensity, math.inf))


def _speckles(model: ClutterModel, regions: Spots, uniform: Uniform) -> Spots:
    """Put small bright blobs on textured regions: (*B, regions * speckles)."""
    count = model.textures.count * model.speckles

    def of_region(values: Tensor, record: int) -> Tensor:
        return values.repeat_interleave(model.speckles, dim=values.ndim - 1 - record)

    angle, distance = uniform((0.0, 2 * math.pi), count), uniform((0.0, 0.9), count).sqrt()
    offset = torch.stack([angle.cos(), angle.sin()], dim=-1) * distance[..., None]
    root = torch.linalg.cholesky_ex(of_region(regions.shape, 2)).L
    radius = uniform(model.blobs.radius, count)
    eye = torch.eye(2, dtype=radius.dtype, device=radius.device)
    return Spots(
        uv=of_region(regions.uv, 1) + (root @ offset[..., None])[..., 0],
        shape=radius[..., None, None] ** 2 * eye,
        intensity=uniform(model.blobs.intensity, count),
        visible=of_region(regions.visible, 0),
        depth=of_region(regions.depth, 0),
    )


def _neighbours(model: ClutterModel, markers: Spots, uniform: Uniform) -> Spots:
    """Put a false blob beside some markers, so close that the two merge."""
    count = markers.uv.shape[-2]
    angle, distance = uniform((0.0, 2 * math.pi), count), uniform(model.neighbour_distance, count)
    direction = torch.stack([angle.cos(), angle.sin()], dim=-1) * distance[..., None]
    root = torch.linalg.cholesky_ex(markers.shape).L
    size = uniform((0.6, 1.2), count)
    return Spots(
        uv=markers.uv + (root @ direction[..., None])[..., 0],
        shape=markers.shape * size[..., None, None] ** 2,
        intensity=markers.intensity * uniform((0.5, 1.1), count),
        visible=markers.visible & (uniform((0.0, 1.0), count) < model.neighbours),
        depth=torch.full_like(markers.depth, math.inf),
    )


def _drapes(model: ClutterModel, image_size: tuple[int, int], uniform: Uniform) -> Tensor:
    """Draw sheets of four straight edges anywhere in the frame: (*B, D, 4, 3)."""
    height, width = image_size
    middle = torch.stack([uniform((0.0, float(n)), model.drapes) for n in (width, height)], dim=-1)
    turn = torch.arange(EDGES, device=middle.device) * (2 * math.pi / EDGES)
    angle = uniform((0.0, 2 * math.pi), model.drapes, 1) + turn + uniform((-0.4, 0.4), model.drapes, EDGES)
    normal = torch.stack([angle.cos(), angle.sin()], dim=-1)  # (*B, D, 4, 2)
    away = height * uniform(model.drape_size, model.drapes, EDGES)
    offset = (normal @ middle[..., None])[..., 0] + away
    return torch.cat([normal, offset[..., None]], dim=-1)


def _occluders(model: ClutterModel, markers: Spots, uniform: Uniform) -> Spots:
    """Put a dark body over one side of some markers."""
    # Where a marker is the unit disc, its occluder is a larger disc that reaches into it from one side.
    count, radius = markers.uv.shape[-2], 1.5
    angle = uniform((0.0, 2 * math.pi), count)
    distance = 1 + radius - 2 * uniform(model.occluded_diameter, count)
    direction = torch.stack([angle.cos(), angle.sin()], dim=-1) * distance[..., None]
    root = torch.linalg.cholesky_ex(markers.shape).L
    return Spots(
        uv=markers.uv + (root @ direction[..., None])[..., 0],
        shape=markers.shape * radius**2,
        intensity=torch.zeros_like(markers.intensity),
        visible=markers.visible & (uniform((0.0, 1.0), count) < model.occluded),
        depth=markers.depth,
    )
