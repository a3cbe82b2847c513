"""Frames of blurred discs with known centres."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FINE = 8  # samples a pixel and axis; their edges are anti-aliased


def draw_discs(
    shape: tuple[int, int],
    uv: NDArray[np.float64],
    radius: NDArray[np.float64] | float,
    *,
    contrast: NDArray[np.float64] | float = 200.0,
    background: NDArray[np.float64] | float = 20.0,
    blur: float = 0.7,
    squeeze: float = 1.0,
    angle: float = 0.0,
) -> NDArray[np.float64]:
    """Draw discs at `uv` (M, 2), blurred by a Gaussian of `blur` px: (H, W) grey levels without noise.

    `squeeze` < 1 flattens them to ellipses, whose longer axis is turned by `angle` (rad).
    """
    covered = np.zeros(shape)  # discs that overlap hide each other: their light does not add
    frame = np.zeros(shape) + background
    radius = np.broadcast_to(radius, len(uv))
    contrast = np.broadcast_to(contrast, len(uv))
    for (u, v), r, height in zip(uv, radius, contrast, strict=True):
        half = int(np.ceil(r + 5 * blur)) + 2
        column, row = int(np.rint(u)), int(np.rint(v))
        fine = ((np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5 - half).astype(np.float32)
        right, down = fine[None, :] - (u - column), fine[:, None] - (v - row)
        along = np.float32(np.cos(angle)) * right + np.float32(np.sin(angle)) * down
        across = np.float32(np.cos(angle)) * down - np.float32(np.sin(angle)) * right
        distance = np.hypot(along, across / squeeze)
        disc = np.clip((r - distance) * FINE + 0.5, 0, 1).astype(np.float32)
        if blur > 0:
            disc = cv2.GaussianBlur(disc, (0, 0), blur * FINE)
        patch = disc.reshape(2 * half + 1, FINE, 2 * half + 1, FINE).mean((1, 3))
        top, left = max(row - half, 0), max(column - half, 0)
        bottom, right = min(row + half + 1, shape[0]), min(column + half + 1, shape[1])
        if top < bottom and left < right:
            place = slice(top, bottom), slice(left, right)
            part = patch[top - row + half : bottom - row + half, left - column + half : right - column + half]
            part = part * (1 - covered[place])
            frame[place] += height * part
            covered[place] += part
    return frame


def draw_lamps(
    shape: tuple[int, int],
    uv: NDArray[np.float64],
    peak: float,
    *,
    radius: float = 3.0,
    halo: float = 0.04,
    reach: float = 6.0,
) -> NDArray[np.float64]:
    """Draw discs with soft edges and halos that decay with `reach` px, `peak` times full scale: (H, W) grey levels."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    light = np.full(shape, 20.0)
    for place in uv:
        away = np.hypot(u - place[0], v - place[1])
        soft = 1 / (1 + np.exp(np.minimum((away - radius) / 0.9, 500)))
        light += 255 * peak * ((1 - halo) * soft + halo * np.exp(-away / reach))
    return light


def draw_patches(
    shape: tuple[int, int],
    corners: NDArray[np.float64],
    *,
    contrast: float = 150.0,
    background: float = 20.0,
    blur: float = 0.7,
) -> NDArray[np.float64]:
    """Draw flat patches with the corners (M, K, 2), blurred by a Gaussian of `blur` px: (H, W) without noise."""
    covered = np.zeros(shape)
    for outline in corners:
        first = np.floor(outline.min(0) - 6).astype(int)
        width, height = np.ceil(outline.max(0) + 6).astype(int) - first
        fine = np.zeros((height * FINE, width * FINE), np.uint8)
        at = ((outline - first + 0.5) * FINE - 0.5) * 16
        cv2.fillPoly(fine, [np.rint(at).astype(np.int32)], 255, shift=4)
        soft = cv2.GaussianBlur(fine.astype(np.float32) / 255, (0, 0), blur * FINE)
        place = slice(first[1], first[1] + height), slice(first[0], first[0] + width)
        covered[place] += soft.reshape(height, FINE, width, FINE).mean((1, 3))
    return background + contrast * covered


def scattered(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Spread centres (M, 2) on a lattice of `pitch` px, each at its own sub-pixel position."""
    v, u = np.mgrid[pitch // 2 : shape[0] - pitch // 2 : pitch, pitch // 2 : shape[1] - pitch // 2 : pitch]
    centres = np.stack([u.ravel(), v.ravel()], 1).astype(np.float64)
    return centres + rng.uniform(-0.5, 0.5, centres.shape)


def exposed(
    light: NDArray[np.float64], noise: float, rng: np.random.Generator, bits: int = 8
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Add read noise (grey levels), round and clip to `bits`."""
    grey = np.clip(np.rint(light + rng.normal(0, noise, light.shape)), 0, 2**bits - 1)
    return grey.astype(np.uint8) if bits == 8 else grey.astype(np.uint16)


def nearest(found: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Nearest found centre of each true one: rows (M,) and distances (M,) px."""
    if not len(found):
        return np.zeros(len(truth), np.int64), np.full(len(truth), np.inf)
    distance = np.linalg.norm(truth[:, None] - found[None], axis=2)
    rows = distance.argmin(1)
    return rows, distance[np.arange(len(truth)), rows]
