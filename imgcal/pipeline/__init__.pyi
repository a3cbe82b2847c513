from .calibration import Calibration, Score, calibrate, fit_labelled, rms_length, score
from .initialization import load_guesser
from .sources import checked_detections, checked_frames
from .tally import DOUBTFUL, Tally

__all__ = [
    "DOUBTFUL",
    "Calibration",
    "Score",
    "Tally",
    "calibrate",
    "checked_detections",
    "checked_frames",
    "fit_labelled",
    "load_guesser",
    "rms_length",
    "score",
]
