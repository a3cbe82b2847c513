"""Light of blurred ellipses on the pixels of local windows: uniform, uneven, cut and smeared ones."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from renderers.spots import Smear, Surface

PIECES = 12  # in each slab of an uneven surface
LEVEL = 1e-6  # slope below which the edge of a cut counts as horizontal


class Windows(NamedTuple):
    """Where the pixels of windows lie."""

    rows: Tensor  # (P,) first row
    columns: Tensor  # (P,) first column
    size: tuple[int, int]  # height and width
    finer: int = 1  # samples per pixel, each of which integrates over a whole pixel around it


def ellipse_coverage(
    centre: Tensor, shape: Tensor, windows: Windows, blur: float, slabs: int, surface: Surface | None = None
) -> Tensor:
    """Integrate blurred ellipses over the pixels of local windows.

    An ellipse is divided into horizontal slabs, thinner towards its ends. Each slab is replaced by a rectangle of the
    same area. A rectangle blurred by a Gaussian and integrated over a pixel is a product of two exact terms, so the sum
    over slabs is one small matrix product. The result is point-symmetric: slabs do not move the centroid. Edges that
    cut the ellipse shorten the slabs. On an uneven surface, each slab is a row of pieces, each with the brightness of
    its middle.

    Args:
        centre: (P, 2) pixels.
        shape: (P, 2, 2) ellipse matrices, px^2.
        windows: of P blobs.
        blur: Standard deviation of the blur in pixels, positive.
        slabs: Number of slabs.
        surface: (P, ...) of these blobs, default uniform and whole.

    Returns:
        (P, K, h, w): opacity in [0, 1] and, with an uneven surface, emitted light. h and w count samples.
    """
    turn = torch.linspace(0, math.pi, slabs + 1, dtype=torch.float64, device=centre.device)
    cut = -turn.cos()  # slab edges on the unit disc, from -1 to 1
    chord = ((turn - turn.sin() * turn.cos()) / 2).diff() / cut.diff()  # mean half chord of the unit disc in each slab
    edge, middle, chord = (x.to(centre.dtype) for x in (cut, (cut[1:] + cut[:-1]) / 2, chord))

    half_height = shape[:, 1, 1].sqrt()
    half_width = (torch.linalg.det(shape).clamp(min=0) / shape[:, 1, 1]).sqrt()  # of the chord through the centre
    slant = shape[:, 0, 1] / half_height
    u = (centre[:, 0] - windows.columns)[:, None] + slant[:, None] * middle  # (P, slabs) chord centres in the window
    v = (centre[:, 1] - windows.rows)[:, None] + half_height[:, None] * edge  # (P, slabs + 1)
    along_v = _blur_box(v[:, :-1], v[:, 1:], windows.size[0], windows.finer, blur)
    if surface is None:
        low, high = u - half_width[:, None] * chord, u + half_width[:, None] * chord
        along_u = _blur_box(low, high, windows.size[1], windows.finer, blur)
        return (along_v.mT @ along_u).clamp(0, 1)[:, None]
    x = _cut_chords(surface.cuts, (half_width, half_height, slant), middle, chord)  # (P, slabs, 2)
    edges = u[..., None] + half_width[:, None, None] * x
    hiding = _blur_box(edges[..., 0], edges[..., 1], windows.size[1], windows.finer, blur)
    if surface.limb is None and surface.bumps is None:
        return (along_v.mT @ hiding).clamp(0, 1)[:, None]
    x, edges = (torch.lerp(e[..., :1], e[..., 1:], torch.linspace(0, 1, PIECES + 1).to(e)) for e in (x, edges))
    light = _brightness(surface, (x[..., 1:] + x[..., :-1]) / 2, middle[:, None])
    # The sum over pieces w_j (T(x_j) - T(x_j+1)) is a sum over edges: (w_j - w_j-1) T(x_j).
    step = torch.nn.functional.pad(light, (1, 1)).diff(dim=-1)
    shining = _pixels(
        (step[..., None, :] @ _twice_integrated(edges, windows.size[1], windows.finer, blur))[..., 0, :], windows.finer
    )
    both = along_v.mT[:, None] @ torch.stack([hiding, shining], dim=1)
    return torch.cat([both[:, :1].clamp(0, 1), both[:, 1:].clamp(min=0)], dim=1)


def smear_windows(fine: Tensor, smear: Smear, finer: int) -> Tensor:
    """Spread windows along straight paths and over discs of confusion, and keep one sample per pixel.

    Both are exact factors of the spectrum: sinc(k path / 2) for uniform motion, 2 J1(R |k|) / (R |k|) for a disc. The
    windows must hold all light before and after.

    Args:
        fine: (P, K, h, w) samples, dense enough for the blur that they already have.
        smear: (P, ...) of these blobs. Differentiable in the path, not in the radius.
        finer: samples per pixel.

    Returns:
        (P, K, h / finer, w / finer).
    """
    height, width = fine.shape[-2:]
    turn = 2 * math.pi * finer
    k_v = turn * torch.fft.fftfreq(height, dtype=fine.dtype, device=fine.device)[:, None]
    k_u = turn * torch.fft.rfftfreq(width, dtype=fine.dtype, device=fine.device)
    path, radius = smear.path[..., None, None], smear.defocus.detach()[:, None, None]
    factor = torch.sinc((path[:, 0] * k_u + path[:, 1] * k_v) / (2 * math.pi))
    reach = (radius * torch.hypot(k_u, k_v)).clamp(min=1e-3)
    factor = factor * (2 * torch.special.bessel_j1(reach) / reach)
    spread = torch.fft.irfft2(torch.fft.rfft2(fine) * factor[:, None], s=(height, width))
    return spread[..., ::finer, ::finer].clamp(min=0)


def _cut_chords(cuts: Tensor, axes: tuple[Tensor, Tensor, Tensor], y: Tensor, chord: Tensor) -> Tensor:
    """Find the ends of each chord after the cuts: (P, S, 2) in surface coordinates.

    A cut n p <= o is a x + b y <= o in these coordinates, with a, b = L^T n; it keeps an interval of each chord.
    """
    half_width, half_height, slant = (axis[:, None] for axis in axes)
    a = cuts[..., 0] * half_width  # (P, Q)
    b = cuts[..., 0] * slant + cuts[..., 1] * half_height
    a = torch.where(a.abs() < LEVEL, LEVEL, a)[..., None]
    end = (cuts[..., 2:] - b[..., None] * y) / a  # (P, Q, S)
    chord = chord.expand(len(cuts), 1, -1)
    high = torch.cat([chord, torch.where(a > 0, end, math.inf)], dim=1).amin(1)
    low = torch.cat([-chord, torch.where(a > 0, -math.inf, end)], dim=1).amax(1)
    high = torch.maximum(high, -chord[:, 0])
    return torch.stack([torch.minimum(low, high), high], dim=-1)


def _brightness(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Brightness of the surface at (x, y), which broadcast to (P, S, M)."""
    inward = (1 - x.square() - y.square()).clamp(min=1e-6).sqrt()
    light = torch.ones_like(inward) if surface.limb is None else 1 - surface.limb[:, None, None] * (1 - inward)
    for bump in () if surface.bumps is None else surface.bumps.unbind(-2):
        at_x, at_y, radius, gain = (value[:, None, None] for value in bump.unbind(-1))
        away = (x - at_x).square() + (y - at_y).square()
        light = light * (1 + gain * torch.exp(-away / (2 * radius.square()).clamp(min=1e-6)))
    return light


def _blur_box(low: Tensor, high: Tensor, length: int, finer: int, blur: float) -> Tensor:
    """Blur the interval [low, high] (...) by a Gaussian and integrate it over pixels 0 .. length - 1: (..., n)."""
    return _pixels(_twice_integrated(low, length, finer, blur) - _twice_integrated(high, length, finer, blur), finer)


def _twice_integrated(start: Tensor, length: int, finer: int, blur: float) -> Tensor:
    """Integrate a Gaussian at `start` (...) twice, up to the edges of all samples: (..., edges).

    The term x / 2 is left out: it cancels in the difference of neighbouring pixels.
    """
    edges = torch.arange((length + 1) * finer, dtype=start.dtype, device=start.device) / finer - 0.5
    x = edges - start[..., None]
    t = x / (math.sqrt(2) * blur)
    # Clamped, because the processor is many times slower where the exponential is denormal.
    return (x * torch.erf(t) + math.sqrt(2 / math.pi) * blur * torch.exp(-t.clamp(-6, 6).square())) / 2


def _pixels(integral: Tensor, finer: int) -> Tensor:
    """Difference over one pixel, for each sample."""
    return integral[..., finer:] - integral[..., :-finer]
