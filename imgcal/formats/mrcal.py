"""mrcal `.cameramodel`: a Python literal, one file a camera; those of a set share their reference frame.

`extrinsics` (older) and `rt_cam_ref` (newer) are the same: X_cam = R X_ref + t, in whatever unit the user had.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import (
    array,
    focal_length,
    image_size,
    numbers,
    rotation_from_vector,
    text,
    vector_from_rotation,
)

TITLE = "mrcal cameramodel"
COUNTS = {"PINHOLE": 0, "NONE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
REASONS = {
    "SPLINED": "a splined lens, which no other format here can express",
    "CAHVOR": "a CAHVOR lens, which no other format here can express",
    "STEREOGRAPHIC": "a stereographic projection, which no other format here can express",
    "LONLAT": "a panorama (longitude, latitude), not a lens", "LATLON": "a panorama (latitude, longitude), not a lens",
}  # fmt: skip


def _is_model(values: dict[str, Any]) -> bool:
    return ("lensmodel" in values or "distortion_model" in values) and "intrinsics" in values and (
        "extrinsics" in values or "rt_cam_ref" in values or "imagersize" in values
    )  # fmt: skip


def _read(source: Source) -> ForeignRig:
    cameras = [_camera(document.path, values) for document, values in source.mappings if _is_model(values)]
    notes = []
    if len(cameras) == 1:
        notes.append("this is one camera; the others are in files of their own: give all, or their folder")
    return ForeignRig(FORMAT.name, tuple(cameras), None, "mrcal's reference frame", tuple(notes))


def _camera(path: Path, values: dict[str, Any]) -> ForeignCamera:
    name = path.stem
    model = text(values.get("lensmodel", values.get("distortion_model")), f"{name}: lensmodel")
    short = model.removeprefix("LENSMODEL_").removeprefix("DISTORTION_")
    for start, reason in REASONS.items():
        if short.startswith(start):
            raise FormatError(f"{name}: {model}: {reason}")
    if short not in COUNTS:
        raise FormatError(f"{name}: found {model}, expected one of LENSMODEL_{', '.join(COUNTS)}")
    found = numbers(values["intrinsics"], f"{name}: intrinsics")
    if len(found) != 4 + COUNTS[short]:
        raise FormatError(f"{name}: found {len(found)} intrinsics, {model} has {4 + COUNTS[short]}")
    lens = Lens(focal_length(found[0], found[1], name), (found[2], found[3]), tuple(found[4:]))
    pose = values.get("rt_cam_ref", values.get("extrinsics"))
    if pose is None:
        raise FormatError(f"{name}: no extrinsics (rt_cam_ref)")
    six = array(pose, (6,), f"{name}: extrinsics")
    size = image_size(values.get("imagersize"), f"{name}: imagersize")
    turned = places.rotation_like(six[:3].tolist())
    count = COUNTS[short]
    where = [Place(path, ("intrinsics",), lambda one: [*places.focal_and_centre(one), *one.lens.pad(count)])]
    where += [
        Place(path, (key,), lambda one: [*turned(one), *places.translation(one)])
        for key in ("rt_cam_ref", "extrinsics") if values.get(key) is not None
    ]  # fmt: skip
    return ForeignCamera(name, lens, size, rotation_from_vector(six[:3]), six[3:], tuple(where))


def _write(rig: ForeignRig) -> Files:
    files = {}
    for camera in rig.cameras:
        count = next(count for count in (0, 4, 5, 8, 12) if camera.lens.length <= count)
        model = "PINHOLE" if count == 0 else f"OPENCV{count}"
        lens = camera.lens
        intrinsics = [*lens.focal_length, *lens.principal_point, *lens.pad(count)]
        pose = np.concatenate((vector_from_rotation(camera.rotation), camera.translation)).tolist()
        files[f"{camera.name}.cameramodel"] = (
            "{\n"
            f"    'lensmodel':  'LENSMODEL_{model}',\n\n"
            "    # fx, fy, cx, cy, then OpenCV's coefficients\n"
            f"    'intrinsics': {intrinsics},\n\n"
            "    # rt_cam_ref: rotation vector and translation of camera from reference\n"
            f"    'extrinsics': {pose},\n\n"
            f"    'imagersize': {list(camera.image_size or ())}\n"
            "}\n"
        ).encode()
    return files


FORMAT = Format(
    "mrcal", TITLE, lambda source: any(_is_model(values) for _, values in source.mappings), _read, _write,
    Holds((4, 5, 8, 12)), unit="m",
)  # fmt: skip
