"""Pose2Sim `Calib*.toml`: a table a camera, exactly four coefficients, metres."""

from __future__ import annotations

from imgcal.formats.anipose import camera_table, read_lenses
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignRig
from imgcal.formats.format import Files, Format
from imgcal.formats.source import Source
from imgcal.formats.toml_cameras import find_tables, has_tables, read_cameras, toml_key, toml_text
from imgcal.formats.values import numbers

TITLE = "Pose2Sim Calib.toml"


def _recognizes(source: Source) -> bool:
    tables = find_tables(source)
    if tables is None or any("rotation_count" in table for table in tables.cameras.values()):
        return False
    # Anipose writes five, of a fisheye four as well.
    counts = {len(numbers(table.get("distortions", []), "distortions")) for table in tables.cameras.values()}
    fisheyes = [table.get("fisheye") is True for table in tables.cameras.values()]
    return counts == {4} and not all(fisheyes)


def _read(source: Source) -> ForeignRig:
    tables = find_tables(source)
    assert tables is not None
    notes = ["four coefficients in each camera: Pose2Sim's, in metres, z up"]
    cameras = read_cameras(tables.cameras, notes)
    return ForeignRig(FORMAT.name, cameras, "m", "the file's world (z up)", tuple(notes))


def _write(rig: ForeignRig) -> Files:
    tables = {toml_key(camera.name): camera_table(camera, coefficients=4) for camera in rig.cameras}
    return {"": toml_text({**tables, "metadata": {"adjusted": False, "error": 0.0}})}


FORMAT = Format(
    "pose2sim",
    TITLE,
    _recognizes,
    _read,
    _write,
    Holds((4,), fisheye=True),
    accepts=has_tables,
    states_unit=True,
    read_lenses=read_lenses,
)
