"""Caliscope: `camera_array.toml` with [cameras.N], before that `config.toml` with [cam_N]; metres.

Rotations are matrices in the older files and rotation vectors in the newer ones; poses that were never calibrated are
absent or the text "null".
"""

from __future__ import annotations

from typing import Any

from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError
from imgcal.formats.format import Files, Format
from imgcal.formats.source import Source
from imgcal.formats.toml_cameras import Table, find_tables, has_tables, read_all_lenses, read_cameras, toml_text
from imgcal.formats.values import name_cameras, number, text, vector_from_rotation

TITLE = "caliscope camera array"
OLD = "caliscope-config"


def _recognizes(source: Source) -> bool:
    tables = find_tables(source)
    return tables is not None and any("rotation_count" in table for table in tables.cameras.values())


def _read(source: Source) -> ForeignRig:
    tables = _tables_by_name(source)
    ignored = [name for name, table in tables.items() if table.get("ignore") is True]
    notes = ["metres"]
    cameras = read_cameras(tables, notes)
    if kept := [name for name in ignored if name in [camera.name for camera in cameras]]:
        notes.append(
            f"{name_cameras(kept)}: marked `ignore` in the file, and taken all the same, with the pose that it has"
        )
    return ForeignRig(FORMAT.name, cameras, "m", "the file's world (as set in caliscope)", tuple(notes))


def _read_lenses(source: Source) -> list[ForeignCamera]:
    return read_all_lenses(_tables_by_name(source))


def _tables_by_name(source: Source) -> dict[str, Table]:
    """The tables by the names of the cameras.

    Raises:
        FormatError: images were turned.
    """
    tables = find_tables(source)
    assert tables is not None
    named_tables: dict[str, Table] = {}
    turned = []
    for key, table in tables.cameras.items():
        name = text(table.get("cam_id", table.get("port", key.removeprefix("cam_"))), key)
        named_tables[name] = {**table, "name": name}
        if number(table.get("rotation_count", 0), f"{name}: rotation_count") % 4:
            turned.append(name)
    if turned:
        raise FormatError(
            f"{name_cameras(turned)}: rotation_count is not 0: the images were turned before they were used, and "
            "the file "
            "does not say what K then refers to; turn the videos, and calibrate anew"
        )
    return named_tables


def _write(rig: ForeignRig) -> Files:
    return {"": toml_text({f"cameras.{key}": table for key, table in _tables(rig, matrix=False).items()})}


def _write_old(rig: ForeignRig) -> Files:
    return {"": toml_text({f"cam_{key}": table for key, table in _tables(rig, matrix=True).items()})}


def _tables(rig: ForeignRig, matrix: bool) -> dict[int, dict[str, Any]]:
    """Caliscope's cameras are numbers: those of the names where all are, else 0, 1, 2, ..."""
    names = rig.names
    plain = all(name.isascii() and name.isdigit() and str(int(name)) == name for name in names)
    tables: dict[int, dict[str, Any]] = {}
    for place, camera in enumerate(rig.cameras):
        fisheye = camera.lens.model == "fisheye"
        key = int(camera.name) if plain else place
        tables[key] = {
            "cam_id": key,
            "rotation_count": 0,
            "error": 0.0,
            "grid_count": 0,
            "ignore": False,
            "size": list(camera.image_size or ()),
            "matrix": camera.lens.matrix.tolist(),
            "distortions": camera.lens.pad(4 if fisheye else 5),
            "fisheye": fisheye,
            "translation": camera.translation.tolist(),
            "rotation": camera.rotation.tolist() if matrix else vector_from_rotation(camera.rotation).tolist(),
        }
    return tables


FORMAT = Format(
    "caliscope", TITLE, _recognizes, _read, _write, Holds((5,), fisheye=True), accepts=has_tables, states_unit=True,
    read_lenses=_read_lenses,
)  # fmt: skip
OLD_FORMAT = Format(
    OLD, "caliscope config.toml (older)", lambda source: False, _read, _write_old, Holds((5,), fisheye=True),
    accepts=has_tables, states_unit=True,
    read_lenses=_read_lenses,
)  # fmt: skip
