from . import limits
from .board import Board, BoardKind
from .calibration_object import MOST_LIGHTS, CalibrationObject, Symmetry
from .detections import UNUSABLE, BlobFlag, BlobKind, Detections
from .differences import object_difference, rig_difference
from .limits import (
    BLOB_RADIUS,
    FIDUCIAL_RADIUS,
    MOST_PIXELS,
    SIGMA,
    Range,
    check_detections,
    check_object,
    check_observations,
    check_rig,
    check_rig_shapes,
    find_repeated,
    has_plausible_values,
)
from .moved_camera import Kind, MovedCamera, MovedError
from .observations import Observations
from .parameter_vectors import pack21, unpack18, unpack21
from .placement import CROP_MARGIN, CROP_SIZE, PATCH_SIZE, CropPlacement
from .prediction import Prediction, Views
from .rig import (
    EXTRINSICS,
    PARAMETER_KINDS,
    PARAMETER_NAMES,
    PARAMETERS,
    PINHOLE,
    SHOWN_UNITS,
    CameraRig,
    DriftRate,
    RigPosterior,
    RigPrior,
    parameter_names,
)
from .volume import ConvexVolume

__all__ = [
    "BLOB_RADIUS",
    "CROP_MARGIN",
    "CROP_SIZE",
    "EXTRINSICS",
    "FIDUCIAL_RADIUS",
    "MOST_LIGHTS",
    "MOST_PIXELS",
    "PARAMETERS",
    "PARAMETER_KINDS",
    "PARAMETER_NAMES",
    "PATCH_SIZE",
    "PINHOLE",
    "SHOWN_UNITS",
    "SIGMA",
    "UNUSABLE",
    "BlobFlag",
    "BlobKind",
    "Board",
    "BoardKind",
    "CalibrationObject",
    "CameraRig",
    "ConvexVolume",
    "CropPlacement",
    "Detections",
    "DriftRate",
    "Kind",
    "MovedCamera",
    "MovedError",
    "Observations",
    "Prediction",
    "Range",
    "RigPosterior",
    "RigPrior",
    "Symmetry",
    "Views",
    "check_detections",
    "check_object",
    "check_observations",
    "check_rig",
    "check_rig_shapes",
    "find_repeated",
    "has_plausible_values",
    "limits",
    "object_difference",
    "pack21",
    "parameter_names",
    "rig_difference",
    "unpack18",
    "unpack21",
]
