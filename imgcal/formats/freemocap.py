"""FreeMoCap `*_camera_calibration.toml`: anipose's tables in millimetres, with the cameras' places written out, too.

FreeMoCap reads four coefficients and drops the fifth: what is written has none.
"""

from __future__ import annotations

from imgcal.formats.anipose import camera_table, read_lenses
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignRig
from imgcal.formats.format import Files, Format
from imgcal.formats.source import Source
from imgcal.formats.toml_cameras import find_tables, has_tables, read_cameras, toml_key, toml_text

TITLE = "FreeMoCap camera calibration"
WORLD = ("world_position", "world_orientation")


def _recognizes(source: Source) -> bool:
    tables = find_tables(source)
    return tables is not None and any(key in table for table in tables.cameras.values() for key in WORLD)


def _read(source: Source) -> ForeignRig:
    tables = find_tables(source)
    assert tables is not None
    notes = ["millimetres, as FreeMoCap's boards are measured"]
    cameras = read_cameras(tables.cameras, notes)
    plane = tables.metadata.get("groundplane_applied") or "groundplane_calibration" in tables.metadata
    if plane:
        notes.append("the world is the board that lay on the ground")
    frame = "the board on the ground" if plane else "the file's world (near the first camera, or the board)"
    if any(camera.lens.length == 5 for camera in cameras):
        notes.append("FreeMoCap itself drops k3 when it reads this file; here it counts")
    return ForeignRig(FORMAT.name, cameras, "mm", frame, tuple(notes))


def _write(rig: ForeignRig) -> Files:
    tables = {}
    for number, camera in enumerate(rig.cameras):
        table = camera_table(camera)
        table |= {
            "id": camera.name,
            "index": number,
            "world_position": camera.centre.tolist(),
            "world_orientation": camera.rotation.T.tolist(),
        }
        tables[toml_key(camera.name)] = table
    return {"": toml_text({**tables, "metadata": {"groundplane_applied": False}})}


FORMAT = Format(
    "freemocap",
    TITLE,
    _recognizes,
    _read,
    _write,
    Holds((4,)),
    unit="mm",
    accepts=has_tables,
    states_unit=True,
    read_lenses=read_lenses,
)
