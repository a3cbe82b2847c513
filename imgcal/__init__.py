"""imgcal: recalibration of infrared multi-camera rigs from images of a known calibration object."""

from importlib.metadata import PackageNotFoundError, version

from imgcal.detection import DetectionOptions, detect
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import Estimate, EstimationOptions, estimate
from imgcal.formats import load_detections, load_object, load_rig, save_detections, save_rig
from imgcal.labelling import PipelineOptions
from imgcal.live import Recalibrator
from imgcal.objects import CalibrationObject
from imgcal.observations import Detections, Observations
from imgcal.pipeline import Calibration, calibrate, score
from imgcal.projection import Projection
from imgcal.rig import CameraRig, RigPrior
from imgcal.transforms import RigidTransform

try:
    __version__ = version("imgcal")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0.0.0"

__all__ = [
    "Calibration",
    "CalibrationObject",
    "CameraRig",
    "DetectionOptions",
    "Detections",
    "Estimate",
    "EstimationOptions",
    "InputError",
    "Observations",
    "PipelineOptions",
    "Projection",
    "Recalibrator",
    "RefusedError",
    "RigPrior",
    "RigidTransform",
    "calibrate",
    "detect",
    "estimate",
    "load_detections",
    "load_object",
    "load_rig",
    "save_detections",
    "save_rig",
    "score",
]
