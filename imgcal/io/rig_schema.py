"""The schema of a rig file (`format: imgcal-rig/1`), and how its values must fit together."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import LENS_MODELS, LensModel
from imgcal.io.names import LONGEST_NAME, is_file_name
from imgcal.io.validation import StrictModel
from imgcal.messages import list_names, quote
from imgcal.types import ConvexVolume, DriftRate, RigPrior, limits, parameter_names

FORMAT = "imgcal-rig/1"

# How far the distortion may move a point at half the image diagonal, in units of its distance from the centre.
LARGEST_DISTORTION = 10.0
MOST_POINTS = 1000  # of a volume
WIDEST = math.radians(85)  # of a fisheye, where its distortion is looked at
MOST_COEFFICIENTS = max(len(model.coefficients) for model in LENS_MODELS.values())
MOST_PARAMETERS = len(parameter_names(list(LENS_MODELS)))


def _within(plausible: limits.Range) -> Any:
    return Field(allow_inf_nan=False, ge=plausible.low, le=plausible.high)


def _of_length(count: int) -> Any:
    return Field(min_length=count, max_length=count)


Focal = Annotated[float, _within(limits.FOCAL_LENGTH)]
Pixel = Annotated[float, _within(limits.PIXEL)]
Coefficient = Annotated[float, _within(limits.DISTORTION)]
Shift = Annotated[float, _within(limits.TRANSLATION)]
Angle = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Spread = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e12)]
Covariance = Annotated[float, Field(allow_inf_nan=False, ge=-1e24, le=1e24)]
Side = Annotated[int, Field(gt=0, le=limits.LONGEST_SIDE)]
Name = Annotated[str, Field(max_length=LONGEST_NAME)]


class _Transform(StrictModel):
    rotation_vector: Annotated[list[Angle], _of_length(3)]
    translation: Annotated[list[Shift], _of_length(3)]

    @model_validator(mode="after")
    def _check_angle(self) -> _Transform:
        angle = math.hypot(*self.rotation_vector)
        if angle > 2 * math.pi + 1e-9:
            raise ValueError(f"found a rotation vector of length {angle:g}, expected rad, at most 2 pi")
        return self


class Std(StrictModel):
    """One standard deviation of each value of a camera: rad, mm, pixels, pixels, 1."""

    rotation: Annotated[list[Spread], _of_length(3)]
    position: Annotated[list[Spread], _of_length(3)]
    focal_length: Annotated[list[Spread], _of_length(2)]
    principal_point: Annotated[list[Spread], _of_length(2)]
    distortion: Annotated[list[Spread], Field(max_length=MOST_COEFFICIENTS)]


class CameraImages(StrictModel):
    """The keys that all cameras have: name and image size."""

    name: str
    image_size: Annotated[list[Side], _of_length(2)]

    @model_validator(mode="after")
    def _check_images(self) -> Self:
        # The name is also a file name in a capture and a cell of a CSV file.
        if not is_file_name(self.name):
            raise ValueError(f"found the camera name {quote(self.name)!r}, expected a name that can be a file name")
        if math.prod(self.image_size) > limits.MOST_PIXELS:
            raise ValueError(f"image_size: found {self.image_size}, expected at most {limits.MOST_PIXELS:,} pixels")
        return self


class CameraEntry(CameraImages):
    """A calibrated camera."""

    focal_length: Annotated[list[Focal], _of_length(2)]
    principal_point: Annotated[list[Pixel], _of_length(2)]
    model: Name = "brown_conrady"
    distortion: Annotated[list[Coefficient], Field(max_length=MOST_COEFFICIENTS)]
    cam_from_rig: _Transform
    std: Std | None = None

    @model_validator(mode="after")
    def _check_lens(self) -> CameraEntry:
        if self.model not in LENS_MODELS:
            raise ValueError(f"model: found {quote(self.model)!r}, expected one of {list_names(LENS_MODELS)}")
        model = LENS_MODELS[self.model]
        names, count = ", ".join(model.coefficients), len(model.coefficients)
        for key, values in (("distortion", self.distortion), ("std", self.std.distortion if self.std else None)):
            if values is not None and len(values) != count:
                raise ValueError(f"{key}: found {len(values)} coefficients, expected {count} of {self.model}: {names}")
        radius = math.hypot(*self.image_size) / 2 / min(self.focal_length)
        shift = _shift(model, self.distortion, radius)
        if not shift <= LARGEST_DISTORTION:
            raise ValueError(
                f"distortion: found {self.distortion}, which moves the image corners by {shift:.0f} times their "
                f"distance from the centre; expected {names} on the z = 1 plane"
            )
        return self


def _shift(model: LensModel, coefficients: list[float], radius: float) -> float:
    """How far a lens moves points within a radius of the image, in units of their distance from its centre."""
    if model.inverse is not None:
        radius = math.tan(min(radius, WIDEST))
    s = (radius * torch.linspace(0.125, 1.0, 8, dtype=torch.float64)).square()
    k = torch.tensor(coefficients, dtype=torch.float64)
    along = (model.radial(1.0, s, k) - model.radial(1.0, 0 * s, k)).abs().max()
    return float(along) + (3 * radius * sum(abs(coefficients[i]) for i in model.decentering or ()))


class _Prior(StrictModel):
    focal_length: Annotated[float, _within(limits.PRIOR_FOCAL_LENGTH)] = RigPrior.focal_length
    principal_point: Annotated[float, _within(limits.PRIOR_PRINCIPAL_POINT)] = RigPrior.principal_point
    distortion: Annotated[float, _within(limits.PRIOR_DISTORTION)] = RigPrior.distortion
    rotation: Annotated[float, _within(limits.PRIOR_ROTATION)] = RigPrior.rotation
    position: Annotated[float, _within(limits.PRIOR_POSITION)] = RigPrior.position


class _DriftRate(StrictModel):
    """Zero is allowed: the value does not drift."""

    focal_length: Annotated[float, Field(ge=0, le=limits.PRIOR_FOCAL_LENGTH.high)] = DriftRate.focal_length
    principal_point: Annotated[float, Field(ge=0, le=limits.PRIOR_PRINCIPAL_POINT.high)] = DriftRate.principal_point
    distortion: Annotated[float, Field(ge=0, le=limits.PRIOR_DISTORTION.high)] = DriftRate.distortion
    rotation: Annotated[float, Field(ge=0, le=limits.PRIOR_ROTATION.high)] = DriftRate.rotation
    position: Annotated[float, Field(ge=0, le=limits.PRIOR_POSITION.high)] = DriftRate.position


class _Volume(StrictModel):
    """A box between two corners, or what some points enclose."""

    low: Annotated[list[Shift], _of_length(3)] | None = None
    high: Annotated[list[Shift], _of_length(3)] | None = None
    points: (
        Annotated[list[Annotated[list[Shift], _of_length(3)]], Field(min_length=4, max_length=MOST_POINTS)] | None
    ) = None

    @model_validator(mode="after")
    def _check_values(self) -> _Volume:
        if (self.low is None, self.high is None) != (self.points is not None,) * 2:
            raise ValueError("expected `low` and `high` of a box, or `points` that enclose a volume")
        try:
            self.value()
        except InputError as error:
            raise ValueError(str(error).removeprefix("volume: ")) from error
        return self

    def value(self) -> ConvexVolume:
        if self.points is not None:
            return ConvexVolume(tuple((x, y, z) for x, y, z in self.points))
        assert self.low is not None and self.high is not None
        (x, y, z), (u, v, w) = self.low, self.high
        return ConvexVolume.box((x, y, z), (u, v, w))


class _Covariance(StrictModel):
    reference_camera: Name | None = None
    parameters: Annotated[list[Name], Field(max_length=MOST_PARAMETERS)]
    # One wrong value of millions is enough to know.
    matrix: (
        Annotated[list[Annotated[list[Covariance], Field(fail_fast=True)]], Field(min_length=1, fail_fast=True)] | None
    ) = None


class RigFile(StrictModel):
    """A whole rig file; a rig without `name` is named after its file."""

    format: Literal["imgcal-rig/1"]
    name: Name | None = None
    working_distance: Annotated[float, _within(limits.DISTANCE)] | None = None
    cameras: Annotated[list[CameraEntry], Field(min_length=1, max_length=limits.MOST_CAMERAS)]
    prior: _Prior | None = None
    drift_rate: _DriftRate | None = None
    volume: _Volume | None = None
    covariance: _Covariance | None = None
    posterior: Name | None = None  # the file beside it, of all that the calibration knows

    @model_validator(mode="after")
    def _check_consistency(self) -> RigFile:
        if self.name is not None and not self.name.isprintable():
            raise ValueError(f"name: found {self.name!r}, expected text that can be shown")
        names = [camera.name for camera in self.cameras]
        check_names(names)
        given = [camera.name for camera in self.cameras if camera.std is not None]
        if given and len(given) < len(names):
            raise ValueError(f"found `std` for {list_names(given)} only, expected it for all cameras or none")
        if bool(given) != (self.covariance is not None):
            raise ValueError(
                "expected `std` of the cameras and the block `covariance` together, found only one of them"
            )
        if self.covariance is not None:
            _check_covariance(self.covariance, self.cameras, collect_std(self))
        return self


def check_names(names: list[str]) -> None:
    """Raise `ValueError` where two cameras have one name."""
    if (twice := limits.find_repeated(names)) is not None:
        raise ValueError(f"found the camera name {twice} more than once, expected different names")


def collect_std(content: RigFile) -> Tensor:
    """Collect the standard deviations of all cameras: (C, K)."""
    rows = [[v for part in camera.std.model_dump().values() for v in part] for camera in content.cameras if camera.std]
    width = len(parameter_names([camera.model for camera in content.cameras]))
    return torch.tensor([[*row, *[0.0] * (width - len(row))] for row in rows], dtype=torch.float64)


def _check_covariance(covariance: _Covariance, cameras: list[CameraEntry], std: Tensor) -> None:
    names, expected = [camera.name for camera in cameras], parameter_names([camera.model for camera in cameras])
    if covariance.reference_camera is not None and covariance.reference_camera not in names:
        found = covariance.reference_camera
        raise ValueError(f"covariance: found reference_camera {found}, expected one of {list_names(names)}")
    if tuple(covariance.parameters) != expected:
        raise ValueError(f"covariance: found other parameters than {', '.join(expected)}, or another order")
    if covariance.matrix is None:
        return
    size = std.numel()
    lengths = {len(row) for row in covariance.matrix}
    if len(covariance.matrix) != size or lengths != {size}:
        raise ValueError(
            f"covariance: found a matrix of {len(covariance.matrix)} rows of {min(lengths, default=0)} to "
            f"{max(lengths, default=0)} values, expected {size} rows of {size}"
        )
    matrix = torch.tensor(covariance.matrix, dtype=torch.float64)
    variance = std.flatten().square()
    scale = (variance[:, None] * variance).sqrt()
    if not torch.allclose(matrix.diagonal(), variance, rtol=1e-4, atol=0.0):
        raise ValueError("covariance: found a diagonal that differs from the squares of `std`, expected the same")
    if ((matrix - matrix.mT).abs() > 1e-6 * scale).any() or (matrix.abs() > (1 + 1e-4) * scale).any():
        raise ValueError("covariance: found a matrix that is not symmetric or has correlations above 1")
