"""imgcal: recalibration of infrared multi-camera rigs from images of a known calibration object.

What is in `__all__` is imported when it is first used, so that `import imgcal` does not wait for PyTorch.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from imgcal.accuracy import PredictedError, WorkingVolume, predicted_error
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

_NAMES = {
    "imgcal.accuracy": ("PredictedError", "WorkingVolume", "predicted_error"),
    "imgcal.detection": ("DetectionOptions", "detect"),
    "imgcal.errors": ("InputError", "RefusedError"),
    "imgcal.estimation": ("Estimate", "EstimationOptions", "estimate"),
    "imgcal.formats": ("load_detections", "load_object", "load_rig", "save_detections", "save_rig"),
    "imgcal.labelling": ("PipelineOptions",),
    "imgcal.live": ("Recalibrator",),
    "imgcal.objects": ("CalibrationObject",),
    "imgcal.observations": ("Detections", "Observations"),
    "imgcal.pipeline": ("Calibration", "calibrate", "score"),
    "imgcal.projection": ("Projection",),
    "imgcal.rig": ("CameraRig", "RigPrior"),
    "imgcal.transforms": ("RigidTransform",),
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
