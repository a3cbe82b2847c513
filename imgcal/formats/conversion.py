"""From another tool's rig to a `CameraRig` and back: units, image sizes, and lenses, exact where they can be."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from imgcal.errors import InputError, RefusedError
from imgcal.formats.fitting import Fit, Holds, fit_lens
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig
from imgcal.formats.lens import Lens
from imgcal.formats.limits import LIMIT
from imgcal.geometry import LENS_MODELS, RigidTransform, lens_label, lens_width
from imgcal.io import RigCovariance
from imgcal.messages import name_cameras, plural, shorten
from imgcal.types import CameraRig, check_rig

BROWN, RATIONAL, FISHEYE = "brown_conrady", "rational", "equidistant"
NATIVE = Holds(tuple(len(LENS_MODELS[name].coefficients) for name in (BROWN, RATIONAL)), fisheye=True)
"""Lenses of a `CameraRig`."""

UNITS = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "inch": 25.4, "in": 25.4}
LENGTH = re.compile(r"([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)?\s*([a-z]+)")


@dataclass(frozen=True)
class StorableRig:
    """A rig whose lenses a target format can store."""

    rig: ForeignRig
    fits: tuple[Fit, ...]  # one a camera


def millimetres(unit: str, what: str = "--unit") -> float:
    """Read a unit, or the length of one unit of a file (`417.2mm`).

    Raises:
        InputError: it is neither.

    Examples:
        >>> millimetres("m"), millimetres("12.5 mm")
        (1000.0, 12.5)
    """
    match = LENGTH.fullmatch(unit.strip())
    if match is None or match[2] not in UNITS:
        expected = f"{', '.join(UNITS)}, or the length of one unit of the file, such as 417.2mm"
        raise InputError(f"{what}: found {shorten(unit)!r}, expected {expected}")
    factor = float(match[1] or 1.0) * UNITS[match[2]]
    if not 1e-9 <= factor <= 1e9:
        raise InputError(f"{what}: found {shorten(unit)!r}, expected a length between 1e-9 and 1e9 mm")
    return factor


def in_millimetres(
    rig: ForeignRig, where: str, unit: str | None = None, distance: tuple[str, str, float] | None = None
) -> ForeignRig:
    """Convert a rig's lengths to millimetres.

    Args:
        rig: as it was read.
        where: what errors begin with.
        unit: of the file, which counts before what the format says; None = what the format says.
        distance: two cameras and how many millimetres they are apart, instead of a unit.

    Raises:
        InputError: neither the file nor the caller says what the unit is: it is never guessed.
    """
    if distance is not None:
        if unit is not None:
            raise InputError("found both --distance and --unit, expected one of them")
        return rig.scale(_factor(rig, distance), "mm")
    stated = unit if unit is not None else rig.unit
    if stated is None and len(rig.cameras) > 1:
        hint = f" ({rig.unit_hint})" if rig.unit_hint else ""
        raise InputError(
            f"{where}: the file does not state its unit of length{hint}: give imgcal convert --unit mm, cm, m, inch, "
            "or the length of one unit (--unit 417.2mm), or the distance between two cameras (--distance NAME NAME "
            'MM); in Python load_rig(..., unit="mm")'
        )
    return rig.scale(millimetres(stated or "mm"), "mm")


def _factor(rig: ForeignRig, distance: tuple[str, str, float]) -> float:
    *names, length = distance
    by_name = {camera.name: camera for camera in rig.cameras}
    unknown = [name for name in names if name not in by_name]
    if unknown or names[0] == names[1] or not 1e-3 <= length <= 1e7:
        raise InputError(
            f"--distance: found {' '.join(map(shorten, names))} {length:g}, expected two of the "
            f"{name_cameras(list(by_name))} and millimetres"
        )
    apart = float(np.linalg.norm(by_name[names[0]].centre - by_name[names[1]].centre))
    if apart < 1e-12:
        raise InputError(f"--distance: {names[0]} and {names[1]} are at the same place in the file")
    return length / apart


def fill_image_sizes(rig: ForeignRig, where: str, sizes: Mapping[str, tuple[int, int]]) -> ForeignRig:
    """Fill in the image sizes that a file does not have.

    Args:
        rig: as it was read.
        where: what errors begin with.
        sizes: by camera; "" stands for all.

    Raises:
        InputError: a size is still missing, or it is another than the file says.
    """
    unknown = [name for name in sizes if name and name not in rig.names]
    if unknown:
        raise InputError(
            f"--image-size: found {name_cameras(unknown)}, expected cameras of {where}: {name_cameras(rig.names)}"
        )
    cameras, missing = [], []
    for camera in rig.cameras:
        given = sizes.get(camera.name, sizes.get(""))
        if camera.image_size is None and given is None:
            missing.append(camera.name)
        elif camera.image_size is not None and given is not None and camera.image_size != given:
            (width, height), (w, h) = given, camera.image_size
            raise InputError(f"{where}: camera {camera.name}: found {w}x{h} pixels, --image-size says {width}x{height}")
        cameras.append(replace(camera, image_size=camera.image_size or given))
    if missing:
        raise InputError(
            f"{where}: {name_cameras(missing)}: the file does not state the size of the images: give imgcal convert "
            f"--image-size 1280x720 for all cameras, or --image-size {missing[0]}=1280x720; in Python load_rig(..., "
            "image_size=(1280, 720))"
        )
    return replace(rig, cameras=tuple(cameras))


def fit_to_target(rig: ForeignRig, holds: Holds, title: str, limit: float = LIMIT) -> StorableRig:
    """Express every lens in a model of the target.

    Raises:
        RefusedError: the target's models are farther than `limit` pixels from a lens, somewhere in its image.
    """
    fits = []
    for camera in rig.cameras:
        assert camera.image_size is not None
        fit = fit_lens(camera.lens, camera.image_size, holds)
        if not fit.worst <= limit:
            raise RefusedError(
                lens_refusal(camera, fit, title, "the nearest lens", limit),
                command="--fit-limit allows more",
                python="`fit_limit` allows more",
            )
        fits.append(fit)
    cameras = tuple(replace(camera, lens=fit.lens) for camera, fit in zip(rig.cameras, fits, strict=True))
    return StorableRig(replace(rig, cameras=cameras), tuple(fits))


def lens_refusal(camera: ForeignCamera, fit: Fit, title: str, nearest: str, limit: float) -> str:
    """Explain that no lens of the target comes near enough; `nearest` names the one that comes nearest."""
    off = f"by {fit.worst:.3g} px" if np.isfinite(fit.worst) else "by any amount in a part of the image"
    return (
        f"camera {camera.name}: {title} cannot express its lens ({describe_lens(camera.lens)}): {nearest} is "
        f"off {off}, more than the limit of {limit:g} px"
    )


def fit_note(camera: ForeignCamera, fit: Fit) -> str:
    """Describe how well a fitted lens replaces the camera's own."""
    return (
        f"camera {camera.name}: {describe_lens(camera.lens)} -> {describe_lens(fit.lens)}, fitted over the image: "
        f"worst {fit.worst:.2g} px, RMS {fit.rms:.2g} px"
    )


