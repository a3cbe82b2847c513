from .boards import require_board
from .centroids import Blobs, to_detections
from .checks import Frame
from .detector import detect, detect_frame, detect_snapshot
from .options import DetectionOptions
from .populations import drop_dim
from .warmup import warm_up_detection

__all__ = [
    "Blobs",
    "DetectionOptions",
    "Frame",
    "detect",
    "detect_frame",
    "detect_snapshot",
    "drop_dim",
    "require_board",
    "to_detections",
    "warm_up_detection",
]
