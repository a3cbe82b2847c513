from .captures import FrameModel, Shot, Truth, simulate_frames, simulate_shots, simulate_truth, true_detections
from .colour_coding import GREY_LEVELS, ImageOptions, render_views
from .corruption import Corrupted, Corruption
from .crops import CropTruth, Scenes, render_crops, sample_scenes, second_look
from .difficulty import DIFFICULTIES, Difficulty
from .drawing import host_generator
from .levels import LEVELS, Degradation
from .patches import Patches, expose_patches, render_patches
from .rigs import (
    Drift,
    PhysicalDrift,
    PoseRange,
    RelativeDrift,
    Snapshots,
    share_of_good_rigs,
    synthesize,
    synthesize_at_once,
)

__all__ = [
    "DIFFICULTIES",
    "GREY_LEVELS",
    "LEVELS",
    "Corrupted",
    "Corruption",
    "CropTruth",
    "Degradation",
    "Difficulty",
    "Drift",
    "FrameModel",
    "ImageOptions",
    "Patches",
    "PhysicalDrift",
    "PoseRange",
    "RelativeDrift",
    "Scenes",
    "Shot",
    "Snapshots",
    "Truth",
    "expose_patches",
    "host_generator",
    "render_crops",
    "render_patches",
    "render_views",
    "sample_scenes",
    "second_look",
    "share_of_good_rigs",
    "simulate_frames",
    "simulate_shots",
    "simulate_truth",
    "synthesize",
    "synthesize_at_once",
    "true_detections",
]
