"""Measured blobs as a table; the measures themselves are compared in test_kernels and test_detector."""

import numpy as np
import pytest

from imgcal.detection import Blobs, DetectionOptions
from imgcal.detection.candidates import block_means, outline, screen
from imgcal.detection.centroids import measure
from imgcal.types import BlobFlag
from tests.imgcal.detection.discs import draw_discs, exposed, nearest, scattered

SHAPE = (160, 208)


def measured(frame, options=DetectionOptions(), scale=255) -> Blobs:
    screening = screen(block_means(frame, options, scale), options, scale)
    return measure(frame, outline(frame, screening, options, scale), options, scale)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    uv = scattered(SHAPE, 40, rng)
    contrast = rng.uniform(80, 220, len(uv))
    return draw_discs(SHAPE, uv, 4.0, contrast=contrast), uv, contrast


def test_rows_hold_centre_radius_and_contrast_of_the_discs(scene) -> None:
    light, uv, contrast = scene
    blobs = measured(exposed(light, 1.0, np.random.default_rng(1)))
    rows, distance = nearest(blobs.uv, uv)
    assert len(blobs.uv) == len(uv) and distance.max() < 0.05
    np.testing.assert_allclose(blobs.radius[rows], 4.0, rtol=0.06)
    np.testing.assert_allclose(blobs.contrast[rows] * 255, contrast, atol=6)
    assert (blobs.camera == 0).all() and (blobs.sigma > 0).all() and not blobs.flags.any()


def test_rows_are_kept_in_any_order(scene) -> None:
    blobs = measured(exposed(scene[0], 1.0, np.random.default_rng(1)))
    order = np.random.default_rng(2).permutation(len(blobs.uv))[:5]
    some = blobs.select(order)
    for name in ("uv", "sigma", "radius", "flags", "camera", "contrast"):
        np.testing.assert_array_equal(getattr(some, name), getattr(blobs, name)[order])
    assert len(blobs.select(np.zeros(len(blobs.uv), bool)).uv) == 0


def test_the_border_is_flagged_on_all_four_sides() -> None:
    uv = np.array([[1.0, 60], [206, 90], [100, 1], [50, 158], [100, 80]])
    blobs = measured(exposed(draw_discs(SHAPE, uv, 4.0), 1.0, np.random.default_rng(3)))
    rows, distance = nearest(blobs.uv, uv)
    assert (distance < 3).all()
    np.testing.assert_array_equal((blobs.flags[rows] & np.uint8(BlobFlag.BORDER)) > 0, [True, True, True, True, False])


def test_limits_of_radius_and_peak_leave_rows_out(scene) -> None:
    light, uv, contrast = scene
    frame = exposed(light, 1.0, np.random.default_rng(1))
    assert len(measured(frame, DetectionOptions(min_radius=4.5)).uv) == 0
    assert len(measured(frame, DetectionOptions(max_radius=3.0)).uv) == 0
    bright = measured(frame, DetectionOptions(threshold=150.0))
    assert abs(len(bright.uv) - (contrast > 150).sum()) <= 2 and len(bright.uv) < len(uv)


def test_no_blob_is_measured_twice() -> None:
    rng = np.random.default_rng(4)
    uv = np.concatenate([scattered(SHAPE, 40, rng), scattered(SHAPE, 40, rng) + 5])  # in pairs that touch
    blobs = measured(exposed(draw_discs(SHAPE, uv, 4.0), 2.0, rng))
    distance = np.linalg.norm(blobs.uv[:, None] - blobs.uv, axis=-1) + 9 * np.eye(len(blobs.uv))
    assert distance.min() > 0.7
