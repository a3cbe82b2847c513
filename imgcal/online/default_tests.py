"""The tests that run beside the filter by default."""

from __future__ import annotations

from imgcal.online.clock_offsets import ClockOffsets
from imgcal.online.foreign_object import ForeignObject
from imgcal.online.image_quality import ImageQuality
from imgcal.online.sequential_test import SequentialTest


def default_tests(cameras: int) -> tuple[SequentialTest, ...]:
    """Tests for worse images, clock slips, and a different object."""
    return ImageQuality(cameras), ClockOffsets(cameras), ForeignObject()
