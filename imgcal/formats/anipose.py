"""Anipose / aniposelib `calibration.toml`: [cam_N] in the unit of the board's squares, which the file does not say."""

from __future__ import annotations

from typing import Any

from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig
from imgcal.formats.format import Files, Format
from imgcal.formats.source import Source
from imgcal.formats.toml_cameras import find_tables, read_all_lenses, read_cameras, toml_text
from imgcal.formats.values import vector_from_rotation

TITLE = "anipose calibration.toml"


def _recognizes(source: Source) -> bool:
    return find_tables(source) is not None


def _read(source: Source) -> ForeignRig:
    tables = find_tables(source)
    assert tables is not None
    notes: list[str] = []
    cameras = read_cameras(tables.cameras, notes)
    return ForeignRig(FORMAT.name, cameras, None, "the file's world (anipose: near the first camera)", tuple(notes))


def read_lenses(source: Source) -> list[ForeignCamera]:
    """Read the cameras of a file without their places."""
    tables = find_tables(source)
    assert tables is not None
    return read_all_lenses(tables.cameras)


def camera_table(camera: ForeignCamera, coefficients: int = 5) -> dict[str, Any]:
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


def _write(rig: ForeignRig) -> Files:
    tables = {f"cam_{number}": camera_table(camera) for number, camera in enumerate(rig.cameras)}
    return {"": toml_text({**tables, "metadata": {"adjusted": False, "error": 0.0}})}


FORMAT = Format(
    "anipose", TITLE, _recognizes, _read, _write, Holds((5,), fisheye=True), unit="mm", read_lenses=read_lenses
)
