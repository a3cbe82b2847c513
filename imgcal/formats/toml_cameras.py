"""What anipose, Pose2Sim, FreeMoCap and caliscope have in common: a TOML table for each camera. X_cam = R X + t."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.foreign_rig import ForeignCamera, FormatError, Place, unplaced_camera
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import array, camera_matrix, coefficients, image_size, name_cameras, numbers, rotation, text
from imgcal.messages import list_names

Table = dict[str, Any]
AT = ""  # the key of a table under which it is kept where it stands: path and keys


@dataclass(frozen=True)
class Tables:
    """The cameras of a file, and what else stands in it."""

    cameras: Mapping[str, Table]  # by the key of the table
    metadata: Table


def find_tables(source: Source) -> Tables | None:
    """Find the tables that are cameras; None where there are none.

    Raises:
        FormatError: more than one file has some.
    """
    found = []
    for document, values in source.mappings:
        if document.kind != "toml":
            continue
        nested = values.get("cameras")
        group = nested if isinstance(nested, dict) else values
        outer = ("cameras",) if group is nested else ()
        cameras = {
            key: {**value, AT: (document.path, (*outer, key))} for key, value in group.items() if is_camera(value)
        }
        if cameras:
            metadata = values.get("metadata")
            found.append((document.path.name, Tables(cameras, metadata if isinstance(metadata, dict) else {})))
    if len(found) > 1:
        raise FormatError(f"{list_names(name for name, _ in found)} have cameras in TOML each: give one of these files")
    return found[0][1] if found else None


def has_tables(source: Source) -> bool:
    """Tell whether there are tables of cameras: whose they are is then a question of details."""
    return find_tables(source) is not None


def is_camera(value: Any) -> bool:
    """Tell whether a table is a camera's: it has, or may lack, a pose, but it has a lens or says that it has none."""
    return isinstance(value, dict) and ("matrix" in value or ({"rotation_count", "size"} <= value.keys()))


def is_missing(value: Any) -> bool:
    """Tell whether something is not there: no key, an empty list, or the text null."""
    return value is None or value in ("null", "None", "", [])


def read_cameras(tables: Mapping[str, Table], notes: list[str]) -> tuple[ForeignCamera, ...]:
    """Read the cameras that have a lens and a pose; the others are named in `notes`.

    Raises:
        FormatError: none is left, or no pose has ever been calibrated.
    """
    cameras: list[ForeignCamera] = []
    without_pose, without_lens, at_origin = [], [], []
    for key, table in tables.items():
        name = camera_name(key, table)
        if is_missing(table.get("matrix")) or is_missing(table.get("distortions")):
            without_lens.append(name)
            continue
        if is_missing(table.get("rotation")) or is_missing(table.get("translation")):
            without_pose.append(name)
            continue
        cameras.append(_camera(name, table))
        if not any(numbers(table["rotation"], name)) and not any(numbers(table["translation"], name)):
            at_origin.append(name)
    own = len(notes)
    if without_lens:
        notes.append(f"{name_cameras(without_lens)}: left out, intrinsics are not calibrated")
    if without_pose:
        notes.append(f"{name_cameras(without_pose)}: left out, where they stand is not calibrated")
    if not cameras:
        raise FormatError(
            f"no camera has both intrinsics and a pose: {'; '.join(notes[own:])}; imgcal calibrate --cameras finds out "
            "where they stand"
        )
    if len(at_origin) > 1:
        raise FormatError(
            f"{name_cameras(at_origin)}: rotation and translation are zero: extrinsics were never calibrated"
        )
    return tuple(cameras)


def camera_name(key: str, table: Table) -> str:
    """A camera is called what its table says, else by the key."""
    name = table.get("name", key.removeprefix("cam_") if "name" not in table and "port" in table else key)
    return text(name, key)


def read_all_lenses(tables: Mapping[str, Table]) -> list[ForeignCamera]:
    """Read all cameras as if none had a pose: all are at the origin.

    Raises:
        FormatError: a camera has no lens.
    """
    cameras = []
    for key, table in tables.items():
        name = camera_name(key, table)
        if is_missing(table.get("matrix")) or is_missing(table.get("distortions")):
            raise FormatError(
                f"{name_cameras([name])}: intrinsics are not calibrated: imgcal rig cameras writes a file with a "
                "field of view"
            )
        cameras.append(unplaced_camera(name, *_lens(name, table)))
    return cameras


def _camera(name: str, table: Table) -> ForeignCamera:
    lens, size = _lens(name, table)
    translation = array(table["translation"], (3,), f"{name}: translation")
    turned = rotation(table["rotation"], f"{name}: rotation")
    camera = ForeignCamera(name, lens, size, turned, translation)
    return replace(camera, places=_places(camera, table))


def _places(camera: ForeignCamera, table: Table) -> tuple[Place, ...]:
    """Where a camera's numbers stand; FreeMoCap's copies of the pose only where they are copies."""
    path, keys = table[AT]
    inside: dict[str, places.Numbers] = {
        "matrix": places.camera_matrix,
        "distortions": places.coefficients(len(camera.lens.coefficients)),
        "rotation": places.rotation_like(numbers(table["rotation"], "rotation")),
        "translation": places.translation,
    }
    copies: dict[str, places.Numbers] = {
        "world_position": places.centre,
        "world_orientation": lambda one: [float(value) for value in one.rotation.T.ravel()],
    }
    for key, of in copies.items():
        found = numbers(table[key], key) if isinstance(table.get(key), list) else []
        expected = of(camera)
        if len(found) == len(expected) and np.allclose(found, expected, rtol=1e-4, atol=1e-4):
            inside[key] = of
    return tuple(Place(path, (*keys, key), of) for key, of in inside.items())


def _lens(name: str, table: Table) -> tuple[Lens, tuple[int, int] | None]:
    """The lens, and the size of the images where the table says it."""
    focal, centre, skew = camera_matrix(table["matrix"], f"{name}: matrix")
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise FormatError(f"{name}: fisheye: found {fisheye!r}, expected true or false")
    counts = (4,) if fisheye else (0, 1, 2, 4, 5, 8, 12, 14)
    ks = coefficients(table["distortions"], f"{name}: distortions", counts)
    lens = Lens(focal, centre, ks, "fisheye" if fisheye else "opencv", skew)
    return lens, None if is_missing(table.get("size")) else image_size(table["size"], f"{name}: size")


def toml_text(tables: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Write tables of numbers, lists, texts and booleans."""
    lines: list[str] = []
    for name, table in tables.items():
        lines += [f"[{name}]", *(f"{key} = {_value(value)}" for key, value in table.items()), ""]
    return "\n".join(lines).encode()


def toml_key(name: str) -> str:
    """A name as a key: bare where that is allowed."""
    return name if name and all(c.isascii() and (c.isalnum() or c in "_-") for c in name) else _value(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value)
