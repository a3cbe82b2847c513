"""Renderers: pixels, colours and visibility in, images out. A leaf package that knows no camera."""

from renderers.infrared import (
    BlobRange,
    Clutter,
    ClutterModel,
    InfraredFrames,
    SensorModel,
    Spots,
    expose,
    infrared_frames,
    render_blobs,
    sample_clutter,
)
from renderers.palette import palette
from renderers.reference import ellipse_reference, splat_reference
from renderers.splat import splat
from renderers.tracing import is_traced

__all__ = [
    "BlobRange",
    "Clutter",
    "ClutterModel",
    "InfraredFrames",
    "SensorModel",
    "Spots",
    "ellipse_reference",
    "expose",
    "infrared_frames",
    "is_traced",
    "palette",
    "render_blobs",
    "sample_clutter",
    "splat",
    "splat_reference",
]
