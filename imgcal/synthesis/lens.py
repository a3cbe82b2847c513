"""Ideal cameras, and how they can stand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from imgcal.io import StrictRecord
from imgcal.types import limits

Shape = Literal["ring", "dome", "row"]
Side = Annotated[int, Field(ge=1, le=limits.LONGEST_SIDE)]


@dataclass(frozen=True)
class Lens(StrictRecord):
    """An ideal camera: its images, and how much it sees.

    Examples:
        >>> round(Lens((1280, 1024), field_of_view_deg=90.0).focal_length, 6)
        640.0
    """

    image_size: tuple[Side, Side] = (1280, 1024)  #: px: width, height
    field_of_view_deg: Annotated[float, Field(gt=0, lt=180)] = 65.0  #: degrees across the longer side of the image

    @property
    def focal_length(self) -> float:
        """In pixels."""
        return max(self.image_size) / 2 / math.tan(math.radians(self.field_of_view_deg) / 2)

    @property
    def principal_point(self) -> tuple[float, float]:
        """The centre of the image, px."""
        width, height = self.image_size
        return (width - 1) / 2, (height - 1) / 2
