from .calibration import Calibration, RigScore, calibrate, fit_labelled, rms_length, score
from .initialization import load_initializer
from .sources import checked_detections, checked_frames
from .tally import DOUBTFUL, Tally

__all__ = [
    "DOUBTFUL",
    "Calibration",
    "RigScore",
    "Tally",
    "calibrate",
    "checked_detections",
    "checked_frames",
    "fit_labelled",
    "load_initializer",
    "rms_length",
    "score",
]
