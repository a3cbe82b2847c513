"""imgcal: recalibration of infrared multi-camera rigs from images of a known calibration object.

What is in `__all__` is imported when it is first used, so that `import imgcal` does not wait for PyTorch.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from imgcal.association.options import PipelineOptions
    from imgcal.detection import DetectionOptions, detect
    from imgcal.errors import InputError, RefusedError
    from imgcal.estimation import Estimate, EstimationOptions, estimate
    from imgcal.estimation.predicted_error import PredictedError, WorkingVolume, predicted_error
    from imgcal.geometry.projection import Projection
    from imgcal.geometry.transforms import RigidTransform
    from imgcal.io import load_detections, load_object, load_rig, save_detections, save_rig
    from imgcal.online.recalibrator import Recalibrator
    from imgcal.pipeline.calibration import Calibration, calibrate, score
    from imgcal.types.calibration_object import CalibrationObject
    from imgcal.types.observations import Detections, Observations
    from imgcal.types.rig import CameraRig, RigPrior

_NAMES = {
    "imgcal.estimation.predicted_error": ("PredictedError", "WorkingVolume", "predicted_error"),
    "imgcal.detection": ("DetectionOptions", "detect"),
    "imgcal.errors": ("InputError", "RefusedError"),
    "imgcal.estimation": ("Estimate", "EstimationOptions", "estimate"),
    "imgcal.io": ("load_detections", "load_object", "load_rig", "save_detections", "save_rig"),
    "imgcal.association.options": ("PipelineOptions",),
    "imgcal.online.recalibrator": ("Recalibrator",),
    "imgcal.types.calibration_object": ("CalibrationObject",),
    "imgcal.types.observations": ("Detections", "Observations"),
    "imgcal.pipeline.calibration": ("Calibration", "calibrate", "score"),
    "imgcal.geometry.projection": ("Projection",),
    "imgcal.types.rig": ("CameraRig", "RigPrior"),
    "imgcal.geometry.transforms": ("RigidTransform",),
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

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
    "PredictedError",
    "Projection",
    "Recalibrator",
    "RefusedError",
    "RigPrior",
    "RigidTransform",
    "WorkingVolume",
    "calibrate",
    "detect",
    "estimate",
    "load_detections",
    "load_object",
    "load_rig",
    "predicted_error",
    "save_detections",
    "save_rig",
    "score",
]


def __getattr__(name: str) -> Any:
    """Import a name of `__all__`, or a module of this package, when it is first asked for (PEP 562)."""
    if name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    elif not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
        value = import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
