"""Whether a network was trained for what it is to say, and the rig and the object that are there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.networks.config import NetworkSpec
from imgcal.types import CalibrationObject, CameraRig

# Two factory values that agree to this (relative; mm, pixels and rad alike) are the same: both came through text.
SAME = 1e-6


def check_rig(path: str | Path, trained: CameraRig, rig: CameraRig) -> None:
    """Compare the factory values of two rigs.

    Raises:
        InputError: they differ; names the first camera and value that do.
    """

    def refuse(what: str, found: str, expected: str) -> None:
        before = f"{path}: trained for another rig than {rig.name} ({trained.name})"
        raise InputError(f"{before}: {what}: found {found}, expected {expected}")

    if rig.camera_names != trained.camera_names:
        refuse("cameras", ", ".join(rig.camera_names), ", ".join(trained.camera_names))
    for camera, lens, known in zip(rig.camera_names, rig.lens_models, trained.lens_models, strict=True):
        if lens != known:
            refuse(f"lens model of {camera}", lens, known)
    values: dict[str, Callable[[CameraRig], Tensor]] = {
        "image size": lambda r: r.image_size,
        "focal length": lambda r: r.focal_length,
        "principal point": lambda r: r.principal_point,
        "distortion": lambda r: r.distortion,
        "position": lambda r: r.positions,
        "rotation": lambda r: r.cam_from_rig.rotation.flatten(-2),
    }
    for what, value in values.items():
        found, expected = value(rig).double().cpu(), value(trained).double().cpu()
        apart = ~torch.isclose(found, expected, rtol=SAME, atol=SAME * float(expected.abs().max().clamp_min(1)))
        for camera in apart.any(-1).nonzero().flatten().tolist():
            place = f"{what} of {rig.camera_names[camera]}"
            refuse(place, _numbers(found[camera]), _numbers(expected[camera]))


def of_positions(experiment: NetworkSpec) -> bool:
    """Tell whether a training was one of positions, in which the trunk has learnt nothing."""
    return getattr(experiment, "task", None) == "positions"


def check_says_rigs(path: str | Path, experiment: NetworkSpec) -> None:
    """Refuse a network that finds positions and has not learnt what a rig is.

    Raises:
        InputError: it was trained by the task of positions.
    """
    if of_positions(experiment):
        raise InputError(
            f"{path}: found a training of positions, whose trunk has learnt nothing; expected one of rigs, which takes "
            "it by `training.init_from`"
        )


def check_object(path: str | Path, trained: CalibrationObject, obj: CalibrationObject) -> None:
    """Compare the fiducials of two objects, their radii included.

    Raises:
        InputError: they differ; names the first fiducial that does.
    """
    before = f"{path}: trained for another object than {obj.name} ({trained.name})"
    if obj.num_fiducials != trained.num_fiducials:
        raise InputError(f"{before}: found {obj.num_fiducials} fiducials, expected {trained.num_fiducials}")
    columns = [
        (o.points.double(), o.points.new_zeros(o.num_fiducials) if o.radius is None else o.radius)
        for o in (obj, trained)
    ]
    found, expected = (torch.cat((points, radius.to(points)[:, None]), 1).cpu() for points, radius in columns)
    apart = (found - expected).abs().amax(1) > SAME * max(trained.size, 1.0)
    if apart.any():
        row = int(apart.nonzero()[0])
        values = f"found x, y, z, radius {_numbers(found[row])}, expected {_numbers(expected[row])}"
        raise InputError(f"{before}: fiducial {row + 1}: {values}")


def _numbers(values: Tensor) -> str:
    return ", ".join(f"{value:.8g}" for value in values.tolist())
