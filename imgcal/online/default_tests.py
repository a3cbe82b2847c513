"""What watches a rig beside the filter where nothing else is asked for."""

from __future__ import annotations

from imgcal.online.clock_offsets import ClockOffsets
from imgcal.online.foreign_object import ForeignObject
from imgcal.online.image_quality import ImageQuality
from imgcal.online.sequential_test import SequentialTest


def default_tests(cameras: int) -> tuple[SequentialTest, ...]:
    """Images that get worse, clocks that slip, and another object."""
    return ImageQuality(cameras), ClockOffsets(cameras), ForeignObject()
