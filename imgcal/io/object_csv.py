"""Calibration objects: CSV with the header `x,y,z` (mm), optional columns `name`, `radius` and `tolerance` (mm).

A column `fiducial` says by which whole numbers detections know the points; without it, by their rows. Printed boards
are YAML files: `board_yaml`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from imgcal.errors import InputError
from imgcal.io.atomic import write_text
from imgcal.io.board_yaml import board_from_yaml, board_text
from imgcal.io.csv_file import Chunk, read_chunks
from imgcal.io.names import (
    LONGEST_NAME,
    check_regular,
    data_path,
    find_file,
    read_bytes,
    shipped_names,
    title_from_name,
)
from imgcal.messages import shorten
from imgcal.types import CalibrationObject, limits
from renderers.palette import palette

LIGHTS = "lights"
"""Names unknown markers instead of a file."""
SMALLEST = 1e-3  # mm, extent of an object
LARGEST_LABEL = 2**31 - 1
BOARD_SUFFIXES = (".yaml", ".yml")
NAME = "a different name for every point"


def load_object(path: str | Path) -> CalibrationObject:
    """Read a calibration object.

    Args:
        path: a CSV file, the YAML file of a printed board, or, when there is no such file, the bare name of a shipped
            object such as "cube8" or "lights": every blob may be a marker of its own, and nothing is known of them.

    Returns:
        The object in float64; colours from `renderers.palette`.

    Raises:
        InputError: one line with the file, the line, what was found and what was expected.

    Examples:
        >>> import imgcal
        >>> obj = imgcal.load_object("cube8")
        >>> obj.points.shape, obj.radius
        (torch.Size([8, 3]), None)
    """
    path = Path(path)
    if str(path) == LIGHTS and not path.is_file():
        return CalibrationObject.unknown(LIGHTS)
    if not path.is_file() and str(path) in shipped_names("objects", ".yaml"):
        path = data_path("objects", f"{path}.yaml")
    if path.suffix.lower() in BOARD_SUFFIXES:
        check_regular(path)
        if not path.is_file():
            raise InputError(f"{path}: no such file, expected that of a printed board")
        return board_from_yaml(read_bytes(path), path)
    return _read(find_file(path, "objects", ".csv", other=LIGHTS))


def load_objects(paths: Sequence[str | Path]) -> CalibrationObject:
    """Read one calibration object, or several that are in view of one capture (`CalibrationObject.of_several`).

    Raises:
        InputError: as `load_object`; or one that cannot be among several.
    """
    return CalibrationObject.of_several([load_object(path) for path in paths])


def object_from_text(text: str, where: str, name: str = "object") -> CalibrationObject:
    """Read an object from the text of its file, the result of `object_text`.

    Args:
        text: the CSV.
        where: what errors begin with.
        name: of the object.

    Raises:
        InputError: as `load_object`.
    """
    content = text.encode(errors="replace")
    if text.startswith("format:"):
        return replace(board_from_yaml(content, Path(where)), name=name)
    return replace(_read(Path(where), content), name=name)


def _read(path: Path, content: bytes | None = None) -> CalibrationObject:
    chunks = list(islice(read_chunks(path, ("x", "y", "z"), ("name", "radius", "tolerance", "fiducial"), content), 2))
    count = sum(map(len, chunks))
    if not 1 <= count <= limits.MOST_FIDUCIALS:
        found = f"more than {limits.MOST_FIDUCIALS}" if count else 0
        raise InputError(f"{path}: found {found} points, expected 1 to {limits.MOST_FIDUCIALS}")
    chunk = chunks[0]
    axes = [chunk.numbers(axis, limits.COORDINATE, f"a finite coordinate, {limits.COORDINATE}") for axis in "xyz"]
    points = np.stack(axes, axis=1)
    _check_points(chunk, points)
    radius = None
    if "radius" in chunk.columns:
        radius = torch.from_numpy(
            chunk.numbers("radius", limits.FIDUCIAL_RADIUS, f"a radius > 0, {limits.FIDUCIAL_RADIUS}")
        )
    tolerance = None
    if "tolerance" in chunk.columns:
        tolerance = torch.from_numpy(chunk.numbers("tolerance", limits.TOLERANCE, f"a tolerance, {limits.TOLERANCE}"))
    names = tuple(name.strip() for name in chunk.columns.get("name", ()))
    for row, name in enumerate(names):
        if not _is_name(name) or name in names[:row]:
            chunk.fail(row, f"name: found {shorten(name)!r}, expected {NAME}")
    return CalibrationObject(
        torch.from_numpy(points),
        palette(count).double(),
        radius,
        title_from_name(path),
        names,
        tolerance,
        labels=_labels(chunk),
    )


def _labels(chunk: Chunk) -> tuple[int, ...]:
    """Labels of the points in detections; empty if they are the rows."""
    if "fiducial" not in chunk.columns:
        return ()
    plausible = limits.Range(0, LARGEST_LABEL, "")
    numbers = chunk.numbers("fiducial", plausible, f"a whole number, {plausible}", whole=True)
    labels = tuple(numbers.astype(int).tolist())
    for row, label in enumerate(labels):
        if label in labels[:row]:
            chunk.fail(row, f"fiducial: found {label} again, expected a different number for every point")
    return () if labels == tuple(range(len(labels))) else labels


def save_object(obj: CalibrationObject, path: str | Path) -> None:
    """Write a calibration object in one step; every number in its shortest exact form.

    Raises:
        InputError: the file cannot be written; or the object has something that a file has no place for (a scale
            tolerance, several objects), or that could not be read again.

    Examples:
        >>> import imgcal
        >>> save_object(imgcal.load_object("cube8"), "mine.csv")
        >>> imgcal.load_object("mine.csv").name
        'mine'
    """
    where = f"{path}: not written"
    if obj.parts or obj.scale_tolerance:
        found = "several objects" if obj.parts else f"a scale tolerance of {obj.scale_tolerance:g}"
        raise InputError(f"{where}: found {found}, for which a file has no place")
    text = object_text(obj, path)
    object_from_text(text, where)  # raises what reading it again would
    write_text(path, text)


def object_text(obj: CalibrationObject, where: str | Path = "object") -> str:
    """Make the text that `save_object` writes, which leaves out a scale tolerance; errors begin with `where`.

    Raises:
        InputError: the name of a fiducial could not be read again, or is not unique.
    """
    if obj.board is not None:
        return board_text(obj)
    names, count = obj.fiducial_names, obj.num_fiducials
    for what, given in (("names", names), ("labels", obj.labels)):
        if len(given) not in (0, count):
            raise InputError(f"{where}: not written: found {len(given)} {what}, expected {count}, or none")
    for row, name in enumerate(names):
        if not _is_name(name) or name in names[:row]:
            raise InputError(f"{where}: not written: found the name {shorten(name)!r}, expected {NAME}")
    columns: list[list[str]] = [[f"{value!r}" for value in axis] for axis in obj.points.double().T.tolist()]
    header = ["x", "y", "z"]
    if obj.labels:
        header.append("fiducial")
        columns.append([str(label) for label in obj.labels])
    if names:
        header.append("name")
        columns.append(list(names))
    if obj.radius is not None:
        header.append("radius")
        columns.append([f"{value!r}" for value in obj.radius.double().tolist()])
    if obj.tolerance is not None:
        header.append("tolerance")
        columns.append([f"{value!r}" for value in obj.tolerance.double().tolist()])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()


def _is_name(name: str) -> bool:
    return 0 < len(name) <= LONGEST_NAME and name.isprintable() and name == name.strip()


def _check_points(chunk: Chunk, points: np.ndarray) -> None:
    _, first, groups = np.unique(points, axis=0, return_index=True, return_inverse=True)
    repeated = np.flatnonzero(first[groups.ravel()] != np.arange(len(points)))
    if len(repeated):
        row = int(repeated[0])
        original = int(first[groups.ravel()][row])
        chunk.fail(row, f"found the same point as in row {original + 1}, expected different points")
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) > 1 and singular[0] < SMALLEST:
        raise InputError(f"{chunk.path}: found all {len(points)} points at one place, expected coordinates in mm")
