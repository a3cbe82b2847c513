"""EasyMocap `intri.yml` and `extri.yml`: OpenCV FileStorages with K_<n>, dist_<n> and Rot_<n>, R_<n>, T_<n>; metres."""

from __future__ import annotations

from typing import Any

from imgcal.formats import places
from imgcal.formats.file_storage import key_place, merge_storages, storage_text
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import (
    array,
    camera_matrix,
    coefficients,
    image_size,
    number,
    numbers,
    rotation,
    texts,
    vector_from_rotation,
)
from imgcal.io import natural_key
from imgcal.messages import name_cameras

TITLE = "EasyMocap intri.yml and extri.yml"


def _recognizes(source: Source) -> bool:
    values = merge_storages(source)
    inside, outside = set(_find_names(values, "K_")), set(_find_names(values, "Rot_", "R_"))
    return bool(inside & outside or ((inside or outside) and isinstance(values.get("names"), list)))


def _find_names(values: dict[str, Any], *prefixes: str) -> list[str]:
    """The cameras of keys with a prefix."""
    found = [key[len(p) :] for p in prefixes for key in values if key.startswith(p) and isinstance(values[key], dict)]
    return list(dict.fromkeys(found))


def _read(source: Source) -> ForeignRig:
    values = merge_storages(source)
    inside, outside = _find_names(values, "K_"), [n for n in _find_names(values, "Rot_", "R_") if f"T_{n}" in values]
    if not outside:
        raise FormatError("found only intri.yml: give extri.yml as well, or the folder of both")
    if not inside:
        raise FormatError("found only extri.yml: give intri.yml as well, or the folder of both")
    listed = texts(values["names"], "names") if isinstance(values.get("names"), list) else []
    order = sorted(set(inside) & set(outside), key=natural_key)
    order.sort(key=lambda name: listed.index(name) if name in listed else len(listed))
    notes = ["metres, as EasyMocap has them"]
    if lost := sorted(set(inside) ^ set(outside)):
        notes.append(f"{name_cameras(lost)}: left out, not in both files")
    if not order:
        raise FormatError(
            f"no camera is in both files: intrinsics of {name_cameras(inside)}, poses of {name_cameras(outside)}"
        )
    cameras = []
    for name in order:
        focal, centre, skew = camera_matrix(values[f"K_{name}"], f"K_{name}")
        ks = values.get(f"dist_{name}", values.get(f"D_{name}"))
        lens = Lens(focal, centre, coefficients(ks, f"dist_{name}"), "opencv", skew)
        size = None
        if f"H_{name}" in values and f"W_{name}" in values:
            pair = [number(_scalar(values[f"{side}_{name}"]), f"{side}_{name}") for side in "WH"]
            size = image_size(pair, f"W_{name}, H_{name}")
        turn = values.get(f"Rot_{name}", values.get(f"R_{name}"))
        moved = array(values[f"T_{name}"], (3,), f"T_{name}")
        count = len(lens.coefficients)
        parts: dict[str, places.Numbers] = {
            f"K_{name}": places.camera_matrix, f"T_{name}": places.translation,
            f"dist_{name}" if f"dist_{name}" in values else f"D_{name}": places.coefficients(count),
        }  # fmt: skip
        for key in (f"Rot_{name}", f"R_{name}"):
            if key in values:
                parts[key] = places.rotation_like(numbers(values[key], key))
        found = tuple(Place(*key_place(source, key), of) for key, of in parts.items() if key in values)
        cameras.append(ForeignCamera(name, lens, size, rotation(turn, f"Rot_{name}"), moved, found))
    return ForeignRig(FORMAT.name, tuple(cameras), "m", "the file's world", tuple(notes))


def _scalar(value: Any) -> Any:
    """A number, also where it was written as a matrix of one."""
    data = value.get("data") if isinstance(value, dict) else value
    return data[0] if isinstance(data, list) and len(data) == 1 else data


def _write(rig: ForeignRig) -> Files:
    intri: dict[str, Any] = {"names": rig.names}
    extri: dict[str, Any] = {"names": rig.names}
    for camera in rig.cameras:
        name = camera.name
        intri[f"K_{name}"] = camera.lens.matrix
        intri[f"dist_{name}"] = array(camera.lens.pad(5), (1, 5), "dist")
        if camera.image_size:
            intri[f"H_{name}"], intri[f"W_{name}"] = camera.image_size[1], camera.image_size[0]
        extri[f"R_{name}"] = vector_from_rotation(camera.rotation)[:, None]
        extri[f"Rot_{name}"] = camera.rotation
        extri[f"T_{name}"] = camera.translation[:, None]
    return {"intri.yml": storage_text(intri), "extri.yml": storage_text(extri)}


FORMAT = Format("easymocap", TITLE, _recognizes, _read, _write, Holds((5,)), states_unit=True)
