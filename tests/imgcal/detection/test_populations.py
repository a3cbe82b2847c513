"""Markers are separated from much dimmer blobs, and no real marker is lost."""

import cv2
import numpy as np
import pytest

from imgcal.detection import DetectionOptions, detect, detect_frame
from tests.imgcal.detection.discs import draw_discs, exposed, nearest, scattered

SHAPE = (480, 640)
LEDS = np.array([[210.3, 160.7], [395.6, 150.2], [402.1, 330.9], [220.8, 341.4]])


def floor(seed, marks=25, height=10.0):
    """A ground with painted spots, short strokes and long lines, `height` grey levels above it."""
    rng = np.random.default_rng(seed)
    paint = np.zeros(SHAPE)
    for u, v in rng.permutation(scattered(SHAPE, 80, rng))[:marks]:
        size = rng.uniform(2, 8)
        angle = rng.uniform(0, 180)
        cv2.ellipse(paint, ((u + 25, v + 20), (2 * size, size), angle), float(height), -1)
    cv2.line(paint, (0, 60), (639, 90), float(height), 3)
    cv2.line(paint, (500, 0), (470, 479), float(height), 2)
    return 30 + cv2.GaussianBlur(paint, (0, 0), 0.8)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("radius", [2.0, 6.0])
def test_paint_on_the_floor_is_left_out_beside_bright_markers(seed, radius):
    contrast = np.array([100.0, 120.0, 90.0, 110.0])
    light = draw_discs(SHAPE, LEDS, radius, contrast=contrast, background=floor(seed))
    frame = exposed(light, 1.5, np.random.default_rng(seed))
    found = detect_frame(frame, DetectionOptions())
    assert len(found.uv) == 4
    assert nearest(found.uv, LEDS)[1].max() < 0.2
    assert len(detect_frame(frame, DetectionOptions(dim_blobs=True)).uv) > 10
    assert len(detect_frame(frame, DetectionOptions(threshold=5.0)).uv) > 10


def test_a_frame_with_few_markers_takes_over_the_limit_of_its_camera():
    rng, frames = np.random.default_rng(0), []
    for shown in (4, 4, 2, 0):
        light = draw_discs(SHAPE, LEDS[:shown], 4.0, contrast=110.0, background=floor(1))
        frames.append(exposed(light, 1.5, rng))
    found = detect({"a": frames, "b": [frames[3]] * 4})
    assert np.bincount(found.snapshot[found.camera == 0], minlength=4).tolist() == [4, 4, 2, 0]
    assert (found.camera == 1).sum() > 40  # nothing brighter tells that these are no markers


@pytest.mark.parametrize(
    "contrast",
    [
        np.full(12, 9.0),  # all alike, dim as they are
        np.repeat([120.0, 60.0], 6),  # half of the brightness
        np.repeat([200.0, 45.0], 6),  # far ones
        np.repeat([19.0, 6.0], 6),  # underexposed
        np.geomspace(150, 10, 12),  # uneven illumination
        np.append(np.full(2, 220.0), np.full(10, 15.0)),  # two lamps beside weak markers
    ],
)
@pytest.mark.parametrize("radius", [2.0, 5.0])
def test_dim_markers_are_kept(contrast, radius):
    rng = np.random.default_rng(3)
    uv = scattered(SHAPE, 120, rng)[:12]
    frame = exposed(draw_discs(SHAPE, uv, radius, contrast=contrast), 0.8, rng)
    found = detect_frame(frame, DetectionOptions())
    assert nearest(found.uv, uv)[1].max() < 0.5
    assert len(found.uv) == 12


@pytest.mark.parametrize("radius", [14.0, 20.0, 27.0, 36.0])
def test_markers_larger_than_usual_are_found_where_there_are_several(radius):
    rng = np.random.default_rng(5)
    uv = scattered((600, 800), 160, rng)[:9]
    frame = exposed(draw_discs((600, 800), uv, radius * rng.uniform(0.9, 1.1, 9)), 2.0, rng)
    found = detect_frame(frame, DetectionOptions())
    assert len(found.uv) == 9
    assert nearest(found.uv, uv)[1].max() < 0.1
    assert (found.flags == 0).all()


@pytest.mark.parametrize("small", [1, 3, 6])
def test_larger_markers_are_found_beside_small_ones(small):
    rng = np.random.default_rng(7)
    uv = scattered((600, 800), 160, rng)[: small + 4]
    frame = exposed(draw_discs((600, 800), uv, np.append(np.full(small, 4.0), np.full(4, 30.0))), 2.0, rng)
    found = detect_frame(frame, DetectionOptions())
    assert len(found.uv) == small + 4
    assert nearest(found.uv, uv)[1].max() < 0.1


def test_two_large_lamps_beside_small_markers_are_none():
    rng = np.random.default_rng(6)
    uv = scattered((600, 800), 160, rng)
    frame = exposed(draw_discs((600, 800), uv, np.append([24.0, 24.0], np.full(len(uv) - 2, 4.0))), 2.0, rng)
    assert len(detect_frame(frame, DetectionOptions()).uv) == len(uv) - 2
    assert len(detect_frame(frame, DetectionOptions(max_radius=30.0)).uv) == len(uv)
