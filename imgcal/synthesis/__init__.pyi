from .arrangements import arrange_positions, arrange_rig, look_at
from .boards import render_board, simulate_board
from .captures import (
    FrameModel,
    Frames,
    Motion,
    Shot,
    Truth,
    join_truths,
    simulate_frames,
    simulate_shots,
    simulate_truth,
    true_detections,
)
from .colour_coding import GREY_LEVELS, ImageOptions, render_views
from .corruption import Corrupted, Corruption
from .crops import CropTruth, Scenes, degrade_crops, render_crops, sample_scenes, second_look
from .difficulty import DIFFICULTIES, Difficulty
from .drawing import host_generator
from .hand_held import HandHeld
from .image_degradation import LEVELS, Degradation
from .lens import Lens, Shape
from .patches import Patches, expose_patches, render_patches
from .physical_drift import PhysicalDrift
from .rigs import (
    Drift,
    PoseRange,
    RelativeDrift,
    Snapshots,
    share_of_good_rigs,
    synthesize,
    synthesize_at_once,
)
from .simulated_rig import SimulatedRig, simulate_blobs
from .volumes import find_seen_volume, place_markers, sample_path, sample_volume, simulate_volume

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
    "Frames",
    "HandHeld",
    "ImageOptions",
    "Lens",
    "Motion",
    "Patches",
    "PhysicalDrift",
    "PoseRange",
    "RelativeDrift",
    "Scenes",
    "Shape",
    "Shot",
    "SimulatedRig",
    "Snapshots",
    "Truth",
    "arrange_positions",
    "arrange_rig",
    "degrade_crops",
    "expose_patches",
    "find_seen_volume",
    "host_generator",
    "join_truths",
    "look_at",
    "place_markers",
    "render_board",
    "render_crops",
    "render_patches",
    "render_views",
    "sample_path",
    "sample_scenes",
    "sample_volume",
    "second_look",
    "share_of_good_rigs",
    "simulate_blobs",
    "simulate_board",
    "simulate_frames",
    "simulate_shots",
    "simulate_truth",
    "simulate_volume",
    "synthesize",
    "synthesize_at_once",
    "true_detections",
]
