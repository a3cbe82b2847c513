"""Settings of the blob detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from imgcal.errors import InputError

Polarity = Literal["bright", "dark"]
USUAL_RADIUS = 16.0
"""Largest radius (px) of markers of unknown size."""


@dataclass(frozen=True)
class DetectionOptions:
    """What counts as a blob.

    Radii are those of the disc of equal area: sqrt(integrated brightness / peak brightness / pi).

    Examples:
        >>> DetectionOptions(polarity="dark", min_radius=2.0).radius_limit
        16.0
        >>> DetectionOptions(min_radius=0.0)
        Traceback (most recent call last):
        imgcal.errors.InputError: radius limits: found 0.0 to 16.0, expected 0 < min < max <= 500 px
    """

    polarity: Polarity = "bright"  # markers brighter or darker than their surroundings
    threshold: float | None = None  # smallest peak above the local background, grey levels; None = from the noise
    dim_blobs: bool = False  # also keep blobs that are far dimmer than the others; a given threshold implies this
    min_radius: float = 0.9  # px; a single hot pixel measures 0.56
    max_radius: float | None = None  # px; None = 16, and more where a frame shows several blobs of one larger size
    max_elongation: float = 4.0  # largest ratio of the axes of a blob's ellipse
    bit_depth: int | None = None  # None = 8 for uint8 frames; 10, 12, 14 or 16 for uint16, from the brightest pixel
    saturation: float | None = None  # first clipped grey value; None = 0.5 % below full scale

    def first_clipped(self, scale: int) -> float:
        """First clipped grey value of frames whose largest grey value is `scale`."""
        return 0.995 * scale if self.saturation is None else self.saturation

    @property
    def radius_limit(self) -> float:
        """Largest radius (px) of a single blob."""
        return USUAL_RADIUS if self.max_radius is None else self.max_radius

    def __post_init__(self) -> None:
        if self.polarity not in get_args(Polarity):
            raise InputError(f"polarity: found {self.polarity!r}, expected one of {', '.join(get_args(Polarity))}")
        if not 0 < self.min_radius < self.radius_limit <= 500:
            raise InputError(
                f"radius limits: found {self.min_radius} to {self.radius_limit}, expected 0 < min < max <= 500 px"
            )
        if self.threshold is not None and not 0 < self.threshold < 65536:
            raise InputError(f"threshold: found {self.threshold}, expected grey levels above zero, or none")
        if not self.max_elongation > 1:
            raise InputError(f"max_elongation: found {self.max_elongation}, expected more than 1")
        if self.bit_depth is not None and not 8 <= self.bit_depth <= 16:
            raise InputError(f"bit_depth: found {self.bit_depth}, expected 8 to 16, or none")
        if self.saturation is not None and not self.saturation > 0:
            raise InputError(f"saturation: found {self.saturation}, expected a grey value above zero, or none")
