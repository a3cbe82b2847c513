"""Rigs of the tests: numbers that no default could hide."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imgcal.formats import Files, ForeignCamera, ForeignRig, Lens, in_millimetres, read_foreign_rig, worst_difference
from imgcal.formats.values import rotation_from_vector


def rig_of(*lenses: Lens, size: tuple[int, int] = (1280, 960), names: tuple[str, ...] = ()) -> ForeignRig:
    """Cameras on an arc that look inwards, in mm; the first one is not at the origin."""
    cameras = []
    for number, lens in enumerate(lenses):
        rotation = rotation_from_vector(np.array([0.05, -0.12 + 0.2 * number, 0.02 * number]))
        centre = np.array([300.0 * number - 90.0, 12.0 * number, 40.0 + 25.0 * number])
        name = names[number] if names else f"side{number}"
        cameras.append(ForeignCamera(name, lens, size, rotation, -rotation @ centre))
    return ForeignRig("test", tuple(cameras), "mm", "the test's")


def brown(*coefficients: float) -> Lens:
    """A lens with OpenCV's coefficients."""
    return Lens((1010.5, 1012.25), (641.3, 478.9), coefficients)


def fisheye(*coefficients: float) -> Lens:
    """An equidistant lens, a wide one."""
    return Lens((510.5, 512.25), (641.3, 478.9), coefficients, "fisheye")


def put(folder: Path, **files: str | bytes) -> Path:
    """Write files; in their names __ stands for a dot."""
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        path = folder / name.replace("__", ".")
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder


def put_files(folder: Path, files: Files) -> Path:
    """Write what a writer made; the path of the one file, or of the folder."""
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / (name or "calibration.txt")).write_bytes(content)
    return folder / "calibration.txt" if "" in files else folder


def read_in_mm(path: Path | Sequence[Path], unit: str | None = None, name: str | None = None) -> ForeignRig:
    """Read a rig, and put it in millimetres."""
    return in_millimetres(read_foreign_rig(path, name), "the test", unit)


def apart(rig: ForeignRig, other: ForeignRig) -> float:
    """How many pixels two rigs are apart at worst."""
    return worst_difference(rig, other)[0]
