"""Patches around markers as the measurer sees them: whole, half hidden, unevenly lit, smeared, merged; or no marker.

The light is that of `renderers.render_crops`: spheres under lens, motion, defocus and edges, integrated over pixels.
Rendering is what takes time, so a pool of it is made once; turns, grounds, contrast and noise are drawn at every step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from imgcal.synthesis.drawing import Draw, host_generator
from imgcal.types import PATCH_SIZE, BlobKind
from renderers import Smear, Spots, Surface, render_crops

CHUNK = 64  # patches of one size, one lens blur and one kind of trouble
RADIUS, USUAL = (1.0, 2.6, 5.0), 0.75  # patch pixels; share of the patches beyond the middle one
BLUR = (0.15, 0.9)  # patch pixels, of the lens
MERGED, FALSE, COMPANY, CUT, UNEVEN, SMEARED = 0.12, 0.12, 0.2, 0.5, 0.3, 0.25  # shares of the chunks
LEAST_CUT, MOST_CUT = 0.1, 0.75  # shares of the diameter: what counts as partial, and what is still to be measured
PATH, DEFOCUS = 3.0, 1.2  # marker radii, most
FACTORS = (0.25, 2.5)  # size of what is no marker, beside the expected size
COARSER = 0.6  # slabs are made for smaller blobs: hundredths of a pixel are little against cuts and noise


@dataclass(frozen=True)
class Patches:
    """Light on patches, and what it comes from: M of them."""

    light: Tensor  # (M, S, S), 0 on the ground and 1 on a marker
    radius: Tensor  # (M,) patch pixels, of the marker
    offset: Tensor  # (M, 2) patch pixels, from the middle of the patch to the marker's centre
    kind: Tensor  # (M,) BlobKind

    def select(self, rows: Tensor) -> Patches:
        """Keep some of the M patches, by a mask (M,) or indices."""
        return Patches(*(getattr(self, field.name)[rows] for field in fields(self)))


def render_patches(count: int, generator: torch.Generator) -> Patches:
    """Render patches of all kinds.

    Args:
        count: M.
        generator: source of randomness; its device is where all runs.

    Examples:
        >>> patches = render_patches(6, torch.Generator().manual_seed(0))
        >>> patches.light.shape, patches.offset.shape
        (torch.Size([6, 24, 24]), torch.Size([6, 2]))
    """
    host = host_generator(generator)
    sizes = [min(CHUNK, count - first) for first in range(0, count, CHUNK)]
    parts = [_chunk(size, Trouble.of(torch.rand(8, generator=host).tolist()), Draw(generator)) for size in sizes]
    return Patches(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Patches)))


def expose_patches(patches: Patches, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Turn and mirror patches, and give them grounds, contrast and noise, drawn at every call.

    Returns:
        Grey values (M, S, S) up to a factor, expected radii (M,), and offsets (M, 2).
    """
    draw, count = Draw(generator), len(patches.kind)
    mirror, flip, swap = (draw.unit(3, count) < 0.5).unbind(0)
    light, offset = patches.light, patches.offset
    light = torch.where(mirror[:, None, None], light.flip(-1), light)
    light = torch.where(flip[:, None, None], light.flip(-2), light)
    light = torch.where(swap[:, None, None], light.mT, light)
    offset = offset * torch.stack([1.0 - 2.0 * mirror, 1.0 - 2.0 * flip], dim=-1)
    offset = torch.where(swap[:, None], offset.flip(-1), offset)
    grey = light + _ground(count, draw)
    full = torch.where(draw.unit(count) < 0.15, draw.between(0.4, 1.0, count), torch.inf)
    grey = grey.minimum(full[:, None, None])
    noise = draw.between(math.log(0.004), math.log(0.3), count).exp()[:, None, None]
    shot = draw.sometimes(0.5, 1.0, count)[:, None, None] * grey.clamp(min=0)
    grey = grey + noise * (1 + shot).sqrt() * draw.normal(*grey.shape)
    # The expected radius comes from the rig, or only from the other blobs of the frame.
    doubt = torch.where(draw.unit(count) < 0.5, 0.04, 0.15)
    return grey, patches.radius * (1 + doubt * draw.normal(count)).clamp(0.5, 1.5), offset


@dataclass(frozen=True)
class Trouble:
    """What the patches of a chunk have in common, so that they are drawn fast."""

    blur: float  # px
    radius: float  # px, of the smallest ones
    merged: bool
    false: bool
    company: bool
    cut: bool
    uneven: bool
    smeared: bool

    @classmethod
    def of(cls, draws: list[float]) -> Trouble:
        """Choose by eight numbers from 0 to 1."""
        blur, large, size, company, alone, cut, uneven, smeared = draws
        low, high = RADIUS[1:] if large < USUAL else RADIUS[:2]
        merged, false = company < MERGED, MERGED <= company < MERGED + FALSE
        return cls(
            blur=BLUR[0] + (BLUR[1] - BLUR[0]) * blur,
            radius=(low + (high - low) * size) / 1.1,
            merged=merged,
            false=false,
            company=not merged and alone < COMPANY,
            cut=cut < CUT,
            uneven=uneven < UNEVEN,
            smeared=smeared < SMEARED,
        )


