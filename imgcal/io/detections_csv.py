"""Detections: CSV or CSV.gz with the header `snapshot,camera,u,v`.

Optional columns: `sigma` (pixels; without it `DEFAULT_SIGMA` holds for every blob), `fiducial` (row of the object
file, or what its own column `fiducial` calls it; empty = unlabelled), `object` (the name of the object to which
the fiducial belongs, where there are several), `radius` (pixels, empty = unknown) and `flags` (sum of `BlobFlag` bits).

Convention: a snapshot or camera without any blob has no row, so a file does not know of it; cameras come back when the
file is read with its rig.
"""

from __future__ import annotations

import csv
import gzip
import io
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io.atomic import replacing
from imgcal.io.csv_file import Chunk, fail_row, read_chunks
from imgcal.io.names import is_file_name, nearest, require_left_out
from imgcal.messages import list_names, shorten
from imgcal.types import BlobFlag, CalibrationObject, CameraRig, Detections, check_rig, limits

REQUIRED = ("snapshot", "camera", "u", "v")
OPTIONAL = ("sigma", "fiducial", "object", "radius", "flags")

Fiducials = int | Sequence[int] | Sequence[tuple[str, int]]
"""What tables call the points of an object: so many rows, or numbers; with several objects, the object and a number."""

DEFAULT_SIGMA = 0.1
"""Pixels, one standard deviation of each axis, for files without the column `sigma`."""

LEFT_OUT = -1
"""Number of a camera whose rows are left out."""

NORMALIZED = (-1.0, 2.0)  # where coordinates lie that are divided by the image's size
MARGIN = 5.0  # pixels outside the image that are still taken: centres of cut discs, rounding


def load_detections(
    path: str | Path,
    rig: CameraRig | None = None,
    fiducials: Fiducials | CalibrationObject | None = None,
    without: Collection[str] = (),
) -> Detections:
    r"""Read detections; a million rows take a few seconds.

    Args:
        path: CSV file, with or without gzip compression.
        rig: gives the cameras and their order, and the image sizes that are checked; None = cameras in file order.
        fiducials: the object; or its number of points, the limit of the column `fiducial`; or what that calls them, in
            the order of the object (`CalibrationObject.rows`); None = not checked.
        without: cameras that the rig does not have, whose rows are left out.

    Returns:
        Detections; snapshots in file order, which is the order in which their names first appear.

    Raises:
        InputError: one line with the file, the line, what was found and what was expected.

    Examples:
        >>> from pathlib import Path
        >>> import imgcal
        >>> rows = ["snapshot,camera,u,v", "0,cam01,100.5,50.25", "0,cam02,400,300"]
        >>> _ = Path("blobs.csv").write_text("\n".join(rows))
        >>> blobs = imgcal.load_detections("blobs.csv")
        >>> blobs.camera_names, blobs.uv[0], blobs.fiducial  # -1 = unlabelled
        (('cam01', 'cam02'), array([100.5 ,  50.25]), array([-1, -1]))
    """
    path = Path(path)
    if rig is not None:
        check_rig(rig)
    if isinstance(fiducials, CalibrationObject):
        fiducials = fiducials.rows
    cameras = {} if rig is None else {name: index for index, name in enumerate(rig.camera_names)}
    known_cameras = None if rig is None else rig.camera_names
    if known_cameras is not None:
        cameras |= dict.fromkeys(without, LEFT_OUT)
    left_out: set[str] = set()
    snapshots: dict[str, int] = {}
    parts: list[dict[str, NDArray[Any]]] = []
    for chunk in read_chunks(path, REQUIRED, OPTIONAL):
        part = {
            "camera": _indices(chunk, "camera", cameras, known_cameras),
            "snapshot": _indices(chunk, "snapshot", snapshots, None),
            **_numbers(chunk, fiducials),
        }
        if rig is not None:
            kept = part["camera"] != LEFT_OUT
            _check_inside(chunk, part, rig)
            left_out |= {chunk.columns["camera"][row] for row in np.flatnonzero(~kept)}
            part = {name: values[kept] for name, values in part.items()}
        parts.append(part)
    if not parts:
        raise InputError(f"{path}: found a header and no rows, expected at least one blob")
    require_left_out(path, without, left_out)
    cameras = {name: index for name, index in cameras.items() if index != LEFT_OUT}
    column = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    found = Detections(
        uv=np.stack((column["u"], column["v"]), axis=1),
        sigma=column["sigma"],
        camera=column["camera"],
        snapshot=column["snapshot"],
        fiducial=column["fiducial"].astype(np.int64),
        radius=column["radius"],
        flags=column["flags"].astype(np.uint8),
        camera_names=tuple(cameras),
        snapshot_names=tuple(snapshots),
    )
    _check_unique(path, found)
    if rig is not None:
        require_pixels(found, path)
    return found


