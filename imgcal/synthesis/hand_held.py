"""How a hand carries an object, as numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from imgcal.io import StrictRecord


@dataclass(frozen=True)
class HandHeld(StrictRecord):
    """How a hand carries an object: one smooth path through the whole volume at a given mean speed.

    The path is a cubic B-spline between places and turns that are drawn at random: it stays in a convex volume, and
    shakes of more than about one cycle in the time from place to place are as good as absent from its spectrum.

    Examples:
        >>> HandHeld(speed=800.0, rate=30.0).speed
        800.0
    """

    speed: Annotated[float, Field(gt=0, le=20_000)] = 500.0  #: mm/s, mean speed of a hand-held object
    turning: Annotated[float, Field(gt=0, le=2000)] = 45.0  #: degrees/s, mean turning speed of a hand-held object
    rate: Annotated[float, Field(gt=0, le=10_000)] = 5.0  #: snapshots a second of a hand-held object
