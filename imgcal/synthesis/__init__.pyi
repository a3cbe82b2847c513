from .captures import FrameModel, Truth, simulate_frames, simulate_truth, true_detections
from .colour_coding import LEVELS, ImageOptions, render_views
from .corruption import Corrupted, Corruption
from .crops import CropTruth, Scenes, host_generator, render_crops, sample_scenes
from .rigs import Drift, PhysicalDrift, PoseRange, RelativeDrift, Snapshots, synthesize

__all__ = [
    "LEVELS",
    "Corrupted",
    "Corruption",
    "CropTruth",
    "Drift",
    "FrameModel",
    "ImageOptions",
    "PhysicalDrift",
    "PoseRange",
    "RelativeDrift",
    "Scenes",
    "Snapshots",
    "Truth",
    "host_generator",
    "render_crops",
    "render_views",
    "sample_scenes",
    "simulate_frames",
    "simulate_truth",
    "synthesize",
    "true_detections",
]
