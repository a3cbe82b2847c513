"""OpenCV 5's multi-view calibration: what `calibrateMultiview` and its application save. X_i = R_i X_0 + T_i.

Its documentation says rotation matrices and files hold rotation vectors: both are read. The unit is the board's, which
is not in the file.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.file_storage import is_matrix, key_place, matrix, merge_storages, storage_text
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import (
    camera_matrix,
    coefficients,
    image_size,
    numbers,
    rotation,
    texts,
    vector_from_rotation,
)

TITLE = "OpenCV multi-view calibration (FileStorage)"
PINHOLE, FISHEYE = 0, 1


def _recognizes(source: Source) -> bool:
    values = merge_storages(source)
    return all(is_matrix(values.get(key)) for key in ("Rs", "Ts", "Ks"))


def _read(source: Source) -> ForeignRig:
    values = merge_storages(source)
    matrices = numbers(values["Ks"], "Ks")
    count = len(matrices) // 9
    if count == 0 or len(matrices) != 9 * count:
        raise FormatError(f"Ks: found {len(matrices)} numbers, expected nine for each camera")
    shifts = _rows(values["Ts"], count, "Ts")
    turns = _rows(values["Rs"], count, "Rs")
    distortions = _rows(values["distortions"], count, "distortions") if "distortions" in values else [[]] * count
    sizes = _rows(values["image_sizes"], count, "image_sizes") if "image_sizes" in values else [None] * count
    models = [int(model) for model in numbers(values.get("models", [0] * count), "models")]
    names = texts(values.get("cam_ids", list(range(count))), "cam_ids")
    if len(models) != count or len(names) != count:
        raise FormatError(f"found {count} camera matrices, {len(models)} models and {len(names)} cam_ids")
    cameras = []
    for number, name in enumerate(names):
        if models[number] not in (PINHOLE, FISHEYE):
            raise FormatError(f"camera {name}: found the model {models[number]}, expected 0 (pinhole) or 1 (fisheye)")
        focal, centre, skew = camera_matrix(matrices[9 * number : 9 * number + 9], f"camera {name}: K")
        fisheye = models[number] == FISHEYE
        ks = distortions[number][:4] if fisheye else distortions[number]
        lens = Lens(focal, centre, coefficients(ks, f"camera {name}"), "fisheye" if fisheye else "opencv", skew)
        size = image_size(sizes[number], f"camera {name}: image size")
        turned = rotation(turns[number], f"camera {name}: R")
        parts = {
            "Ks": (9, places.camera_matrix),
            "Ts": (3, places.translation),
            "Rs": (len(turns[number]), places.rotation_like(turns[number])),
            "distortions": (len(distortions[number]), places.coefficients(len(ks))),
        }
        found = tuple(
            Place(*key_place(source, key), of, first=width * number)
            for key, (width, of) in parts.items() if key in values
        )  # fmt: skip
        cameras.append(ForeignCamera(name, lens, size, turned, np.array(shifts[number]), found))
    return ForeignRig(FORMAT.name, tuple(cameras), None, f"camera {names[0]}", root=0)


def _write(rig: ForeignRig) -> Files:
    count = 14 if any(camera.lens.length > 5 for camera in rig.cameras) else 5
    content: dict[str, Any] = {
        "Rs": np.array([vector_from_rotation(camera.rotation) for camera in rig.cameras]),
        "Ts": np.array([camera.translation for camera in rig.cameras]),
        "Ks": np.array([camera.lens.matrix.ravel() for camera in rig.cameras]),
        "distortions": np.array([camera.lens.pad(count) for camera in rig.cameras]),
        "models": np.array([[FISHEYE if camera.lens.model == "fisheye" else PINHOLE] for camera in rig.cameras]),
        "image_sizes": np.array([camera.image_size for camera in rig.cameras]),
        "cam_ids": rig.names,
    }
    return {"": storage_text(content)}


def _rows(value: Any, count: int, what: str) -> list[list[float]]:
    """As many numbers for each camera."""
    found = matrix(value, what).ravel()
    if not len(found) or len(found) % count:
        raise FormatError(f"{what}: found {len(found)} numbers for {count} cameras")
    return [row.tolist() for row in found.reshape(count, -1)]


FORMAT = Format(
    "opencv-multiview", TITLE, _recognizes, _read, _write, Holds((5, 14), fisheye=True), unit="m", from_first=True
)
