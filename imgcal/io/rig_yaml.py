"""Rig files: YAML, `format: imgcal-rig/1`."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import (
    LENS_MODELS,
    LensModel,
    RigidTransform,
    lens_width,
    named_lenses,
    rotation_from_vector,
    vector_from_rotation,
)
from imgcal.io.atomic import write_text
from imgcal.io.names import LONGEST_NAME, find_file, is_file_name, title_of
from imgcal.io.validation import StrictModel, validated
from imgcal.io.yaml_file import Flow, FlowMap, read_yaml, record_from_yaml, yaml_text
from imgcal.messages import listed, quoted
from imgcal.types import CameraRig, DriftRate, RigPrior, Volume, limits, parameter_names

FORMAT = "imgcal-rig/1"
ENTRY_NAMES = {"cameras": "camera"}

# How far the distortion may move a point at half the image diagonal, in units of its distance from the centre.
LARGEST_DISTORTION = 10.0
MOST_POINTS = 1000  # of a volume
WIDEST = math.radians(85)  # of a fisheye, where its distortion is looked at
MOST_COEFFICIENTS = max(len(model.coefficients) for model in LENS_MODELS.values())
MOST_PARAMETERS = len(parameter_names(list(LENS_MODELS)))


def _within(plausible: limits.Range) -> Any:
    return Field(allow_inf_nan=False, ge=plausible.low, le=plausible.high)


def _exactly(count: int) -> Any:
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


@dataclass(frozen=True)
class RigCovariance:
    """Uncertainty of a rig, in the order of `CameraRig.parameter_names` for each camera."""

    std: Tensor  # (C, K) one standard deviation: rad, mm, pixels, pixels, 1
    matrix: Tensor | None = None  # (K C, K C); None = not kept
    reference_camera: str | None = None  # rotations and positions are relative to this camera; None = to the rig frame

    @classmethod
    def from_matrix(cls, matrix: Tensor, cameras: int, reference_camera: str | None = None) -> RigCovariance:
        """Take the standard deviations from the diagonal of the (K C, K C) covariance of C cameras."""
        std = matrix.diagonal().clamp_min(0).sqrt().unflatten(0, (cameras, -1))
        return cls(std, matrix, reference_camera)


class _Transform(StrictModel):
    rotation_vector: Annotated[list[Angle], _exactly(3)]
    translation: Annotated[list[Shift], _exactly(3)]

    @model_validator(mode="after")
    def _in_radians(self) -> _Transform:
        angle = math.hypot(*self.rotation_vector)
        if angle > 2 * math.pi + 1e-9:
            raise ValueError(f"found a rotation vector of length {angle:g}, expected rad, at most 2 pi")
        return self


class _Std(StrictModel):
    rotation: Annotated[list[Spread], _exactly(3)]
    position: Annotated[list[Spread], _exactly(3)]
    focal_length: Annotated[list[Spread], _exactly(2)]
    principal_point: Annotated[list[Spread], _exactly(2)]
    distortion: Annotated[list[Spread], Field(max_length=MOST_COEFFICIENTS)]


class CameraImages(StrictModel):
    """What is known of any camera: its name, and the size of its images."""

    name: str
    image_size: Annotated[list[Side], _exactly(2)]

    @model_validator(mode="after")
    def _has_images(self) -> Self:
        # The name is also a file name in a capture and a cell of a CSV file.
        if not is_file_name(self.name):
            raise ValueError(f"found the camera name {quoted(self.name)!r}, expected a name that can be a file name")
        if math.prod(self.image_size) > limits.MOST_PIXELS:
            raise ValueError(f"image_size: found {self.image_size}, expected at most {limits.MOST_PIXELS:,} pixels")
        return self


class _Camera(CameraImages):
    focal_length: Annotated[list[Focal], _exactly(2)]
    principal_point: Annotated[list[Pixel], _exactly(2)]
    model: Name = "brown_conrady"
    distortion: Annotated[list[Coefficient], Field(max_length=MOST_COEFFICIENTS)]
    cam_from_rig: _Transform
    std: _Std | None = None

    @model_validator(mode="after")
    def _sound(self) -> _Camera:
        self._check_lens()
        return self

    def _check_lens(self) -> None:
        if self.model not in LENS_MODELS:
            raise ValueError(f"model: found {quoted(self.model)!r}, expected one of {listed(LENS_MODELS)}")
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
    """Zero is allowed: a value that does not wander."""

    focal_length: Annotated[float, Field(ge=0, le=limits.PRIOR_FOCAL_LENGTH.high)] = DriftRate.focal_length
    principal_point: Annotated[float, Field(ge=0, le=limits.PRIOR_PRINCIPAL_POINT.high)] = DriftRate.principal_point
    distortion: Annotated[float, Field(ge=0, le=limits.PRIOR_DISTORTION.high)] = DriftRate.distortion
    rotation: Annotated[float, Field(ge=0, le=limits.PRIOR_ROTATION.high)] = DriftRate.rotation
    position: Annotated[float, Field(ge=0, le=limits.PRIOR_POSITION.high)] = DriftRate.position


class _Volume(StrictModel):
    """A box between two corners, or what some points enclose."""

    low: Annotated[list[Shift], _exactly(3)] | None = None
    high: Annotated[list[Shift], _exactly(3)] | None = None
    points: Annotated[list[Annotated[list[Shift], _exactly(3)]], Field(min_length=4, max_length=MOST_POINTS)] | None = (
        None
    )

    @model_validator(mode="after")
    def _sound(self) -> _Volume:
        if (self.low is None, self.high is None) != (self.points is not None,) * 2:
            raise ValueError("expected `low` and `high` of a box, or `points` that enclose a volume")
        try:
            self.value()
        except InputError as error:
            raise ValueError(str(error).removeprefix("volume: ")) from error
        return self

    def value(self) -> Volume:
        if self.points is not None:
            return Volume(tuple((x, y, z) for x, y, z in self.points))
        assert self.low is not None and self.high is not None
        (x, y, z), (u, v, w) = self.low, self.high
        return Volume.box((x, y, z), (u, v, w))


class _Covariance(StrictModel):
    reference_camera: Name | None = None
    parameters: Annotated[list[Name], Field(max_length=MOST_PARAMETERS)]
    # One wrong value of millions is enough to know.
    matrix: (
        Annotated[list[Annotated[list[Covariance], Field(fail_fast=True)]], Field(min_length=1, fail_fast=True)] | None
    ) = None


class _RigFile(StrictModel):
    format: Literal["imgcal-rig/1"]
    name: Name | None = None
    working_distance: Annotated[float, _within(limits.DISTANCE)] | None = None
    cameras: Annotated[list[_Camera], Field(min_length=1, max_length=limits.MOST_CAMERAS)]
    prior: _Prior | None = None
    drift_rate: _DriftRate | None = None
    volume: _Volume | None = None
    covariance: _Covariance | None = None

    @model_validator(mode="after")
    def _consistent(self) -> _RigFile:
        if self.name is not None and not self.name.isprintable():
            raise ValueError(f"name: found {self.name!r}, expected text that can be shown")
        names = [camera.name for camera in self.cameras]
        check_names(names)
        given = [camera.name for camera in self.cameras if camera.std is not None]
        if given and len(given) < len(names):
            raise ValueError(f"found `std` for {listed(given)} only, expected it for all cameras or none")
        if bool(given) != (self.covariance is not None):
            raise ValueError(
                "expected `std` of the cameras and the block `covariance` together, found only one of them"
            )
        if self.covariance is not None:
            _check_covariance(self.covariance, self.cameras, _std_tensor(self))
        return self


def check_names(names: list[str]) -> None:
    """Raise `ValueError` where two cameras have one name."""
    twice, times = Counter(names).most_common(1)[0]
    if times > 1:
        raise ValueError(f"found the camera name {twice} more than once, expected different names")


def load_rig(path: str | Path) -> CameraRig:
    """Read a rig.

    Args:
        path: a YAML file, or the bare name of a shipped rig such as "O10" when there is no such file.

    Returns:
        The rig in float64, without batch axes.

    Raises:
        InputError: one line with the file, the camera, what was found and what was expected.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("O10")
        >>> rig.name, rig.num_cameras, rig.working_distance
        ('O10', 10, 850.14)
    """
    content, path = _read(path)
    return _rig_of(content, title_of(path))


def rig_from_text(text: str, where: str) -> CameraRig:
    """Read a rig from what its file holds, the result of `rig_text`; errors begin with `where`, as does its name.

    Raises:
        InputError: as `load_rig`.
    """
    content = record_from_yaml(text.encode(errors="replace"), where, _RigFile, FORMAT, ENTRY_NAMES)
    return _rig_of(content, where)


def load_rig_covariance(path: str | Path) -> RigCovariance | None:
    """Read the uncertainty that stands in a rig file; None when it has none. Arguments and errors as for `load_rig`."""
    content, _ = _read(path)
    if content.covariance is None:
        return None
    reference_camera = content.covariance.reference_camera
    if content.covariance.matrix is None:
        return RigCovariance(_std_tensor(content), None, reference_camera)
    matrix = torch.tensor(content.covariance.matrix, dtype=torch.float64)
    return RigCovariance.from_matrix(matrix, len(content.cameras), reference_camera)


def save_rig(rig: CameraRig, path: str | Path, covariance: RigCovariance | None = None, full: bool = False) -> None:
    """Write a rig in one step; every number in its shortest exact form.

    Args:
        rig: without batch axes; any floating-point type.
        path: the file to write.
        covariance: one standard deviation of every parameter goes to its camera, to 6 digits; None = not written.
        full: write the whole covariance matrix, too (half a megabyte for 10 cameras).

    Raises:
        InputError: the file cannot be written, or the rig could not be read again (NaN, for example).

    Examples:
        >>> import imgcal
        >>> imgcal.save_rig(imgcal.load_rig("T4").select([0, 1]), "pair.yaml")
        >>> imgcal.load_rig("pair.yaml").camera_names
        ('cam01', 'cam02')
    """
    write_text(path, rig_text(rig, path, covariance, full))


def rig_text(
    rig: CameraRig, where: str | Path = "rig", covariance: RigCovariance | None = None, full: bool = False
) -> str:
    """Make what `save_rig` writes; errors begin with `where`.

    Examples:
        >>> import imgcal
        >>> rig_text(imgcal.load_rig("T4")).splitlines()[:2]
        ['format: imgcal-rig/1', 'name: T4']
    """
    if rig.batch_shape:
        raise InputError(f"{where}: found a batch of rigs of shape {tuple(rig.batch_shape)}, expected one rig")
    if covariance is not None:
        covariance = _narrowed(covariance, rig)
    content: dict[str, Any] = {"format": FORMAT, "name": rig.name}
    if rig.working_distance is not None:
        content["working_distance"] = rig.working_distance
    content["cameras"] = [_camera_entry(rig, camera, covariance) for camera in range(rig.num_cameras)]
    if rig.prior is not None:
        content["prior"] = {key: float(value) for key, value in vars(rig.prior).items()}
    if rig.drift_rate is not None:
        content["drift_rate"] = {key: float(value) for key, value in vars(rig.drift_rate).items()}
    if rig.volume is not None:
        content["volume"] = _volume_entry(rig.volume)
    if covariance is not None:
        content["covariance"] = _covariance_entry(covariance, rig, full, where)
    validated(content, _RigFile, f"{where}: not written", ENTRY_NAMES)
    return yaml_text(content)


def _read(path: str | Path) -> tuple[_RigFile, Path]:
    path = find_file(path, "rigs", ".yaml")
    return read_yaml(path, _RigFile, FORMAT, ENTRY_NAMES), path


def _rig_of(content: _RigFile, name: str) -> CameraRig:
    """The rig of a file; `name` is for one without."""
    cameras = content.cameras
    models = named_lenses([camera.model for camera in cameras])
    width = lens_width(models)

    def column(values: list[list[float]]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    return CameraRig(
        focal_length=column([camera.focal_length for camera in cameras]),
        principal_point=column([camera.principal_point for camera in cameras]),
        distortion=column([[*camera.distortion, *[0.0] * (width - len(camera.distortion))] for camera in cameras]),
        cam_from_rig=RigidTransform(
            rotation_from_vector(column([camera.cam_from_rig.rotation_vector for camera in cameras])),
            column([camera.cam_from_rig.translation for camera in cameras]),
        ),
        image_size=torch.tensor([camera.image_size for camera in cameras]),
        camera_names=tuple(camera.name for camera in cameras),
        name=content.name if content.name is not None else name,
        working_distance=content.working_distance,
        prior=None if content.prior is None else RigPrior(**content.prior.model_dump()),
        drift_rate=None if content.drift_rate is None else DriftRate(**content.drift_rate.model_dump()),
        volume=None if content.volume is None else content.volume.value(),
        lens_model=models,
    )


def _camera_entry(rig: CameraRig, camera: int, covariance: RigCovariance | None) -> dict[str, Any]:
    rotation = rig.cam_from_rig.rotation[camera].double()
    model = LENS_MODELS[rig.lens_models[camera]]
    count = len(model.coefficients)
    entry: dict[str, Any] = {
        "name": rig.camera_names[camera],
        "image_size": Flow(rig.image_size[camera].tolist()),
        "focal_length": _flow(rig.focal_length[camera]),
        "principal_point": _flow(rig.principal_point[camera]),
        **({"model": model.name} if model.name != _Camera.model_fields["model"].default else {}),
        "distortion": _flow(rig.distortion[camera, :count]),
        "cam_from_rig": FlowMap(
            rotation_vector=_flow(vector_from_rotation(rotation)),
            translation=_flow(rig.cam_from_rig.translation[camera]),
        ),
    }
    if covariance is not None:
        # Six digits are plenty for a spread; the exact values are those of the matrix.
        rounded = [float(f"{value:.6g}") for value in covariance.std[camera].tolist()]
        *pinhole, lens = torch.tensor(rounded, dtype=torch.float64).tensor_split((3, 6, 8, 10))
        parts = (*pinhole, lens[:count])
        entry["std"] = FlowMap(zip(_Std.model_fields, map(_flow, parts), strict=True))
    return entry


def _volume_entry(volume: Volume) -> dict[str, Any]:
    if volume.is_box:
        return FlowMap(low=Flow(volume.low), high=Flow(volume.high))
    return {"points": [Flow(point) for point in volume.points]}


def _narrowed(covariance: RigCovariance, rig: CameraRig) -> RigCovariance:
    """Leave out coefficients that no camera has: some of a wider rig."""
    cameras, kept = rig.num_cameras, len(parameter_names(rig.lens_models))
    matrix = covariance.matrix
    if matrix is not None and kept < covariance.std.shape[1]:
        blocks = matrix.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
        matrix = blocks[:, :kept, :, :kept].flatten(2).flatten(0, 1)
    return RigCovariance(covariance.std[:, :kept], matrix, covariance.reference_camera)


def _covariance_entry(covariance: RigCovariance, rig: CameraRig, full: bool, where: str | Path) -> dict[str, Any]:
    entry: dict[str, Any] = {}
    if covariance.reference_camera is not None:
        entry["reference_camera"] = covariance.reference_camera
    entry["parameters"] = Flow(parameter_names(rig.lens_models))
    if full:
        if covariance.matrix is None:
            raise InputError(f"{where}: not written: found no covariance matrix, expected one with full=True")
        entry["matrix"] = [Flow(row) for row in covariance.matrix.double().tolist()]
    return entry


def _std_tensor(content: _RigFile) -> Tensor:
    """Collect the standard deviations of all cameras: (C, K)."""
    rows = [[v for part in camera.std.model_dump().values() for v in part] for camera in content.cameras if camera.std]
    width = len(parameter_names([camera.model for camera in content.cameras]))
    return torch.tensor([[*row, *[0.0] * (width - len(row))] for row in rows], dtype=torch.float64)


def _check_covariance(covariance: _Covariance, cameras: list[_Camera], std: Tensor) -> None:
    names, expected = [camera.name for camera in cameras], parameter_names([camera.model for camera in cameras])
    if covariance.reference_camera is not None and covariance.reference_camera not in names:
        found = covariance.reference_camera
        raise ValueError(f"covariance: found reference_camera {found}, expected one of {listed(names)}")
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


def _flow(values: Tensor) -> Flow:
    return Flow(values.detach().double().tolist())
