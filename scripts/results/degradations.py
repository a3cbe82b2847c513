"""Degradations of real frames: defined in terms of what the sensor sees, and drawn for each frame from a seed.

Lengths are in radii of the dots, light in 8-bit grey levels. The result is always an 8-bit frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]
ELECTRONS = 10.0  # per grey level, before and after: 2,550 fill a pixel
READ_NOISE = 10.0  # electrons, one standard deviation
DRAPES = ((5, 40), (150, 250))  # grey levels of dark and of bright drapes
SHARE_OF_A_DRAPE = (0.01, 0.04)  # of the image
STRETCH = (1.0, 4.0)  # length over width of a drape
DISCS = (0.6, 1.5)  # radius of a disc, relative to a dot's
LIGHT = (0.5, 1.1)  # its contrast with the background, relative to a dot's
FRACTION_BITS = 4  # in OpenCV's fixed-point coordinates


@dataclass(frozen=True)
class Look:
    """Appearance of the dots of a set in its original frames."""

    radius: float  # px
    level: float  # grey value in the middle of a dot
    ground: float  # grey value of the background
    count: int  # dots of the object


Change = Callable[[Frame, float, Look, np.random.Generator], NDArray[np.floating]]


@dataclass(frozen=True)
class Degradation:
    """One kind of degradation, mildest level first."""

    change: Change
    levels: tuple[float, ...]
    meaning: str  # of a level

    def apply(self, frame: Frame, level: float, look: Look, draw: np.random.Generator) -> Frame:
        """Degrade a frame (H, W)."""
        return np.clip(np.rint(self.change(frame, level, look, draw)), 0, 255).astype(np.uint8)


def blurred(frame: Frame, sigma: float, look: Look, draw: np.random.Generator) -> NDArray[np.floating]:
    """Blur by a Gaussian whose sigma is in dot radii."""
    seen = cv2.GaussianBlur(frame.astype(np.float32), (0, 0), sigma * look.radius, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(seen, dtype=np.float32)


def moved(frame: Frame, length: float, look: Look, draw: np.random.Generator) -> NDArray[np.floating]:
    """Blur by uniform motion along a centred line, its length in dot radii and its direction random."""
    angle, half = draw.uniform(0, np.pi), 0.5 * length * look.radius
    reach = int(np.ceil(half)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    along = np.linspace(-half, half, 16 * reach + 1)
    u, v = along * np.cos(angle) + reach, along * np.sin(angle) + reach
    for right in (0, 1):
        for down in (0, 1):
            column, row = np.floor(u).astype(int) + right, np.floor(v).astype(int) + down
            np.add.at(kernel, (row, column), (1 - abs(u - column)) * (1 - abs(v - row)))
    seen = cv2.filter2D(frame.astype(np.float32), -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(seen, dtype=np.float32)


def darkened(frame: Frame, gain: float, look: Look, draw: np.random.Generator) -> NDArray[np.floating]:
    """Keep a share of the light, with its shot noise and the sensor's read noise, at the original grey levels."""
    electrons = draw.poisson(frame * (gain * ELECTRONS)) + READ_NOISE * draw.standard_normal(frame.shape)
    return electrons / ELECTRONS


def noisy(frame: Frame, sigma: float, look: Look, draw: np.random.Generator) -> NDArray[np.floating]:
    """Add Gaussian noise; sigma is in grey levels."""
    return frame + sigma * draw.standard_normal(frame.shape)


def draped(frame: Frame, share: float, look: Look, draw: np.random.Generator) -> NDArray[np.floating]:
    """Hide a share of the image behind dark and bright oblongs with sharp edges."""
    height, width = frame.shape
    seen, hidden = frame.astype(np.float64), np.zeros(frame.shape)
    while hidden.mean() < share:
        angle, area = draw.uniform(0, np.pi), draw.uniform(*SHARE_OF_A_DRAPE) * frame.size
        stretch, middle = draw.uniform(*STRETCH), draw.uniform((0, 0), (width, height))
        along = np.array((np.cos(angle), np.sin(angle))) * np.sqrt(area * stretch) / 2
        across = np.array((-along[1], along[0])) / stretch
        corners = middle + np.array((along + across, along - across, -along - across, -along + across))
        cover = np.zeros(frame.shape, np.uint8)
        fixed = np.rint(corners * 2**FRACTION_BITS).astype(np.int32)
        cv2.fillConvexPoly(cover, fixed, 255, cv2.LINE_AA, FRACTION_BITS)
        opaque = cover / 255.0
        grey = draw.uniform(*DRAPES[draw.integers(len(DRAPES))])
        seen, hidden = seen + opaque * (grey - seen), np.maximum(hidden, opaque)
    return seen


def crowded(frame: Frame, times: float, look: Look, draw: np.random.Generator) -> NDArray[np.floating]:
    """Add discs that look like dots at random places: a multiple of the object's number of dots."""
    height, width = frame.shape
    seen, scale = frame.copy(), 2**FRACTION_BITS
    for _ in range(round(times * look.count)):
        radius = look.radius * draw.uniform(*DISCS)
        grey = float(np.clip(look.ground + draw.uniform(*LIGHT) * (look.level - look.ground), 0, 255))
        u, v = (draw.uniform((0, 0), (width, height)) * scale).astype(int).tolist()
        cv2.circle(seen, (u, v), round(radius * scale), grey, -1, cv2.LINE_AA, FRACTION_BITS)
    return seen.astype(np.float64)


DEGRADATIONS = {
    "clean": Degradation(lambda frame, level, look, draw: frame.astype(np.float64), (0.0,), "as captured"),
    "blur": Degradation(blurred, (1.0, 2.0), "sigma of a Gaussian, in radii of a dot"),
    "motion": Degradation(moved, (3.0, 6.0), "length of the path, in radii of a dot; a direction per frame"),
    "dark": Degradation(darkened, (0.1, 0.04), f"share of the light; {ELECTRONS:g} electrons per grey level, "
                        f"read noise of {READ_NOISE:g}"),
    "noise": Degradation(noisy, (15.0, 40.0), "standard deviation, grey levels"),
    "drapes": Degradation(draped, (0.25, 0.5), "share of the image that dark and bright oblongs hide"),
    "discs": Degradation(crowded, (1.0, 4.0), "discs that look like dots, times the object's dots"),
}  # fmt: skip
"""All kinds by name."""