def describe_lens(lens: Lens) -> str:
    """Describe a lens in a few words."""
    kinds = {"opencv": "OpenCV", "fisheye": "fisheye, equidistant", "to_ideal": "image to ideal"}
    skew = ", skewed" if lens.skew else ""
    return f"{kinds[lens.model]}, {plural(lens.length, 'coefficient')}{skew}"


def to_camera_rig(rig: ForeignRig, name: str) -> CameraRig:
    """Make a `CameraRig` of a rig in millimetres whose lenses it can store (`fit_to_target`); `name` is the default.

    Raises:
        InputError: a value that no rig has.
    """

    def column(values: list[Any]) -> torch.Tensor:
        return torch.tensor(np.array(values), dtype=torch.float64)

    models = [_model_name(camera.lens) for camera in rig.cameras] if rig.own is None else rig.own.lens_models
    width = lens_width(lens_label(models))
    values: dict[str, Any] = {
        "focal_length": column([camera.lens.focal_length for camera in rig.cameras]),
        "principal_point": column([camera.lens.principal_point for camera in rig.cameras]),
        "distortion": column([camera.lens.pad(width) for camera in rig.cameras]),
        "lens_model": lens_label(models),
        "cam_from_rig": RigidTransform(
            column([camera.rotation for camera in rig.cameras]), column([camera.translation for camera in rig.cameras])
        ),
        "image_size": torch.tensor([camera.image_size for camera in rig.cameras]),
        "camera_names": tuple(rig.names),
    }
    made = CameraRig(**values, name=name) if rig.own is None else replace(rig.own, **values)
    check_rig(made)
    return made


def _model_name(lens: Lens) -> str:
    """The name that a lens has in a rig file: the plainest model that says it."""
    if lens.model == "fisheye":
        return FISHEYE
    return BROWN if lens.length <= NATIVE.opencv[0] else RATIONAL


def from_camera_rig(rig: CameraRig, covariance: RigCovariance | None = None) -> ForeignRig:
    """Take a rig of our own for one of another tool: millimetres, in its own frame."""
    cameras = []
    for number, name in enumerate(rig.camera_names):
        fx, fy = rig.focal_length[number].tolist()
        cx, cy = rig.principal_point[number].tolist()
        model = rig.lens_models[number]
        coefficients = rig.distortion[number, : len(LENS_MODELS[model].coefficients)].tolist()
        lens = Lens((fx, fy), (cx, cy), tuple(coefficients), "fisheye" if model == FISHEYE else "opencv")
        width, height = (int(side) for side in rig.image_size[number].tolist())
        cameras.append(
            ForeignCamera(
                name,
                lens,
                (width, height),
                rig.cam_from_rig.rotation[number].double().numpy(),
                rig.cam_from_rig.translation[number].double().numpy(),
            )
        )
    return ForeignRig("imgcal", tuple(cameras), "mm", "the rig file's", covariance=covariance, own=rig)
