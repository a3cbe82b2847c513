from .calibration import Calibration
from .captured import detect_capture, masks_of, sight_of_capture
from .doubtful import DoubtfulCamera
from .fitting import fit_labelled
from .from_scratch import calibrate_from_scratch
from .initialization import load_initializer
from .knowledge import FIELDS, UNDETERMINED, Knowledge, knowledge_of
from .lateness import LateCamera
from .learned import LearnedProposer, load_proposer
from .measuring import LearnedMeasurer
from .motion import MOVED, Motion, motion_since_factory
from .recalibration import calibrate
from .scoring import RigScore, rms_length, score
from .sources import DETECTORS, Detector, DetectorName, checked_detections, checked_frames, proposer_of
from .steadiness import EARLIER
from .tally import DOUBTFUL, Tally
from .units import unit_doubt

__all__ = [
    "DETECTORS",
    "DOUBTFUL",
    "EARLIER",
    "FIELDS",
    "MOVED",
    "UNDETERMINED",
    "Calibration",
    "Detector",
    "DetectorName",
    "DoubtfulCamera",
    "Knowledge",
    "LateCamera",
    "LearnedMeasurer",
    "LearnedProposer",
    "Motion",
    "RigScore",
    "Tally",
    "calibrate",
    "calibrate_from_scratch",
    "checked_detections",
    "checked_frames",
    "detect_capture",
    "fit_labelled",
    "knowledge_of",
    "load_initializer",
    "load_proposer",
    "masks_of",
    "motion_since_factory",
    "proposer_of",
    "rms_length",
    "score",
    "sight_of_capture",
    "unit_doubt",
]
