"""Frames of discs with known centres, with one property varied at a time, and the Cramér-Rao bound of a centre."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scripts.benchmarks.peers.blob_finders import Known
from tests.imgcal.detection.discs import draw_discs, exposed, scattered

FULL = 255.0
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cell:
    """One kind of frame, 8 bit."""

    name: str
    radius: float = 3.0  # px
    blur: float = 0.7  # px
    noise: float = 2.0  # grey levels
    contrast: float = 150.0  # grey levels above the background; clipped at full scale
    squeeze: float = 1.0  # ratio of the axes
    angle: float = 0.0  # rad, of the longer axis
    clutter: str = ""

    @property
    def known(self) -> Known:
        """Properties that the finders are given."""
        radius = self.radius * float(np.sqrt(self.squeeze))
        return Known(radius, min(self.contrast, FULL - BACKGROUND), self.noise, BACKGROUND)


BACKGROUND = 20.0
CENTRE = Cell("centre: radius 3, blur 0.7, noise 2")
CELLS = (
    CENTRE,
    *(replace(CENTRE, name=f"radius {radius:g}", radius=radius) for radius in (1.5, 2.0, 6.0, 10.0)),
    *(replace(CENTRE, name=f"blur {blur:g}", blur=blur) for blur in (0.5, 1.2)),
    *(replace(CENTRE, name=f"noise {noise:g}", noise=noise) for noise in (0.5, 5.0)),
    replace(CENTRE, name="contrast 25", contrast=25.0),
    replace(CENTRE, name="clipped, 1.7 times full scale", contrast=400.0),
    replace(CENTRE, name="clipped, 6 times full scale", contrast=1500.0),
    replace(CENTRE, name="radius 1.5, clipped, 1.7 times", radius=1.5, contrast=400.0),
    replace(CENTRE, name="ellipse 6 x 3, tilted", radius=6.0, squeeze=0.5, angle=0.6),
    replace(CENTRE, name="background gradient", clutter="gradient"),
    replace(CENTRE, name="elongated reflections", clutter="reflections"),
    replace(CENTRE, name="large bright areas", clutter="areas"),
    replace(CENTRE, name="hot pixels", clutter="hot"),
)


@dataclass(frozen=True)
class View:
    """One frame and its ground truth."""

    frame: NDArray[np.uint8]  # (H, W)
    uv: Array  # (M, 2) centres, px


def view(cell: Cell, shape: tuple[int, int], rng: np.random.Generator) -> View:
    """Draw one frame: discs on a lattice with random subpixel offsets, clutter between and below them."""
    pitch = 40 if cell.radius < 8 else 52
    uv = scattered(shape, pitch, rng)
    background = np.full(shape, BACKGROUND)
    if cell.clutter == "gradient":
        background = background + np.linspace(0, 60, shape[1])[None, :] + np.linspace(0, 20, shape[0])[:, None]
    elif cell.clutter == "areas":
        middle = rng.uniform((0, 0), shape[::-1], (4, 2))
        background = draw_discs(
            shape, middle, rng.uniform(40, 70, 4), contrast=70.0, background=background, blur=1.0, squeeze=0.7
        )
    elif cell.clutter == "reflections":
        between = uv[::3] + pitch / 2
        for place, angle in zip(between, rng.uniform(0, np.pi, len(between)), strict=True):
            background = draw_discs(
                shape, place[None], 9.0, contrast=150.0, background=background, squeeze=0.15, angle=angle
            )
    light = draw_discs(
        shape, uv, cell.radius, contrast=cell.contrast, background=background, blur=cell.blur, squeeze=cell.squeeze,
        angle=cell.angle,
    )  # fmt: skip
    frame = exposed(light, cell.noise, rng)
    if cell.clutter == "hot":
        hot = rng.integers((0, 0), shape, (frame.size // 1500, 2))
        frame[hot[:, 0], hot[:, 1]] = 255
    return View(frame.astype(np.uint8), uv)


def bound(cell: Cell, rng: np.random.Generator, places: int = 12) -> float:
    """Cramér-Rao bound of a centre, RMS of each axis in px: nothing else unknown, no clutter, rounding as noise.

    Clipped pixels carry no information.
    """
    side, step = 2 * int(cell.radius + 8) + 1, 0.01
    variances = []
    for place in rng.uniform(-0.5, 0.5, (places, 2)):
        centre = side // 2 + place

        def light(u: float, v: float, centre: Array = centre) -> Array:
            return draw_discs(
                (side, side), (centre + np.array([u, v]))[None], cell.radius, contrast=cell.contrast,
                background=BACKGROUND, blur=cell.blur, squeeze=cell.squeeze, angle=cell.angle,
            )  # fmt: skip

        told = light(0, 0) < FULL - 0.5
        slopes = np.stack([light(step, 0) - light(-step, 0), light(0, step) - light(0, -step)])[:, told] / (2 * step)
        variances.append(np.trace(np.linalg.inv(slopes @ slopes.T)) / 2 * (cell.noise**2 + 1 / 12))
    return float(np.sqrt(np.mean(variances)))


def rig_frames(shape: tuple[int, int], cameras: int = 10, blobs: int = 10) -> dict[str, NDArray[np.uint8]]:
    """Draw a rig's frames: 8 fiducials of radius 3 to 5 px and 2 false blobs in each, or the first `blobs` of these."""
    rng = np.random.default_rng(1)
    background = np.linspace(15, 40, shape[1])[None, :]
    frames = {}
    for camera in range(cameras):
        uv = rng.permutation(scattered(shape, 64, rng))[:blobs]
        radius = np.concatenate([rng.uniform(3, 5, 8), rng.uniform(1.5, 6, 2)])[: len(uv)]
        light = draw_discs(shape, uv, radius, background=background)
        frames[f"cam{camera:02d}"] = exposed(light, 2.0, rng).astype(np.uint8)
    return frames
