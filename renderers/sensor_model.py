"""Optics and sensor of a camera, as numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

LARGEST_LEVEL = 1000.0  # of any value given as a share of full scale
SENSOR_LIMITS = (
    ("blur", 0, 100), ("read_noise", 0, 65535), ("shot_noise", 0, 65535), ("row_noise", 0, 65535), ("hot_pixels", 0, 1),
    ("exposure", 0, LARGEST_LEVEL), ("saturation", 0, LARGEST_LEVEL), ("background", -LARGEST_LEVEL, LARGEST_LEVEL),
    ("contrast", -LARGEST_LEVEL, LARGEST_LEVEL), ("vignetting", 0, 1), ("hot_pixel_seed", 0, 2**63 - 1),
)  # fmt: skip


@dataclass(frozen=True)
class SensorModel:
    """Optics and sensor. Levels are shares of full scale; noise is in grey levels of the chosen bit depth."""

    bit_depth: Literal[8, 12, 16] = 8  # 12 bit is stored in 16, with values up to 4095
    polarity: Literal["bright", "dark"] = "bright"  # "dark" inverts the levels: dark markers on a bright ground
    blur: float = 0.7  # px, standard deviation of the lens blur
    background: float = 0.06  # level at the centre of the frame
    gradient: tuple[float, float] = (0.0, 0.0)  # change of the background across the frame's width and height
    contrast: float = 0.7  # level that a blob of intensity 1 adds
    exposure: float = 1.0  # gain on everything that reaches the sensor
    saturation: float = 1.0  # level at which pixels are full
    read_noise: float = 2.0  # grey levels, standard deviation
    shot_noise: float = 0.0  # grey levels, standard deviation at full scale; grows with the root of the level
    hot_pixels: float = 0.0  # share of the pixels that are stuck at full scale
    hot_pixel_seed: int = 0  # the same cameras have the same hot pixels in every call
    vignetting: float = 0.0  # share of the light that is lost in the corners; grows with the square of the distance
    row_noise: float = 0.0  # grey levels, standard deviation of an offset common to a row, new in every frame

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if self.bit_depth not in (8, 12, 16):
            raise ValueError(f"bit_depth must be 8, 12 or 16, found {self.bit_depth}")
        if self.polarity not in ("bright", "dark"):
            raise ValueError(f"polarity must be 'bright' or 'dark', found {self.polarity!r}")
        for name, low, high in SENSOR_LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be from {low} to {high}, found {getattr(self, name)}")
        if not all(-LARGEST_LEVEL <= change <= LARGEST_LEVEL for change in self.gradient):
            raise ValueError(f"gradient must be from {-LARGEST_LEVEL} to {LARGEST_LEVEL}, found {self.gradient}")

    @property
    def full_scale(self) -> int:
        """Largest grey level."""
        return int(2**self.bit_depth - 1)

    @classmethod
    def low_light(
        cls,
        peak_snr: float,
        *,
        ground: float = 20.0,
        read: float = 3.0,
        gain: float = 1.0,
        bit_depth: Literal[8, 12, 16] = 8,
    ) -> SensorModel:
        """Model photon counts: the brightest pixel of a dim marker is `peak_snr` standard deviations above the ground.

        The variance of a pixel that collects n electrons is n + read^2 electrons. The marker's m electrons solve
        m = peak_snr sqrt(m + ground + read^2).

        Args:
            peak_snr: signal-to-noise ratio of one pixel in the middle of a large marker, in one frame.
            ground: electrons per pixel from the background.
            read: electrons, standard deviation of the read noise.
            gain: grey levels per electron.
            bit_depth: as above.

        Examples:
            >>> dim = SensorModel.low_light(2.0)
            >>> round(255 * dim.contrast, 1), round(255 * dim.background), round(dim.read_noise, 1)
            (13.0, 20, 3.0)
        """
        marker = peak_snr * (peak_snr / 2 + math.sqrt(peak_snr**2 / 4 + ground + read**2))
        full = 2**bit_depth - 1
        return cls(
            bit_depth=bit_depth,
            background=gain * ground / full,
            contrast=gain * marker / full,
            read_noise=gain * read,
            shot_noise=math.sqrt(gain * full),
        )
