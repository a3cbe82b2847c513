"""Which exposures belong together. The command line needs this for its help, and imports nothing heavy with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from imgcal.errors import InputError

LEAP = 10.0
"""Maximum jump (s) of a clock: an exposure beyond it is left out, unless the other cameras' clocks jump equally."""


@dataclass(frozen=True)
class Timing:
    """When exposures belong together, and how long to wait for missing ones."""

    tolerance: float = 0.005  # maximum s between the earliest and the latest time stamp of a snapshot
    patience: float = 0.1  # s to wait for missing exposures

    def __post_init__(self) -> None:
        for name in ("tolerance", "patience"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 <= value <= LEAP / 2):
                raise InputError(f"{name}: found {value:g}, expected 0 to {LEAP / 2:g} s")
