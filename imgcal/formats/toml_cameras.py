"""anipose, Pose2Sim, FreeMoCap and caliscope: a TOML table for each camera. X_cam = R X + t.

anipose's `calibration.toml` has [cam_N] in the unit of the board's squares, which the file does not say. Pose2Sim's
`Calib*.toml` has exactly four coefficients, in metres. FreeMoCap's `*_camera_calibration.toml` has anipose's tables in
millimetres, with the cameras' places written out, too; FreeMoCap reads four coefficients and drops the fifth, so none
is written. caliscope's `camera_array.toml` has [cameras.N], its older `config.toml` has [cam_N]; metres. Its rotations
are matrices in the older files and rotation vectors in the newer ones, and poses that were never calibrated are absent
or the text "null".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place, unplaced_camera
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
    text,
    vector_from_rotation,
)
from imgcal.messages import list_names, name_cameras

Table = dict[str, Any]
WORLD = ("world_position", "world_orientation")  # what FreeMoCap adds to a pose
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
        raise FormatError(f"{list_names(name for name, _ in found)}: each has cameras; give one of these files")
    return found[0][1] if found else None


def has_tables(source: Source) -> bool:
    """Tell whether there are tables of cameras: whose they are is then a question of details."""
    return find_tables(source) is not None


def _tables(source: Source) -> Tables:
    """The tables of a source that has some."""
    tables = find_tables(source)
    assert tables is not None
    return tables


def is_camera(value: Any) -> bool:
    """Tell whether a table is a camera's: it has, or may lack, a pose, but it has a lens or says that it has none."""
    return isinstance(value, dict) and ("matrix" in value or ({"rotation_count", "size"} <= value.keys()))


def is_missing(value: Any) -> bool:
    """Tell whether something is not there: no key, an empty list, or the text null."""
    return value is None or value in ("null", "None", "", [])


def read_cameras(tables: Mapping[str, Table], notes: list[str]) -> tuple[ForeignCamera, ...]:
    """Read the cameras that have a lens and a pose; the others are named in `notes`.

    Raises:
        FormatError: none is left.
    """
    cameras: list[ForeignCamera] = []
    without_pose, without_lens = [], []
    for key, table in tables.items():
        name = camera_name(key, table)
        if is_missing(table.get("matrix")) or is_missing(table.get("distortions")):
            without_lens.append(name)
            continue
        if is_missing(table.get("rotation")) or is_missing(table.get("translation")):
            without_pose.append(name)
            continue
        cameras.append(_camera(name, table))
    own = len(notes)
    if without_lens:
        notes.append(f"{name_cameras(without_lens)}: left out, intrinsics are not calibrated")
    if without_pose:
        notes.append(f"{name_cameras(without_pose)}: left out, poses are not calibrated")
    if not cameras:
        raise FormatError(
            f"no camera has both intrinsics and a pose: {'; '.join(notes[own:])}; imgcal calibrate --cameras finds "
            "the poses"
        )
    return tuple(cameras)


def camera_name(key: str, table: Table) -> str:
    """A camera is called what its table says, else by the key."""
    name = table.get("name", key.removeprefix("cam_") if "name" not in table and "port" in table else key)
    return text(name, key)


def _read_lenses(source: Source) -> list[ForeignCamera]:
    return read_all_lenses(_tables(source).cameras)


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
        "world_orientation": lambda one: one.rotation.T.ravel().tolist(),
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


def camera_table(camera: ForeignCamera, coefficients: int = 5) -> Table:
    """One camera as anipose and its kin write it."""
    fisheye = camera.lens.model == "fisheye"
    return {
        "name": camera.name,
        "size": list(camera.image_size or ()),
        "matrix": camera.lens.matrix.tolist(),
        "distortions": camera.lens.pad(4 if fisheye else coefficients),
        "rotation": vector_from_rotation(camera.rotation).tolist(),
        "translation": camera.translation.tolist(),
        "fisheye": fisheye,
    }


def _read_anipose(source: Source) -> ForeignRig:
    notes: list[str] = []
    tables = _tables(source)
    cameras = read_cameras(tables.cameras, notes)
    hint = "of fisheyes, Pose2Sim's looks like anipose's: --from pose2sim reads metres" if _are_fisheyes(tables) else ""
    frame = "the file's world (anipose: near the first camera)"
    return ForeignRig(ANIPOSE.name, cameras, None, frame, tuple(notes), unit_hint=hint)


def _write_anipose(rig: ForeignRig) -> Files:
    tables = {f"cam_{number}": camera_table(camera) for number, camera in enumerate(rig.cameras)}
    return {"": toml_text({**tables, "metadata": {"adjusted": False, "error": 0.0}})}


def _is_pose2sim(source: Source) -> bool:
    tables = find_tables(source)
    if tables is None or any("rotation_count" in table for table in tables.cameras.values()):
        return False
    # Anipose writes five, of a fisheye four as well.
    counts = {len(numbers(table.get("distortions", []), "distortions")) for table in tables.cameras.values()}
    return counts == {4} and not _are_fisheyes(tables)


def _are_fisheyes(tables: Tables) -> bool:
    return all(table.get("fisheye") is True for table in tables.cameras.values())


def _read_pose2sim(source: Source) -> ForeignRig:
    notes = ["four coefficients in each camera: Pose2Sim's, in metres, z up"]
    cameras = read_cameras(_tables(source).cameras, notes)
    return ForeignRig(POSE2SIM.name, cameras, "m", "the file's world (z up)", tuple(notes))


