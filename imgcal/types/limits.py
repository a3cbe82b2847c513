"""Plausible ranges: every input number, from a file or from Python, is compared with the range of its kind.

The ranges are wide (a microscope and an airfield fit). Values outside of them come from a damaged file or another unit,
and make arithmetic overflow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NoReturn

from imgcal import geometry
from imgcal.errors import InputError
from imgcal.messages import shorten

if TYPE_CHECKING:
    from torch import Tensor

    from imgcal.types.calibration_object import CalibrationObject
    from imgcal.types.observations import Observations
    from imgcal.types.rig import CameraRig


@dataclass(frozen=True)
class Range:
    """Plausible values of one kind, limits included."""

    low: float
    high: float
    unit: str

    def holds(self, values: Tensor) -> Tensor:
        """Tell for each value (any shape) whether it is plausible: bool of that shape; NaN is not."""
        return (values >= self.low) & (values <= self.high)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}"


MOST_CAMERAS = 256
MOST_FIDUCIALS = 1000
LONGEST_SIDE = 2**16  # px
MOST_PIXELS = 2**27  # of one image

FOCAL_LENGTH = Range(0.1, 1e7, "px")
PIXEL = Range(-1e6, 1e6, "px")  # any coordinate in an image or beside it
SIGMA = Range(1e-6, 1e4, "px")
BLOB_RADIUS = Range(0.0, 1e5, "px")
DISTORTION = Range(-1e9, 1e9, "")
TRANSLATION = Range(-1e7, 1e7, "mm")
DISTANCE = Range(1e-3, 1e7, "mm")
COORDINATE = Range(-1e6, 1e6, "mm")  # of a fiducial in its object
FIDUCIAL_RADIUS = Range(1e-6, 1e5, "mm")
TOLERANCE = Range(0.0, 1e3, "mm")  # of a fiducial's coordinates

# Expected drift as stated in a rig file; one standard deviation.
PRIOR_FOCAL_LENGTH = Range(1e-9, 10.0, "of the focal length")
PRIOR_PRINCIPAL_POINT = Range(1e-9, 1e6, "px")
PRIOR_DISTORTION = Range(1e-12, 1e6, "")
PRIOR_ROTATION = Range(1e-12, 10.0, "rad")
PRIOR_POSITION = Range(1e-9, 1e7, "mm")


def check_rig(rig: CameraRig) -> None:
    """Check a rig that was not read from a file: files are checked when they are read.

    Raises:
        InputError: a value is implausible, or the lens models do not fit the coefficients.
    """
    unknown = [name for name in rig.lens_models if name not in geometry.LENS_MODELS]
    if unknown or len(rig.lens_models) != rig.num_cameras:
        found = f"the lens model {unknown[0]}" if unknown else f"{len(rig.lens_models)} lens models"
        known = ", ".join(geometry.LENS_MODELS)
        raise InputError(f"rig {rig.name}: found {found}, expected {known} for all cameras or each")
    width = geometry.lens_width(rig.lens_model)
    if rig.distortion.shape[-1] < width:
        found = f"distortion of width {rig.distortion.shape[-1]}"
        raise InputError(f"rig {rig.name}: found {found}, expected {width} for {rig.lens_model}")
    values = {
        "focal_length": (rig.focal_length, FOCAL_LENGTH),
        "principal_point": (rig.principal_point, PIXEL),
        "distortion": (rig.distortion, DISTORTION),
        "rotation": (rig.cam_from_rig.rotation.flatten(-2), Range(-1.001, 1.001, "")),
        "translation": (rig.cam_from_rig.translation, TRANSLATION),
        "image_size": (rig.image_size, Range(1, LONGEST_SIDE, "px")),
    }
    for name, (tensor, plausible) in values.items():
        wrong = ~plausible.holds(tensor)
        if bool(wrong.any()):
            place = wrong.nonzero()[0].tolist()
            camera = shorten(rig.camera_names[place[-2]])
            _fail(f"rig {rig.name}: camera {camera}: {name}", float(tensor[tuple(place)]), plausible)
    if rig.volume is not None:
        replace(rig.volume)  # checks its points


def check_object(obj: CalibrationObject) -> None:
    """Raise `InputError` if an object has implausible values."""
    columns = {"coordinate": (obj.points, COORDINATE)}
    if obj.radius is not None:
        columns["radius"] = obj.radius, FIDUCIAL_RADIUS
    for name, (tensor, plausible) in columns.items():
        wrong = ~plausible.holds(tensor)
        if bool(wrong.any()):
            place = wrong.nonzero()[0].tolist()
            _fail(f"object {obj.name}: fiducial {place[0]}: {name}", float(tensor[tuple(place)]), plausible)


def check_observations(observations: Observations) -> None:
    """Check the standard deviations of observations.

    Raises:
        InputError: a visible fiducial has a standard deviation of zero or less.
    """
    sigma = observations.sigma.expand(observations.seen.shape)
    wrong = observations.seen & (sigma <= 0)
    if bool(wrong.any()):
        place = wrong.nonzero()[0].tolist()
        found = float(sigma[tuple(place)])
        raise InputError(f"observations: sigma{place}: found {found:g}, expected a standard deviation > 0 in pixels")


def _fail(place: str, value: float, plausible: Range) -> NoReturn:
    raise InputError(f"{place}: found {value:g}, expected {str(plausible).strip()}")
