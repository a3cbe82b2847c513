"""PyMVG camera system (JSON): X_cam = Q X + translation, projected by P, distorted by K and D; unit of the user.

P may differ from K, and R from the identity: the image is then rectified in between, which is another pose of the same
camera.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import array, camera_matrix, coefficients, image_size, mapping, rotation, text

TITLE = "PyMVG camera system"


def _system(source: Source) -> tuple[Path, list[Any]] | None:
    for document, values in source.mappings:
        if isinstance(values.get("camera_system"), list):
            return document.path, list(values["camera_system"])
    return None


def _read(source: Source) -> ForeignRig:
    found = _system(source)
    assert found is not None
    path, system = found
    cameras = tuple(
        _camera(mapping(entry, f"camera {place}"), place, path) for place, entry in enumerate(system, start=1)
    )
    if not cameras:
        raise FormatError("found no camera in it")
    return ForeignRig(FORMAT.name, cameras, None, "the file's world")


def _camera(entry: dict[str, Any], place: int, path: Path) -> ForeignCamera:
    name = text(entry.get("name", str(place)), f"camera {place}: name")
    if entry.get("Q") is None or entry.get("translation") is None:
        raise FormatError(f"{name}: no pose (Q, translation)")
    focal, centre, skew = camera_matrix(entry.get("K"), f"{name}: K")
    lens = Lens(focal, centre, coefficients(entry.get("D"), f"{name}: D"), "opencv", skew)
    turned, translation = rotation(entry["Q"], f"{name}: Q"), array(entry["translation"], (3,), f"{name}: translation")
    p = array(entry["P"], (3, 4), f"{name}: P") if entry.get("P") is not None else None
    shift, rectified = np.zeros(3), np.eye(3)
    if p is not None:
        if p[0, 0] <= 0 or p[1, 1] <= 0 or abs(p[0, 1]) > 1e-9 * p[0, 0] or not np.allclose(p[2], [0, 0, 1, 0]):
            raise FormatError(f"{name}: P: found {p.tolist()}, expected [fx 0 cx tx; 0 fy cy ty; 0 0 1 0]")
        shift = np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0])
        translation = translation + shift
    if entry.get("R") is not None:
        rectified = rotation(entry["R"], f"{name}: R")
        turned, translation = rectified.T @ turned, rectified.T @ translation
    size = image_size([entry.get("width") or 0, entry.get("height") or 0], f"{name}: width, height")

    def projection(camera: ForeignCamera) -> list[float]:
        return np.column_stack((camera.lens.matrix, camera.lens.matrix @ shift)).ravel().tolist()

    values: dict[str, places.Numbers] = {
        "K": places.camera_matrix,
        "D": places.coefficients(len(lens.coefficients)),
        "Q": lambda camera: (rectified @ camera.rotation).ravel().tolist(),
        "translation": lambda camera: (rectified @ camera.translation - shift).tolist(),
    }
    if p is not None and np.allclose(p[:, :3], lens.matrix, rtol=1e-9):
        values["P"] = projection
    keys = ("camera_system", place - 1)
    found = tuple(Place(path, (*keys, key), of) for key, of in values.items())
    return ForeignCamera(name, lens, size, turned, translation, found)


def _write(rig: ForeignRig) -> Files:
    system = []
    for camera in rig.cameras:
        width, height = camera.image_size or (0, 0)
        matrix = camera.lens.matrix
        system.append(
            {
                "name": camera.name,
                "width": width,
                "height": height,
                "P": np.concatenate((matrix, np.zeros((3, 1))), axis=1).tolist(),
                "K": matrix.tolist(),
                "D": camera.lens.pad(5),
                "R": np.eye(3).tolist(),
                "Q": camera.rotation.tolist(),
                "translation": camera.translation.tolist(),
            }
        )
    return {"": (json.dumps({"__pymvg_file_version__": "1.0", "camera_system": system}, indent=2) + "\n").encode()}


FORMAT = Format("pymvg", TITLE, lambda source: _system(source) is not None, _read, _write, Holds((5,)), unit="m")
