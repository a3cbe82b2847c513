"""Renderers: pixels, colours and visibility in, images out. A leaf package that knows no camera."""

from renderers.clutter import NO_BLOBS, BlobRange, Clutter, ClutterModel, draped, sample_clutter
from renderers.crops import CropSensor, expose_crops, render_crops
from renderers.infrared import InfraredFrames, infrared_frames, render_blobs
from renderers.palette import palette
from renderers.reference import ellipse_reference, splat_reference
from renderers.sensor import SensorModel, expose
from renderers.splat import splat
from renderers.spots import Smear, Spots, Surface, in_crop, roll_rows
from renderers.tracing import is_traced

__all__ = [
    "NO_BLOBS",
    "BlobRange",
    "Clutter",
    "ClutterModel",
    "CropSensor",
    "InfraredFrames",
    "SensorModel",
    "Smear",
    "Spots",
    "Surface",
    "draped",
    "ellipse_reference",
    "expose",
    "expose_crops",
    "in_crop",
    "infrared_frames",
    "is_traced",
    "palette",
    "render_blobs",
    "render_crops",
    "roll_rows",
    "sample_clutter",
    "splat",
    "splat_reference",
]
