from .captures import FrameModel, Truth, simulate_frames, simulate_truth, true_detections
from .colour_coding import LEVELS, ImageOptions, render_views
from .corruption import Corrupted, Corruption
from .rigs import Drift, PhysicalDrift, PoseRange, RelativeDrift, Snapshots, synthesize

__all__ = [
    "LEVELS",
    "Corrupted",
    "Corruption",
    "Drift",
    "FrameModel",
    "ImageOptions",
    "PhysicalDrift",
    "PoseRange",
    "RelativeDrift",
    "Snapshots",
    "Truth",
    "render_views",
    "simulate_frames",
    "simulate_truth",
    "synthesize",
    "true_detections",
]
