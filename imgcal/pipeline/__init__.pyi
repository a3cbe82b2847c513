from .board_turns import settle_labels
from .calibration import Calibration
from .camera_motion import MOVED, Motion, motion_since_factory
from .capture_detection import capture_sight, detect_capture, read_masks
from .clock_offset import LateCamera
from .coverage import FIELDS, UNDETERMINED, Coverage, measure_coverage
from .doubtful_cameras import DoubtfulCamera
from .fitting import fit_labelled
from .from_scratch import calibrate_from_scratch
from .initialization import load_initializer
from .label_counts import DOUBTFUL, LabelCounts
from .learned_measurer import LearnedMeasurer
from .learned_proposer import LearnedProposer, load_proposer
from .lines_of_sight import choose_telling_snapshots
from .motion_check import EARLIER
from .recalibration import calibrate
from .scoring import RigScore, rms_length, score
from .sources import DETECTORS, Detector, DetectorName, check_detections, check_frames, choose_proposer
from .units import unit_doubt

__all__ = [
    "DETECTORS",
    "DOUBTFUL",
    "EARLIER",
    "FIELDS",
    "MOVED",
    "UNDETERMINED",
    "Calibration",
    "Coverage",
    "Detector",
    "DetectorName",
    "DoubtfulCamera",
    "LabelCounts",
    "LateCamera",
    "LearnedMeasurer",
    "LearnedProposer",
    "Motion",
    "RigScore",
    "calibrate",
    "calibrate_from_scratch",
    "capture_sight",
    "check_detections",
    "check_frames",
    "choose_proposer",
    "choose_telling_snapshots",
    "detect_capture",
    "fit_labelled",
    "load_initializer",
    "load_proposer",
    "measure_coverage",
    "motion_since_factory",
    "read_masks",
    "rms_length",
    "score",
    "settle_labels",
    "unit_doubt",
]
