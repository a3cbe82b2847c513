from .association import PipelineOptions
from .detection import DetectionOptions, detect
from .errors import InputError, RefusedError
from .estimation import Estimate, EstimationOptions, PredictedError, WorkingVolume, estimate, predicted_error
from .formats import load_rig
from .geometry import Projection, RigidTransform
from .io import load_detections, load_object, open_capture, save_detections, save_object, save_rig
from .online import Event, RigKeeper, RigState
from .pipeline import Calibration, calibrate, calibrate_from_scratch, score
from .types import CalibrationObject, CameraRig, Detections, DriftRate, Observations, RigPrior

__version__: str

__all__ = [
    "Calibration",
    "CalibrationObject",
    "CameraRig",
    "DetectionOptions",
    "Detections",
    "DriftRate",
    "Estimate",
    "EstimationOptions",
    "Event",
    "InputError",
    "Observations",
    "PipelineOptions",
    "PredictedError",
    "Projection",
    "RefusedError",
    "RigKeeper",
    "RigPrior",
    "RigState",
    "RigidTransform",
    "WorkingVolume",
    "calibrate",
    "calibrate_from_scratch",
    "detect",
    "estimate",
    "load_detections",
    "load_object",
    "load_rig",
    "open_capture",
    "predicted_error",
    "save_detections",
    "save_object",
    "save_rig",
    "score",
]
