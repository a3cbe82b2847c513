"""Compare two rigs or two objects, ignoring the rounding of numbers in text files."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from imgcal.types.calibration_object import CalibrationObject
from imgcal.types.rig import CameraRig

# Relative tolerance, for mm, pixels and rad alike: values this close are the same, since both were read from text.
SAME = 1e-6


def rig_difference(rig: CameraRig, expected: CameraRig) -> str | None:
    """Name the first camera and value in which a rig differs from the expected one; None = they are the same.

    Examples:
        >>> import imgcal
        >>> from dataclasses import replace
        >>> rig = imgcal.load_rig("T4")
        >>> rig_difference(replace(rig, focal_length=rig.focal_length + 1), rig).partition(":")[0]
        'focal length of cam01'
    """
    if rig.camera_names != expected.camera_names:
        return _describe_difference("cameras", ", ".join(rig.camera_names), ", ".join(expected.camera_names))
    for camera, lens, known in zip(rig.camera_names, rig.lens_models, expected.lens_models, strict=True):
        if lens != known:
            return _describe_difference(f"lens model of {camera}", lens, known)
    values: dict[str, Callable[[CameraRig], Tensor]] = {
        "image size": lambda r: r.image_size,
        "focal length": lambda r: r.focal_length,
        "principal point": lambda r: r.principal_point,
        "distortion": lambda r: r.distortion,
        "position": lambda r: r.positions,
        "rotation": lambda r: r.cam_from_rig.rotation.flatten(-2),
    }
    for what, value in values.items():
        found, wanted = value(rig).double().cpu(), value(expected).double().cpu()
        apart = ~torch.isclose(found, wanted, rtol=SAME, atol=SAME * float(wanted.abs().max().clamp_min(1)))
        for camera in apart.any(-1).nonzero().flatten().tolist():
            return _describe_difference(
                f"{what} of {rig.camera_names[camera]}", _numbers(found[camera]), _numbers(wanted[camera])
            )
    return None


def object_difference(obj: CalibrationObject, expected: CalibrationObject) -> str | None:
    """Name the first fiducial whose position or radius differs from the expected one; None = they are the same."""
    if obj.num_fiducials != expected.num_fiducials:
        return f"found {obj.num_fiducials} fiducials, expected {expected.num_fiducials}"
    columns = [
        (o.points.double(), o.points.new_zeros(o.num_fiducials) if o.radius is None else o.radius)
        for o in (obj, expected)
    ]
    found, known = (torch.cat((points, radius.to(points)[:, None]), 1).cpu() for points, radius in columns)
    apart = (found - known).abs().amax(1) > SAME * max(expected.size, 1.0)
    if not apart.any():
        return None
    row = int(apart.nonzero()[0])
    return _describe_difference(f"fiducial {row + 1}", f"x, y, z, radius {_numbers(found[row])}", _numbers(known[row]))


def _describe_difference(what: str, found: str, expected: str) -> str:
    return f"{what}: found {found}, expected {expected}"


def _numbers(values: Tensor) -> str:
    return ", ".join(f"{value:.8g}" for value in values.tolist())