def _chunk(count: int, trouble: Trouble, draw: Draw) -> Patches:
    """Render patches with the same kind of trouble."""
    expected = trouble.radius * draw.between(1.0, 1.2, count)
    radius, aspect = expected, draw.between(1.0, 1.2, count)
    if trouble.false:  # long, or of another size, and some of them empty
        radius = expected * draw.between(math.log(FACTORS[0]), math.log(FACTORS[1]), count).exp()
        aspect = draw.between(1.8, 5.0, count)
    light = torch.ones(count, 1, device=expected.device)
    if trouble.false:
        light = light * (draw.unit(count, 1) < 0.8)
    axes = torch.stack([radius * aspect.sqrt(), radius / aspect.sqrt()], dim=-1)
    along = draw.direction(count, of=2)
    turn = torch.stack([along, torch.stack([-along[:, 1], along[:, 0]], dim=-1)], dim=-1)
    root = turn * axes[:, None]
    offset = draw.direction(count, of=2) * draw.unit(count, 1).sqrt() * (0.5 + 0.6 * expected)[:, None]
    lost, cuts = _cuts(expected, trouble.cut, draw)
    surface = Surface(cuts[:, None]) if trouble.cut or trouble.uneven else None
    if surface is not None and trouble.uneven:
        surface = replace(surface, limb=draw.between(0, 0.9, count, 1), bumps=_bumps(count, draw)[:, None])
    smear = None
    if trouble.smeared:
        length = draw.sometimes(0.6, PATH, count) * expected * (0.0 if trouble.false else 1.0)
        path = draw.direction(count, of=2) * length[:, None]
        smear = Smear(path[:, None], (draw.sometimes(0.5, DEFOCUS, count) * expected)[:, None])
    spots = Spots(offset[:, None], (root @ root.mT)[:, None], light, light > 0, light, surface, smear)
    if trouble.merged or trouble.company:
        spots = _add_neighbour(spots, expected, (0.7, 2.0) if trouble.merged else (2.3, 4.0), draw)
    size = 1.2 * trouble.radius * (FACTORS[1] * 5.0**0.5 if trouble.false else 1.3)
    reach = size + (1.2 * trouble.radius * (PATH / 2 + DEFOCUS) if trouble.smeared else 0.0)
    middle = torch.zeros(count, 2, device=radius.device)
    shown, _ = render_crops(spots, middle, 1.0, (PATCH_SIZE, PATCH_SIZE), trouble.blur, extent=(COARSER * size, reach))
    kind = torch.full((count,), int(BlobKind.PARTIAL if trouble.uneven else BlobKind.WHOLE), device=radius.device)
    kind = torch.where(lost > LEAST_CUT, int(BlobKind.PARTIAL), kind)
    if trouble.merged or trouble.false:
        kind = torch.full_like(kind, int(BlobKind.MERGED if trouble.merged else BlobKind.FALSE))
    return Patches(shown, expected, offset, kind)


def _cuts(radius: Tensor, is_cut: bool, draw: Draw) -> tuple[Tensor, Tensor]:
    """Cut markers by straight edges: the share of the diameter that each loses (M,), and the edges (M, 1, 3)."""
    count = len(radius)
    lost = draw.between(0.05, MOST_CUT, count) * (1.0 if is_cut else 0.0)
    offset = radius * (1 - 2 * lost) if is_cut else torch.full_like(radius, torch.inf)
    return lost, torch.cat([draw.direction(count, of=2), offset[:, None]], dim=-1)[:, None]


def _bumps(count: int, draw: Draw) -> Tensor:
    """Dirt and highlights: (M, 3, 4)."""
    place = draw.direction(count, 3, of=2) * draw.unit(count, 3, 1).sqrt()
    return torch.cat([place, draw.between(0.15, 0.5, count, 3, 1), draw.between(-0.9, 0.6, count, 3, 1)], dim=-1)


def _add_neighbour(marker: Spots, radius: Tensor, away: tuple[float, float], draw: Draw) -> Spots:
    """Put another blob behind markers (M, 1), with their surface and smear, `away` radii from them."""
    count = len(radius)
    to = draw.direction(count, of=2) * (radius * draw.between(*away, count))[:, None]
    both = marker.of_each(lambda values: torch.cat([values, values], dim=1))
    one = torch.ones(count, 1, device=radius.device)
    factor = torch.cat([one, draw.between(0.4, 1.4, count, 1)], dim=1)
    return replace(
        both,
        uv=torch.cat([marker.uv, marker.uv + to[:, None]], dim=1),
        shape=both.shape * factor[..., None, None],
        intensity=torch.cat([marker.intensity, draw.between(0.5, 1.1, count, 1)], dim=1),
        visible=torch.cat([marker.visible, one > 0], dim=1),
        depth=torch.cat([marker.depth, 2 * one], dim=1),
    )


def _ground(count: int, draw: Draw) -> Tensor:
    """Slopes and edges behind the marker: (M, S, S)."""
    steps = torch.linspace(-1, 1, PATCH_SIZE, device=draw.generator.device)
    angle = draw.between(0, 2 * math.pi, 2, count)[..., None, None]
    along = steps * angle.cos() + steps[:, None] * angle.sin()
    slope = along[0] * draw.sometimes(0.5, 0.3, count)[:, None, None]
    edge = torch.sigmoid((along[1] - draw.between(-1, 1, count)[:, None, None]) * 30)
    return slope + edge * draw.sometimes(0.15, 0.6, count)[:, None, None]
