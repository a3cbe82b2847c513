"""Plausible ranges: every input number, from a file or from Python, is compared with the range of its kind.

The ranges are wide (a microscope and an airfield fit). Values outside of them come from a damaged file or another unit,
and make arithmetic overflow.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from imgcal import geometry
from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.types.detections import BlobFlag

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from imgcal.types.calibration_object import CalibrationObject
    from imgcal.types.detections import Detections
    from imgcal.types.observations import Observations
    from imgcal.types.rig import CameraRig, DriftRate, RigPrior


@dataclass(frozen=True)
class Range:
    """Plausible values of one kind, limits included."""

    low: float
    high: float
    unit: str

    def holds(self, values: Tensor) -> Tensor:
        """Tell for each value (any shape) whether it is plausible: bool of that shape; NaN is not."""
        return (values >= self.low) & (values <= self.high)

    def holds_all(self, values: Tensor) -> bool:
        """Tell whether all values (any shape) are plausible: a few microseconds, by NumPy."""
        array = _array(values)
        return not array.size or bool(array.min() >= self.low and array.max() <= self.high)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}"


MOST_CAMERAS = 256
MOST_FIDUCIALS = 1000
LONGEST_SIDE = 2**16  # px
MOST_PIXELS = 2**27  # of one image
MOST_FLAGS = 2 * max(BlobFlag) - 1  # sum of all bits

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

AGE = Range(0.0, 1e6, "h")  # of a device since its factory calibration

SPREADS = {
    "focal_length": replace(PRIOR_FOCAL_LENGTH, low=0.0),
    "principal_point": replace(PRIOR_PRINCIPAL_POINT, low=0.0),
    "distortion": replace(PRIOR_DISTORTION, low=0.0),
    "rotation": replace(PRIOR_ROTATION, low=0.0),
    "position": replace(PRIOR_POSITION, low=0.0),
}
"""Of the fields of `RigPrior` and `DriftRate` in memory, where zero keeps a value fixed."""

ORTHONORMAL = 1e-4
"""Most that R R^T of a rotation in memory may differ from the identity: four digits, where files in six have 2e-6."""


def check_rig(rig: CameraRig, *, any_batch: bool = False) -> None:
    """Check a rig that was not read from a file: files are checked when they are read.

    Args:
        rig: the rig.
        any_batch: it may have batch axes.

    Raises:
        InputError: it is no rig, its values do not fit together, or one is implausible.
    """
    if not isinstance(getattr(rig, "cam_from_rig", None), geometry.RigidTransform):
        found = repr(rig) if isinstance(rig, str) else f"a {type(rig).__name__}"
        raise InputError(f"rig: found {shorten(found)}, expected a CameraRig; load_rig(...) reads one")
    where = f"rig {rig.name}"
    if rig.batch_shape and not any_batch:
        raise InputError(f"{where}: found a batch of rigs of shape {tuple(rig.batch_shape)}, expected one rig")
    check_rig_shapes(rig)
    if (twice := find_repeated(rig.camera_names)) is not None:
        raise InputError(f"{where}: found the camera name {shorten(twice)} more than once, expected different names")
    values = {**_estimated_values(rig), "image_size": (rig.image_size, Range(1, LONGEST_SIDE, "px"))}
    for name, (tensor, plausible) in values.items():
        if not plausible.holds_all(tensor):
            place = (~plausible.holds(tensor)).nonzero()[0].tolist()
            camera = shorten(rig.camera_names[place[-2]])
            _fail(f"{where}: camera {camera}: {name}", float(tensor[tuple(place)]), plausible)
    _check_rotations(rig)
    _check_spreads(f"{where}: prior", rig.prior)
    if rig.prior is not None and not any(vars(rig.prior).values()):
        raise InputError(f"{where}: prior: found zero for all values, expected some that may have changed")
    _check_spreads(f"{where}: drift_rate", rig.drift_rate)
    if rig.working_distance is not None and not DISTANCE.low <= rig.working_distance <= DISTANCE.high:
        _fail(f"{where}: working_distance", rig.working_distance, DISTANCE)
    if rig.volume is not None:
        replace(rig.volume)  # checks its points


def has_plausible_values(rig: CameraRig) -> bool:
    """Tell whether all values of a rig that are estimated are plausible: 20 microseconds."""
    return all(plausible.holds_all(tensor) for tensor, plausible in _estimated_values(rig).values())


def _estimated_values(rig: CameraRig) -> dict[str, tuple[Tensor, Range]]:
    return {
        "focal_length": (rig.focal_length, FOCAL_LENGTH),
        "principal_point": (rig.principal_point, PIXEL),
        "distortion": (rig.distortion, DISTORTION),
        "translation": (rig.cam_from_rig.translation, TRANSLATION),
    }


def check_rig_shapes(rig: CameraRig) -> None:
    """Check that the values of a rig are for as many cameras as it has names, and the lenses have all coefficients.

    Raises:
        InputError: a value has another shape, whatever its batch axes, or the lens models do not fit.
    """
    where, cameras, width = f"rig {rig.name}", rig.num_cameras, rig.distortion.shape[-1]
    expected = (
        ("focal_length", rig.focal_length, (cameras, 2)),
        ("principal_point", rig.principal_point, (cameras, 2)),
        ("distortion", rig.distortion, (cameras, width)),
        ("rotation", rig.cam_from_rig.rotation, (cameras, 3, 3)),
        ("translation", rig.cam_from_rig.translation, (cameras, 3)),
        ("image_size", rig.image_size, (cameras, 2)),
    )
    geometry.require_shapes(where, expected, any_batch=True)
    geometry.require_lenses(where, rig.lens_models, cameras, width)
    needed = geometry.lens_width(rig.lens_model)
    if width < needed:
        raise InputError(f"{where}: found distortion of width {width}, expected {needed} for {rig.lens_model}")


def _check_rotations(rig: CameraRig) -> None:
    rotation = _array(rig.cam_from_rig.rotation)
    off = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max((-2, -1))
    orthonormal = off <= ORTHONORMAL
    right = np.linalg.det(rotation) > 0 if orthonormal.all() else orthonormal
    if not right.all():
        place = tuple(np.argwhere(~right)[0].tolist())
        found = f"R R^T off from the identity by {off[place]:.3g}"
        if orthonormal[place]:
            found = "a mirror (determinant -1)"
        camera = shorten(rig.camera_names[place[-1]])
        raise InputError(f"rig {rig.name}: camera {camera}: rotation: found {found}, expected a rotation matrix")


def _check_spreads(where: str, spreads: RigPrior | DriftRate | None) -> None:
    for name, value in () if spreads is None else vars(spreads).items():
        plausible = SPREADS[name]
        if not plausible.low <= value <= plausible.high:
            _fail(f"{where}: {name}", value, plausible)


def find_repeated(names: Sequence[str]) -> str | None:
    """Find a name that occurs more than once; None = there is none."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def check_object(obj: CalibrationObject) -> None:
    """Raise `InputError` if an object, or one of several, has implausible values, or values that require gradients."""
    for part in obj.each:
        if part.points.requires_grad:
            raise InputError(f"object {part.name}: found points that require gradients, expected constants: detach()")
        columns = {"coordinate": (part.points, COORDINATE)}
        if part.radius is not None:
            columns["radius"] = part.radius, FIDUCIAL_RADIUS
        for name, (tensor, plausible) in columns.items():
            if not plausible.holds_all(tensor):
                place = (~plausible.holds(tensor)).nonzero()[0].tolist()
                _fail(f"object {part.name}: fiducial {place[0]}: {name}", float(tensor[tuple(place)]), plausible)


