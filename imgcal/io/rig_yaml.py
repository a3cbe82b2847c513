"""Reading and writing rig files: YAML, `format: imgcal-rig/1`; `rig_schema.py` defines what they may hold."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import (
    LENS_MODELS,
    RigidTransform,
    lens_label,
    lens_width,
    rotation_from_vector,
    vector_from_rotation,
)
from imgcal.io.atomic import write_text
from imgcal.io.names import find_file, is_file_name, title_from_name
from imgcal.io.posterior_file import read_posterior, write_posterior
from imgcal.io.rig_schema import FORMAT, CameraEntry, RigFile, Std, collect_std
from imgcal.io.validation import validate
from imgcal.io.yaml_file import Flow, FlowMap, read_yaml, record_from_yaml, yaml_text
from imgcal.types import CameraRig, ConvexVolume, DriftRate, RigPosterior, RigPrior, parameter_names

POSTERIOR = ".posterior.safetensors"
"""Behind the stem of a rig's file: where all that its calibration knows is kept."""


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


def read_rig(path: str | Path) -> CameraRig:
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
    rig = _parse_rig(content, title_from_name(path))
    if content.posterior is None or not is_file_name(content.posterior):
        return rig
    beside = path.with_name(content.posterior)
    return replace(rig, posterior=partial(read_posterior, beside, rig)) if beside.is_file() else rig


def rig_from_text(text: str, where: str) -> CameraRig:
    """Read a rig from the text of its file, the result of `rig_text`; errors and its name begin with `where`.

    Raises:
        InputError: as `read_rig`.
    """
    content = record_from_yaml(text.encode(errors="replace"), where, RigFile, FORMAT)
    return _parse_rig(content, where)


def load_rig_covariance(path: str | Path) -> RigCovariance | None:
    """Read the uncertainty in a rig file; None if it has none. Arguments and errors as for `read_rig`."""
    content, _ = _read(path)
    if content.covariance is None:
        return None
    reference_camera = content.covariance.reference_camera
    if content.covariance.matrix is None:
        return RigCovariance(collect_std(content), None, reference_camera)
    matrix = torch.tensor(content.covariance.matrix, dtype=torch.float64)
    return RigCovariance.from_matrix(matrix, len(content.cameras), reference_camera)


def save_rig(
    rig: CameraRig,
    path: str | Path,
    covariance: RigCovariance | None = None,
    full: bool = False,
    posterior: RigPosterior | None = None,
) -> None:
    """Write a rig in one step; every number in its shortest exact form.

    Args:
        rig: without batch axes; any floating-point type.
        path: the file to write.
        covariance: one standard deviation of every parameter goes to its camera, to 6 digits; None = not written.
        full: write the whole covariance matrix, too (half a megabyte for 10 cameras).
        posterior: written to a file beside it, from which `read_rig` attaches it to the rig; None = not written.

    Raises:
        InputError: the file cannot be written, or the rig could not be read again (NaN, for example).

    Examples:
        >>> import imgcal
        >>> imgcal.save_rig(imgcal.load_rig("T4").select([0, 1]), "pair.yaml")
        >>> imgcal.load_rig("pair.yaml").camera_names
        ('cam01', 'cam02')
    """
    path = Path(path)
    beside = None if posterior is None else f"{path.stem}{POSTERIOR}"
    text = rig_text(rig, path, covariance, full, beside)
    if posterior is not None and beside is not None:
        write_posterior(path.with_name(beside), posterior)
    write_text(path, text)


def rig_text(
    rig: CameraRig,
    where: str | Path = "rig",
    covariance: RigCovariance | None = None,
    full: bool = False,
    posterior: str | None = None,
) -> str:
    """Make the text that `save_rig` writes; errors begin with `where`, and `posterior` names the file beside it.

    Raises:
        InputError: the rig has batch axes, or `full` is given without a covariance matrix.

    Examples:
        >>> import imgcal
        >>> rig_text(imgcal.load_rig("T4")).splitlines()[:2]
        ['format: imgcal-rig/1', 'name: T4']
    """
    if rig.batch_shape:
        raise InputError(f"{where}: found a batch of rigs of shape {tuple(rig.batch_shape)}, expected one rig")
    if covariance is not None:
        covariance = _narrow(covariance, rig)
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
    if posterior is not None:
        content["posterior"] = posterior
    validate(content, RigFile, f"{where}: not written")
    return yaml_text(content)


def _read(path: str | Path) -> tuple[RigFile, Path]:
    path = find_file(path, "rigs", ".yaml")
    return read_yaml(path, RigFile, FORMAT), path


def _parse_rig(content: RigFile, name: str) -> CameraRig:
    """The rig of a file; `name` is used if the file has none."""
    cameras = content.cameras
    models = lens_label([camera.model for camera in cameras])
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
        **({"model": model.name} if model.name != CameraEntry.model_fields["model"].default else {}),
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
        entry["std"] = FlowMap(zip(Std.model_fields, map(_flow, parts), strict=True))
    return entry


def _volume_entry(volume: ConvexVolume) -> dict[str, Any]:
    if volume.is_box:
        return FlowMap(low=Flow(volume.low), high=Flow(volume.high))
    return {"points": [Flow(point) for point in volume.points]}


def _narrow(covariance: RigCovariance, rig: CameraRig) -> RigCovariance:
    """Leave out coefficients that no camera of the rig has."""
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


def _flow(values: Tensor) -> Flow:
    return Flow(values.detach().double().tolist())
