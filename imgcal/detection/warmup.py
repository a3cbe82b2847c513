"""Compile the detection of blobs ahead of time, in the order in which a first calibration misses its functions."""

from __future__ import annotations

import math

import numpy as np

from imgcal.detection.candidates import Candidates, block_means, outline, screen
from imgcal.detection.centroids import measure
from imgcal.detection.checks import Frame
from imgcal.detection.options import DetectionOptions
from renderers.interpreting import interpret_first

WHITE = 255
SPOTS = (  # u, v, radius in pixels and brightness: small, large, touching, clipped and dim ones
    (20, 20, 1.2, 150), (60, 24, 4, 200), (100, 30, 2, 180), (104, 30, 2, 180), (40, 70, 3, 400), (45, 72, 3, 400),
    (90, 70, 2.5, 60),
)  # fmt: skip


def warm_up_detection() -> None:
    """Detect blobs in a small frame of 8 bits, so that the compiled functions for such frames are in the cache.

    Another process that detects blobs meanwhile starts with the screening of frames, so this one starts with the
    measurement of blobs; each interprets what the other is compiling.
    """
    frame, options = _draw_spots(), DetectionOptions()

    def find() -> Candidates:
        return outline(frame, screen(block_means(frame, options, WHITE), options, WHITE), options, WHITE)

    with interpret_first(math.inf):
        candidates = find()
    for patience in (1, 0):  # what is too slow to be interpreted, then the rest
        with interpret_first(patience):
            measure(frame, candidates, options, WHITE)
            find()


def _draw_spots() -> Frame:
    """Draw spots with soft edges and some noise: (96, 128) uint8."""
    v, u = np.mgrid[:96, :128].astype(np.float64)
    light = np.random.default_rng(0).normal(12, 1.5, u.shape)
    for left, top, radius, brightness in SPOTS:
        light += brightness / (1 + np.exp(4 * (np.hypot(u - left, v - top) - radius)))
    return np.clip(light, 0, WHITE).astype(np.uint8)
