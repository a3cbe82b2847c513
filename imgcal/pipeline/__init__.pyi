from .calibration import Calibration, calibrate, fit_labelled
from .initialization import load_initializer
from .learned import LearnedProposer, load_proposer
from .measuring import LearnedMeasurer
from .scoring import RigScore, rms_length, score
from .sources import Detector, DetectorName, checked_detections, checked_frames, proposer_of
from .tally import DOUBTFUL, Tally

__all__ = [
    "DOUBTFUL",
    "Calibration",
    "Detector",
    "DetectorName",
    "LearnedMeasurer",
    "LearnedProposer",
    "RigScore",
    "Tally",
    "calibrate",
    "checked_detections",
    "checked_frames",
    "fit_labelled",
    "load_initializer",
    "load_proposer",
    "proposer_of",
    "rms_length",
    "score",
]
