"""Lamps so bright that the light around them adds up between them."""

import numpy as np
import pytest

from imgcal.detection import DetectionOptions, detect_frame
from imgcal.types import BlobFlag
from tests.imgcal.detection.discs import draw_lamps, exposed, nearest

SHAPE = (160, 160)


def three(kind, gap, rng):
    """Centres (3, 2) of a triangle or a row at a random angle."""
    angle, middle = rng.uniform(0, 2 * np.pi), 80 + rng.uniform(-0.5, 0.5, 2)
    if kind == "triangle":
        around = angle + np.arange(3) * 2 * np.pi / 3
        return middle + gap / np.sqrt(3) * np.stack([np.cos(around), np.sin(around)], 1)
    return middle + gap * np.arange(-1, 2)[:, None] * np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("kind", ["triangle", "row"])
@pytest.mark.parametrize("peak", [5.0, 10.0, 20.0, 40.0])
def test_three_bloomed_lamps_are_told_apart(kind, peak):
    rng, normalized = np.random.default_rng(0), []
    for _ in range(6):
        uv = three(kind, 20.0, rng)
        blobs = detect_frame(exposed(draw_lamps(SHAPE, uv, peak), 1.5, rng), DetectionOptions())
        rows, distance = nearest(blobs.uv, uv)
        assert distance.max() < 1.0 and len(set(rows)) == 3
        assert (blobs.flags[rows] == BlobFlag.SATURATED).all()
        normalized.append(distance / np.sqrt(2) / blobs.sigma[rows])
    assert np.sqrt(np.mean(np.square(normalized))) < 2.5


def test_lamps_that_are_one_clipped_area_are_not_measured_as_one():
    rng = np.random.default_rng(1)
    for kind in ("triangle", "row"):
        for peak in (40.0, 80.0):
            blobs = detect_frame(exposed(draw_lamps(SHAPE, three(kind, 14.0, rng), peak), 1.5, rng), DetectionOptions())
            assert ((blobs.flags & BlobFlag.MERGED) > 0).all()
