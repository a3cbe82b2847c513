from .clutter import Clutter, drape_spots, sample_clutter
from .clutter_model import NO_BLOBS, BlobRange, ClutterModel
from .crops import render_crops
from .infrared import InfraredFrames, infrared_frames, render_blobs
from .palette import palette
from .reference import ellipse_reference, splat_reference
from .sensor import expose
from .sensor_model import SensorModel
from .splat import splat
from .spots import Smear, Spots, Surface, in_crop, roll_rows
from .tracing import is_traced

__all__ = [
    "NO_BLOBS",
    "BlobRange",
    "Clutter",
    "ClutterModel",
    "InfraredFrames",
    "SensorModel",
    "Smear",
    "Spots",
    "Surface",
    "drape_spots",
    "ellipse_reference",
    "expose",
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