def save_detections(detections: Detections, path: str | Path, obj: CalibrationObject | None = None) -> None:
    """Write detections in one step, compressed when the name ends in .gz; equal detections give equal bytes.

    Args:
        detections: blobs; numbers are written in their shortest exact form.
        path: the file to write.
        obj: whose fiducials the labels are, which are written as it calls them; several objects
            (`CalibrationObject.of_several`) add the column `object`. None = labels are written as rows.

    Raises:
        InputError: the file cannot be written; or there is no blob, or a name or value that could not be read again.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import simulate_truth, true_detections
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
        >>> blobs = true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), None))
        >>> imgcal.save_detections(blobs, "blobs.csv.gz")
        >>> len(imgcal.load_detections("blobs.csv.gz", rig)) == len(blobs) == 2 * 4 * 8
        True
    """
    path = Path(path)
    if not len(detections):
        raise InputError(f"{path}: not written: found no blob in any camera, expected at least one")
    limits.check_detections(detections, f"{path}: not written")
    for name in (*detections.camera_names, *detections.snapshot_names):
        if not is_file_name(name):
            raise InputError(f"{path}: not written: found {shorten(name)!r}, expected a name that can be a file name")
    known = np.isfinite(detections.radius)
    columns: dict[str, Iterable[str]] = {
        "snapshot": map(detections.snapshot_names.__getitem__, detections.snapshot.tolist()),
        "camera": map(detections.camera_names.__getitem__, detections.camera.tolist()),
        "u": map(repr, detections.uv[:, 0].tolist()),
        "v": map(repr, detections.uv[:, 1].tolist()),
        "sigma": map(repr, detections.sigma.tolist()),
        "radius": (repr(v) if k else "" for v, k in zip(detections.radius.tolist(), known.tolist(), strict=True)),
        "flags": map(str, detections.flags.tolist()),
    }
    if detections.fiducial.max(initial=-1) >= 0:
        columns |= _label_columns(detections.fiducial.tolist(), None if obj is None else obj.rows)
    with replacing(path) as file:
        # No time stamp and no file name inside: equal content gives equal bytes.
        binary = gzip.GzipFile("", "wb", 6, file, mtime=0) if path.suffix == ".gz" else file
        text = io.TextIOWrapper(binary, encoding="utf-8", newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
        text.flush()
        text.detach()
        if binary is not file:
            binary.close()


def require_pixels(detections: Detections, where: Path | str = "detections") -> None:
    """Refuse a whole capture whose centres all lie within a pixel or two of the images' corner.

    Args:
        detections: blobs of all snapshots.
        where: the file.

    Raises:
        InputError: they are normalized by the images' sizes. Only this tells it: some rig fits even these.
    """
    uv = detections.uv
    if len(uv) > 1 and uv.min() >= NORMALIZED[0] and uv.max() <= NORMALIZED[1]:
        raise InputError(
            f"{where}: found u and v between {uv.min():.3g} and {uv.max():.3g} in all rows (normalized by the images' "
            "width and height?), expected pixels"
        )


def _label_columns(rows: Sequence[int], fiducials: Fiducials | None) -> dict[str, Iterable[str]]:
    """Write rows of the object as tables call them: the inverse of `_replace_labels` and `_rows_of_several`."""
    if not isinstance(fiducials, Sequence):
        return {"fiducial": (str(row) if row >= 0 else "" for row in rows)}
    keys = [key if isinstance(key, tuple) else ("", key) for key in fiducials]
    columns: dict[str, Iterable[str]] = {"fiducial": (str(keys[row][1]) if row >= 0 else "" for row in rows)}
    if any(name for name, _ in keys):
        columns = {"object": (keys[row][0] if row >= 0 else "" for row in rows), **columns}
    return columns


def _indices(chunk: Chunk, column: str, known: dict[str, int], allowed: tuple[str, ...] | None) -> NDArray[np.int64]:
    """Replace the names of a column by numbers; new ones are added to `known` unless the names are given."""
    names = chunk.columns[column]
    if allowed is None:
        for name in dict.fromkeys(names):
            if name not in known and not is_file_name(name):
                found = repr(shorten(name)) if name else "an empty cell"
                chunk.fail(names.index(name), f"{column}: found {found}, expected a name that can be a file name")
            known.setdefault(name, len(known))
    else:
        unknown = next((name for name in dict.fromkeys(names) if name not in known), None)
        if unknown is not None:
            chunk.fail(
                names.index(unknown),
                f"camera: found {shorten(unknown)!r} (this file: {shorten(', '.join(dict.fromkeys(names)))}), "
                f"expected a camera of the rig: {list_names(allowed)}{nearest(unknown, allowed)}",
            )
    return np.fromiter(map(known.__getitem__, names), dtype=np.int64, count=len(names))


def _numbers(chunk: Chunk, fiducials: Fiducials | None) -> dict[str, NDArray[np.float64]]:
    """Convert the numeric columns; absent ones get their defaults."""
    count = len(chunk)
    result = {axis: chunk.numbers(axis, limits.PIXEL, f"a finite pixel coordinate, {limits.PIXEL}") for axis in "uv"}
    result["sigma"] = np.full(count, DEFAULT_SIGMA)
    if "sigma" in chunk.columns:
        result["sigma"] = chunk.numbers("sigma", limits.SIGMA, f"a standard deviation > 0, {limits.SIGMA}")
    result["fiducial"] = np.full(count, -1.0)
    if "fiducial" in chunk.columns:
        filled = _fill_column(chunk, "fiducial", "-1")
        if isinstance(fiducials, Sequence) and isinstance(fiducials[0], tuple):
            result["fiducial"] = _rows_of_several(filled, [key for key in fiducials if isinstance(key, tuple)])
        elif len({name for name in chunk.columns.get("object", ()) if name}) > 1:
            chunk.fail(0, "object: found labels of several objects, expected those of one; name all of them")
        elif isinstance(fiducials, Sequence):
            result["fiducial"] = _replace_labels(filled, fiducials)
        else:
            last = limits.MOST_FIDUCIALS if fiducials is None else fiducials - 1
            result["fiducial"] = filled.numbers(
                "fiducial", limits.Range(-1, last, ""), f"a row of the object, 0 to {last}", whole=True
            )
    result["radius"] = np.full(count, np.nan)
    if "radius" in chunk.columns:
        radius = _fill_column(chunk, "radius", "0").numbers(
            "radius", limits.BLOB_RADIUS, f"a radius, {limits.BLOB_RADIUS}"
        )
        result["radius"] = np.where(radius > 0, radius, np.nan)
    result["flags"] = np.zeros(count)
    if "flags" in chunk.columns:
        bits = limits.Range(0, 2 * max(BlobFlag) - 1, "")
        result["flags"] = chunk.numbers("flags", bits, f"a sum of flag bits, {bits}", whole=True)
    return result


def _rows_of_several(chunk: Chunk, keys: Sequence[tuple[str, int]]) -> NDArray[np.float64]:
    """Replace objects and their fiducials by rows among all fiducials."""
    plausible = limits.Range(-1, 2**31 - 1, "")
    named = chunk.numbers("fiducial", plausible, "a number of the object's fiducials", whole=True).astype(int).tolist()
    objects = [name.strip() for name in chunk.columns.get("object", ("",) * len(chunk))]
    row = {key: number for number, key in enumerate(keys)}
    known = list(dict.fromkeys(name for name, _ in keys))
    rows = [-1 if label == -1 else row.get((name, label), -2) for name, label in zip(objects, named, strict=True)]
    if -2 in rows:
        bad = rows.index(-2)
        if objects[bad] not in known:
            found = f"found {shorten(objects[bad])!r}" if "object" in chunk.columns else "found no such column"
            chunk.fail(bad, f"object: {found}, expected the object of each labelled blob: {list_names(known)}")
        chunk.fail(bad, f"fiducial: found {named[bad]}, expected a fiducial of object {objects[bad]}")
    return np.array(rows, dtype=np.float64)


def _replace_labels(chunk: Chunk, labels: Sequence[Any]) -> NDArray[np.float64]:
    """Replace what a table calls the fiducials by their rows in the object."""
    plausible = limits.Range(-1, 2**31 - 1, "")
    named = chunk.numbers("fiducial", plausible, "a number of the object's column `fiducial`", whole=True)
    row = {-1: -1, **{label: number for number, label in enumerate(labels)}}
    unknown = [k for k, label in enumerate(named.astype(int).tolist()) if label not in row]
    if unknown:
        chunk.fail(
            unknown[0],
            f"fiducial: found {int(named[unknown[0]])}, expected a number of the object's column `fiducial`: "
            f"{list_names([str(label) for label in labels])}",
        )
    return np.array([row[label] for label in named.astype(int).tolist()], dtype=np.float64)


def _fill_column(chunk: Chunk, column: str, default: str) -> Chunk:
    """Replace the empty cells of a column."""
    cells = tuple(cell or default for cell in chunk.columns[column])
    return Chunk(chunk.path, chunk.first_row, {**chunk.columns, column: cells})


def _check_inside(chunk: Chunk, part: dict[str, NDArray[Any]], rig: CameraRig) -> None:
    size = rig.image_size.cpu().numpy()[part["camera"]]
    uv = np.stack((part["u"], part["v"]), axis=1)
    outside = ((uv < -0.5 - MARGIN) | (uv > size - 0.5 + MARGIN)).any(axis=1) & (part["camera"] != LEFT_OUT)
    if outside.any():
        row = int(outside.argmax())
        u, v = (shorten(chunk.columns[axis][row]) for axis in "uv")
        camera, (width, height) = chunk.columns["camera"][row], size[row]
        chunk.fail(
            row,
            f"found ({u}, {v}), expected a pixel of the {width}x{height} image of camera {camera}",
        )


def _check_unique(path: Path, detections: Detections) -> None:
    """Refuse a fiducial that one camera saw twice in one snapshot."""
    row = detections.find_repeated_label()
    if row is not None:
        camera = detections.camera_names[detections.camera[row]]
        place = f"camera {camera} in snapshot {detections.snapshot_names[detections.snapshot[row]]}"
        fail_row(path, row, f"found fiducial {detections.fiducial[row]} again for {place}, expected it once")