def check_detections(detections: Detections, where: str = "detections") -> None:
    """Check blobs that were not read from a file: columns of one length, and values in the ranges of their kinds.

    Args:
        detections: the blobs.
        where: what errors begin with.

    Raises:
        InputError: inconsistent columns, a camera or snapshot that does not exist or has another's name, an invalid
            pixel, standard deviation or radius, or a fiducial that a camera has twice in a snapshot.
    """
    count = np.shape(detections.uv)[:1]
    for name in ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags"):
        column, expected = getattr(detections, name), (*count, 2) if name == "uv" else count
        if not isinstance(column, np.ndarray) or column.shape != expected:
            found = f"an array of shape {column.shape}" if isinstance(column, np.ndarray) else type(column).__name__
            raise InputError(f"{where}: {name}: found {found}, expected a NumPy array of shape {expected}")
        wanted, kinds = ("numbers", "fiu") if name in ("uv", "sigma", "radius") else ("integers", "iu")
        if column.dtype.kind not in kinds:
            raise InputError(f"{where}: {name}: found an array of {column.dtype}, expected {wanted}")
    for name in ("camera", "snapshot"):
        names, column = getattr(detections, f"{name}_names"), getattr(detections, name)
        if (twice := find_repeated(names)) is not None:
            raise InputError(
                f"{where}: found the {name} name {shorten(twice)} more than once, expected different names"
            )
        _check_column(detections, name, (column >= 0) & (column < len(names)), f"0 to {len(names) - 1}", where)
    fiducial, flags = detections.fiducial, detections.flags
    _check_column(detections, "fiducial", fiducial >= -1, "a row of the object, or -1", where)
    _check_column(detections, "flags", (flags >= 0) & (flags <= MOST_FLAGS), f"0 to {MOST_FLAGS}", where)
    row = detections.find_repeated_label()
    if row is not None:
        camera = detections.camera_names[detections.camera[row]]
        snapshot = detections.snapshot_names[detections.snapshot[row]]
        raise InputError(
            f"{where}: fiducial: found {detections.fiducial[row]} again in row {row} for camera {camera} in "
            f"snapshot {snapshot}, expected it once"
        )
    uv, sigma, radius = detections.uv, detections.sigma, detections.radius
    wrong = (uv < PIXEL.low) | (uv > PIXEL.high) | np.isnan(uv)
    _check_column(detections, "uv", ~(wrong[:, 0] | wrong[:, 1]), f"a pixel, {PIXEL}", where)
    good = (sigma >= SIGMA.low) & (sigma <= SIGMA.high)
    _check_column(detections, "sigma", good, f"a standard deviation > 0, {SIGMA}", where)
    known = (radius >= 0) & (radius <= BLOB_RADIUS.high)
    _check_column(detections, "radius", known | np.isnan(radius), f"a radius, {BLOB_RADIUS}, or nan", where)


