"""Lengths: what a unit is in millimetres, and what a rig's unit is when its file does not say."""

from __future__ import annotations

import re

import numpy as np

from imgcal.errors import InputError
from imgcal.formats.foreign_rig import ForeignRig
from imgcal.formats.values import name_cameras
from imgcal.messages import shorten

UNITS = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "inch": 25.4, "in": 25.4}
LENGTH = re.compile(r"([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)?\s*([a-z]+)")


def millimetres(unit: str, what: str = "--unit") -> float:
    """Read a unit, or the length of one unit of a file (`417.2mm`).

    Raises:
        InputError: it is neither.

    Examples:
        >>> millimetres("m"), millimetres("12.5 mm")
        (1000.0, 12.5)
    """
    match = LENGTH.fullmatch(unit.strip())
    if match is None or match[2] not in UNITS:
        expected = f"{', '.join(UNITS)}, or the length of one unit of the file, such as 417.2mm"
        raise InputError(f"{what}: found {shorten(unit)!r}, expected {expected}")
    factor = float(match[1] or 1.0) * UNITS[match[2]]
    if not 1e-9 <= factor <= 1e9:
        raise InputError(f"{what}: found {shorten(unit)!r}, expected a length between 1e-9 and 1e9 mm")
    return factor


def in_millimetres(
    rig: ForeignRig, where: str, unit: str | None = None, distance: tuple[str, str, float] | None = None
) -> ForeignRig:
    """Put a rig's lengths into millimetres.

    Args:
        rig: as it was read.
        where: what errors begin with.
        unit: of the file, which counts before what the format says; None = what the format says.
        distance: two cameras and how many millimetres they are apart, instead of a unit.

    Raises:
        InputError: neither the file nor the caller says what the unit is: it is never guessed.
    """
    if distance is not None:
        if unit is not None:
            raise InputError("--distance: found --unit, too; expected one of them")
        return rig.scale(_factor(rig, distance), "mm")
    stated = unit if unit is not None else rig.unit
    if stated is None and len(rig.cameras) > 1:
        raise InputError(
            f"{where}: its unit of length is not said in the file: state it with --unit mm, cm, m, inch, or the length "
            "of one unit (--unit 417.2mm), or give a known distance of two cameras (--distance NAME NAME MM), to "
            'imgcal convert; in Python load_rig(..., unit="mm")'
        )
    return rig.scale(millimetres(stated or "mm"), "mm")


def _factor(rig: ForeignRig, distance: tuple[str, str, float]) -> float:
    *names, length = distance
    by_name = {camera.name: camera for camera in rig.cameras}
    unknown = [name for name in names if name not in by_name]
    if unknown or names[0] == names[1] or not 1e-3 <= length <= 1e7:
        raise InputError(
            f"--distance: found {' '.join(map(shorten, names))} {length:g}, expected two of the "
            f"{name_cameras(list(by_name))} and millimetres"
        )
    apart = float(np.linalg.norm(by_name[names[0]].centre - by_name[names[1]].centre))
    if apart < 1e-12:
        raise InputError(f"--distance: {names[0]} and {names[1]} stand at the same place in the file")
    return length / apart