def _write_pose2sim(rig: ForeignRig) -> Files:
    tables = {toml_key(camera.name): camera_table(camera, coefficients=4) for camera in rig.cameras}
    return {"": toml_text({**tables, "metadata": {"adjusted": False, "error": 0.0}})}


def _is_freemocap(source: Source) -> bool:
    tables = find_tables(source)
    return tables is not None and any(key in table for table in tables.cameras.values() for key in WORLD)


def _read_freemocap(source: Source) -> ForeignRig:
    tables = _tables(source)
    notes = ["millimetres, as FreeMoCap's boards are measured"]
    cameras = read_cameras(tables.cameras, notes)
    plane = tables.metadata.get("groundplane_applied") or "groundplane_calibration" in tables.metadata
    if plane:
        notes.append("the world is the board that lay on the ground")
    frame = "the board on the ground" if plane else "the file's world (near the first camera, or the board)"
    if any(camera.lens.length == 5 for camera in cameras):
        notes.append("FreeMoCap itself drops k3 when it reads this file; imgcal uses it")
    return ForeignRig(FREEMOCAP.name, cameras, "mm", frame, tuple(notes))


def _write_freemocap(rig: ForeignRig) -> Files:
    tables = {}
    for place, camera in enumerate(rig.cameras):
        world = dict(zip(WORLD, (camera.centre.tolist(), camera.rotation.T.tolist()), strict=True))
        tables[toml_key(camera.name)] = camera_table(camera) | {"id": camera.name, "index": place} | world
    return {"": toml_text({**tables, "metadata": {"groundplane_applied": False}})}


def _is_caliscope(source: Source) -> bool:
    tables = find_tables(source)
    return tables is not None and any("rotation_count" in table for table in tables.cameras.values())


def _read_caliscope(source: Source) -> ForeignRig:
    tables = _caliscope_tables(source)
    ignored = [name for name, table in tables.items() if table.get("ignore") is True]
    notes = ["metres"]
    cameras = read_cameras(tables, notes)
    if kept := [name for name in ignored if name in [camera.name for camera in cameras]]:
        notes.append(f"{name_cameras(kept)}: marked `ignore` in the file, but used, with its pose")
    return ForeignRig(CALISCOPE.name, cameras, "m", "the file's world (as set in caliscope)", tuple(notes))


def _read_caliscope_lenses(source: Source) -> list[ForeignCamera]:
    return read_all_lenses(_caliscope_tables(source))


def _caliscope_tables(source: Source) -> dict[str, Table]:
    """The tables by the names of the cameras.

    Raises:
        FormatError: images were turned.
    """
    found: dict[str, Table] = {}
    turned = []
    for key, table in _tables(source).cameras.items():
        name = text(table.get("cam_id", table.get("port", key.removeprefix("cam_"))), key)
        found[name] = {**table, "name": name}
        if number(table.get("rotation_count", 0), f"{name}: rotation_count") % 4:
            turned.append(name)
    if turned:
        raise FormatError(
            f"{name_cameras(turned)}: rotation_count is not 0: the images were rotated before use, and the file does "
            "not state which orientation K refers to; rotate the videos and calibrate again"
        )
    return found


def _write_caliscope(rig: ForeignRig) -> Files:
    tables = _numbered_tables(rig)
    return {"": toml_text({f"cameras.{key}": table for key, table in tables.items()})}


def _write_old_caliscope(rig: ForeignRig) -> Files:
    tables = zip(_numbered_tables(rig).items(), rig.cameras, strict=True)
    matrices = {f"cam_{key}": table | {"rotation": camera.rotation.tolist()} for (key, table), camera in tables}
    return {"": toml_text(matrices)}


def _numbered_tables(rig: ForeignRig) -> dict[int, Table]:
    """Caliscope's cameras are numbers: those of the names where all are, else 0, 1, 2, ..."""
    plain = all(name.isascii() and name.isdigit() and str(int(name)) == name for name in rig.names)
    own = {"rotation_count": 0, "error": 0.0, "grid_count": 0, "ignore": False}
    names = ("size", "matrix", "distortions", "fisheye", "translation", "rotation")
    tables: dict[int, Table] = {}
    for place, camera in enumerate(rig.cameras):
        key, table = int(camera.name) if plain else place, camera_table(camera)
        tables[key] = {"cam_id": key, **own, **{name: table[name] for name in names}}
    return tables


ANIPOSE = Format(
    "anipose", "anipose calibration.toml", has_tables, _read_anipose, _write_anipose, Holds((5,), fisheye=True),
    unit="mm", read_lenses=_read_lenses,
)  # fmt: skip
POSE2SIM = Format(
    "pose2sim", "Pose2Sim Calib.toml", _is_pose2sim, _read_pose2sim, _write_pose2sim, Holds((4,), fisheye=True),
    accepts=has_tables, states_unit=True, read_lenses=_read_lenses,
)  # fmt: skip
FREEMOCAP = Format(
    "freemocap", "FreeMoCap camera calibration", _is_freemocap, _read_freemocap, _write_freemocap, Holds((4,)),
    unit="mm", accepts=has_tables, states_unit=True, read_lenses=_read_lenses,
)  # fmt: skip
CALISCOPE = Format(
    "caliscope", "caliscope camera array", _is_caliscope, _read_caliscope, _write_caliscope,
    Holds((5,), fisheye=True), accepts=has_tables, states_unit=True, read_lenses=_read_caliscope_lenses,
)  # fmt: skip
OLD_CALISCOPE = replace(
    CALISCOPE, name="caliscope-config", title="caliscope config.toml (older)", recognizes=lambda source: False,
    write=_write_old_caliscope,
)  # fmt: skip