def _check_column(detections: Detections, column: str, good: NDArray[np.bool_], expected: str, where: str) -> None:
    if not good.all():
        row = int(good.argmin())
        found = getattr(detections, column)[row]
        raise InputError(f"{where}: {column}: found {found} in row {row}, expected {expected}")


def check_observations(observations: Observations) -> None:
    """Check the pixels and standard deviations of observations.

    Raises:
        InputError: a visible fiducial has a pixel that is not finite, or a standard deviation of zero or less.
    """
    if bool(np.isfinite(_array(observations.uv)).all() and (_array(observations.sigma) > 0).all()):
        return
    sigma = observations.sigma.expand(observations.seen.shape)
    for name, values, good, expected in (
        ("uv", observations.uv, observations.uv.isfinite().all(-1), "finite pixels"),
        ("sigma", sigma, sigma > 0, "a standard deviation > 0 in pixels"),
    ):
        wrong = observations.seen & ~good
        if bool(wrong.any()):
            place = wrong.nonzero()[0].tolist()
            found = values[tuple(place)].tolist()
            shown = ", ".join(f"{value:g}" for value in (found if isinstance(found, list) else [found]))
            raise InputError(f"observations: {name}{place}: found {shown}, expected {expected}")


def _array(values: Tensor) -> NDArray[np.float64]:
    """The values for NumPy, whose calls take a tenth of the time of PyTorch's where arrays are small."""
    array: NDArray[np.float64] = values.detach().double().cpu().numpy()
    return array


def _fail(place: str, value: float, plausible: Range) -> NoReturn:
    raise InputError(f"{place}: found {value:g}, expected {str(plausible).strip()}")
