"""When exposures belong together."""

from __future__ import annotations

import math
from dataclasses import dataclass

from imgcal.errors import InputError

LEAP = 10.0
"""Seconds by which a clock may not leap: the exposure is left out, unless the other cameras' clocks did the same."""


@dataclass(frozen=True)
class Timing:
    """When exposures belong together, and how long the missing ones are waited for."""

    tolerance: float = 0.005  # s between the earliest and the latest time stamp of a snapshot, at most
    patience: float = 0.1  # s that missing exposures are waited for

    def __post_init__(self) -> None:
        for name in ("tolerance", "patience"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 <= value <= LEAP / 2):
                raise InputError(f"{name}: found {value:g}, expected 0 to {LEAP / 2:g} s")
