"""Patches around markers at full scale, as the measurer sees them: whole, half hidden, smeared, merged, half lit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.synthesis.drawing import Draw

SIZE = 24  # pixels, each way
FINER = 2  # samples a pixel, each way
NEIGHBOURS = 3
LEAST_SEEN = 0.3  # share of a marker, below which there is nothing to measure


@dataclass(frozen=True)
class Patches:
    """Rendered patches, and where their markers are."""

    images: Tensor  # (M, S, S) grey
    radius: Tensor  # (M,) patch pixels, as expected: a few per cent off
    offset: Tensor  # (M, 2) patch pixels, from the middle of the patch to the marker's centre
    seen: Tensor  # (M,) bool: there is a marker, and enough of it is to be seen


def sample_patches(count: int, generator: torch.Generator) -> Patches:
    """Render M patches of random markers, each with its own mixture of what goes wrong.

    Args:
        count: M.
        generator: source of randomness; its device is where all runs.
    """
    draw = Draw(generator)
    radius = torch.where(draw.unit(count) < 0.75, draw.between(2.6, 5.0, count), draw.between(1.0, 2.6, count))
    offset = draw.normal(count, 2) * draw.between(0.2, 2.2, count, 1)
    there = draw.unit(count) < 0.9

    # The marker first, then its neighbours, at one to four radii from it.
    far = radius[:, None] * draw.between(1.0, 4.5, count, NEIGHBOURS)
    beside = offset[:, None] + far[..., None] * draw.direction(count, NEIGHBOURS, of=2)
    shown = draw.unit(count, NEIGHBOURS) < draw.often(0.5, 0.8, count)[:, None]
    centre = torch.cat((offset[:, None], beside), 1)
    radii = torch.cat((radius[:, None], radius[:, None] * draw.between(0.5, 1.6, count, NEIGHBOURS)), 1)
    light = torch.cat((there[:, None] * 1.0, shown * draw.between(0.3, 1.5, count, NEIGHBOURS)), 1)
    velocity = draw.direction(count, of=2) * (draw.often(0.4, 1.0, count) * 2.5 * radius)[:, None]
    lit, visible = _spots(centre, radii, light, velocity, draw)
    image = _blurred(lit + _ground(count, draw), 0.3 + draw.often(0.5, 1.2, count) * radius)
    image = image.clamp(max=draw.between(0.7, 3.0, count)[:, None, None])
    noise = draw.between(math.log(0.003), math.log(0.5), count).exp()[:, None, None]
    shot = draw.often(0.5, 1.0, count)[:, None, None] * image.clamp(min=0)
    image = image + noise * (1 + shot).sqrt() * draw.normal(*image.shape)
    inside = (offset.abs() < SIZE / 2 - 1).all(-1)
    return Patches(image, radius * (1 + 0.04 * draw.normal(count)), offset, there & inside & (visible > LEAST_SEEN))


def _spots(centre: Tensor, radius: Tensor, light: Tensor, velocity: Tensor, draw: Draw) -> tuple[Tensor, Tensor]:
    """Draw ellipses (M, K): light (M, F S, F S), and the share of the first one of each patch that is to be seen."""
    count, spots = radius.shape
    steps = (torch.arange(SIZE * FINER, device=radius.device) + 0.5) / FINER - SIZE / 2
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"))  # (2, F S, F S)
    apart = grid - centre[..., None, None]
    turn, flat = draw.between(0, math.pi, count, spots), draw.between(0.75, 1.0, count, spots)
    cos, sin = turn.cos(), turn.sin()

    def round_(vectors: Tensor) -> Tensor:
        """Turn vectors (M, K, 2, ...) into those in whose coordinates the ellipses are unit discs."""
        c, s, f, r = (value.view(*value.shape, *[1] * (vectors.ndim - 3)) for value in (cos, sin, flat, radius))
        x, y = vectors[:, :, 0], vectors[:, :, 1]
        return torch.stack(((x * c + y * s) / r, (y * c - x * s) / (r * f)), 2)

    place = round_(apart)
    moved = round_(velocity[:, None].expand(count, spots, 2))
    length = moved.norm(dim=2)[..., None, None]
    along_axis = functional.normalize(moved, dim=2)[..., None, None]
    along = (place * along_axis).sum(2)
    across = place.square().sum(2) - along.square()
    half_chord = (1 - across).clamp(min=0).sqrt()
    # The part of the exposure during which the disc covers a point.
    ahead = torch.minimum(along + half_chord, length / 2) - torch.maximum(along - half_chord, -length / 2)
    still = (place.square().sum(2) < 1).to(place.dtype)
    cover = torch.where(length > 0.05, ahead.clamp(min=0) / length.clamp(min=0.05), still).clamp(max=1)
    # Lit from one side: a sphere's far side is darker.
    side = draw.direction(count, spots, of=2)[..., None, None]
    amount = draw.often(0.4, 1.2, count)[:, None, None, None]
    shade = (1 + amount * (place * side).sum(2) - amount * 0.3).clamp(0.0, 2.0)
    # An edge before the first one.
    angle = draw.between(0, 2 * math.pi, count)[:, None, None]
    cut = torch.where(draw.unit(count) < 0.35, draw.between(-0.7, 0.9, count), 99.0)[:, None, None]
    first = place[:, 0]
    free = torch.sigmoid((cut - first[:, 0] * angle.cos() - first[:, 1] * angle.sin()) * 20)
    whole = cover[:, 0].sum((1, 2)).clamp(min=1e-6)
    visible = (cover[:, 0] * free).sum((1, 2)) / whole
    free = torch.cat((free[:, None], torch.ones_like(cover[:, 1:])), 1)
    return (cover * shade * free * light[..., None, None]).sum(1), visible


def _ground(count: int, draw: Draw) -> Tensor:
    """Slopes and edges behind the marker: (M, F S, F S)."""
    steps = torch.linspace(-1, 1, SIZE * FINER, device=draw.generator.device)
    angle = draw.between(0, 2 * math.pi, 2, count)[..., None, None]
    along = steps * angle.cos() + steps[:, None] * angle.sin()
    slope = along[0] * draw.often(0.5, 0.4, count)[:, None, None]
    edge = torch.sigmoid((along[1] - draw.between(-1, 1, count)[:, None, None]) * 60)
    return slope + edge * draw.often(0.3, 0.8, count)[:, None, None]


def _blurred(image: Tensor, sigma: Tensor) -> Tensor:
    """Blur fine images (M, F S, F S) by sigma (M,) pixels, and average to pixels: (M, S, S)."""
    reach = 5 * FINER
    steps = torch.arange(-reach, reach + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-(steps / (FINER * sigma.clamp(max=2.5)[:, None])).square() / 2)
    kernel = kernel / kernel.sum(-1, keepdim=True)
    padded = functional.pad(image[None], (reach,) * 4, mode="replicate")
    rows = functional.conv2d(padded, kernel[:, None, None], groups=len(image))
    both = functional.conv2d(rows, kernel[:, None, :, None], groups=len(image))
    return functional.avg_pool2d(both[0], FINER)
