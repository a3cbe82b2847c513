"""All formats, and which one a file is."""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from imgcal.errors import InputError
from imgcal.formats import (
    colmap_binary,
    colmap_text,
    easymocap,
    kalibr,
    motive,
    mrcal,
    multical,
    opencv_multiview,
    opencv_stereo,
    pymvg,
    qualisys,
    ros_camera_info,
    toml_cameras,
    vicon,
)
from imgcal.formats.documents import Document
from imgcal.formats.file_storage import is_matrix, merge_storages
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, coinciding_cameras, known_points
from imgcal.formats.format import Files, Format
from imgcal.formats.limits import ROUNDING
from imgcal.formats.source import Source
from imgcal.io import is_file_name
from imgcal.messages import list_names, name_cameras, with_article
from imgcal.types import limits

FORMATS = (  # asked in this order: who knows a file by more comes before who knows it by less
    colmap_text.FORMAT,
    colmap_binary.FORMAT,
    opencv_multiview.FORMAT,
    easymocap.FORMAT,
    opencv_stereo.FORMAT,
    kalibr.FORMAT,
    ros_camera_info.FORMAT,
    pymvg.FORMAT,
    multical.FORMAT,
    mrcal.FORMAT,
    colmap_text.CONFIG,
    toml_cameras.FREEMOCAP,
    toml_cameras.CALISCOPE,
    toml_cameras.OLD_CALISCOPE,
    toml_cameras.POSE2SIM,
    toml_cameras.ANIPOSE,
    qualisys.FORMAT,
    motive.FORMAT,
    vicon.FORMAT,
)
COPIES = {
    colmap_text.FORMAT.name: colmap_binary.FORMAT,
    colmap_binary.FORMAT.name: colmap_text.FORMAT,
}
"""Formats in which a tool keeps the same calibration twice, in one folder."""

ORIGINALS = {
    colmap_text.FORMAT.name: (colmap_text.CONFIG.name,),
    colmap_binary.FORMAT.name: (colmap_text.CONFIG.name,),
    toml_cameras.POSE2SIM.name: (qualisys.FORMAT.name, vicon.FORMAT.name),
}
"""What a tool makes its own file from, and leaves beside it."""

COLMAP_STEMS = frozenset(("cameras", "images", "rigs", "frames", "points3D"))
BY_NAME = {one.name: one for one in FORMATS}
NATIVE = re.compile(rb"(?m)^[\"']?format[\"']?[ \t]*:")


def read_foreign_rig(
    paths: str | Path | Sequence[str | Path], name: str | None = None, rig: str | None = None
) -> ForeignRig:
    """Read a calibration of another tool.

    Args:
        paths: a file, a folder, or the files that are one calibration together.
        name: of the format, as in `FORMATS`; None = by what stands in the files.
        rig: name of the rig, where the files hold several (COLMAP).

    Raises:
        InputError: one line with the file, what it is and what it lacks.
    """
    source = Source([Path(one) for one in ([paths] if isinstance(paths, str | Path) else paths)], rig)
    one = recognize_format(source) if name is None else _check_requested(source, find_format(name))
    found = _read(source, one)
    _check_others(found, source, one, by_content=name is None)
    return _check_placed(found, source, one)


def read_foreign_lenses(path: str | Path, name: str | None = None) -> ForeignRig:
    """Read the cameras of another tool's file without their places: it need not have any.

    Args:
        path: a file, or a folder.
        name: of the format, as in `FORMATS`; None = by what stands in the files.

    Returns:
        The cameras, in unknown places; `unit` is none.

    Raises:
        InputError: one line with the file, what it is and what it lacks.
    """
    source = Source([Path(path)])
    one = recognize_format(source) if name is None else _check_requested(source, find_format(name))
    read = one.read_lenses
    if read is not None:
        one = replace(one, read=lambda found: ForeignRig(one.name, tuple(read(found)), None, "unknown"))
    rig = _read(source, one)
    _check_others(rig, source, one, by_content=name is None)
    return rig


def read_back(files: Files, name: str, rig: str | None = None) -> ForeignRig:
    """Read files that are not written yet; arguments as for `read_foreign_rig`.

    Raises:
        FormatError: they cannot be read.
    """
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / (file or "calibration.txt") for file in files]
        for path, content in zip(paths, files.values(), strict=True):
            path.write_bytes(content)
        try:
            return read_foreign_rig(paths[0] if len(paths) == 1 else folder, name, rig)
        except InputError as error:
            raise FormatError(f"what was written cannot be read back: {str(error).replace(folder, '')}") from error


def find_format(name: str) -> Format:
    """Find a format by its name.

    Raises:
        InputError: there is none of that name.
    """
    if name not in BY_NAME:
        raise InputError(f"found the format {name!r}, expected one of imgcal, {', '.join(sorted(BY_NAME))}")
    return BY_NAME[name]


def recognize_format(source: Source) -> Format:
    """Recognize a format by content.

    Raises:
        InputError: nothing here is a calibration; the line says what it is instead, where that is known.
    """
    for one in FORMATS:
        try:
            if one.recognizes(source):
                return one
        except FormatError as error:
            raise InputError(f"{source.where}: {error}") from error
    if source.alone and source.unreadable:
        raise source.unreadable[0]
    raise InputError(f"{source.where}: {_explain_no_rig(source)}")


def _check_requested(source: Source, one: Format) -> Format:
    """Check that a file can be of the format that the user names."""
    try:
        if (one.accepts or one.recognizes)(source):
            return one
    except FormatError as error:
        raise InputError(f"{source.where}: {error}") from error
    found = _name_other_format(source) or _explain_no_rig(source)
    raise InputError(f"{source.where}: this is not {with_article(one.title)}: {found}")


def _name_other_format(source: Source) -> str:
    """Name the format that it is instead; empty if none."""
    try:
        found = recognize_format(source)
    except InputError:
        return ""
    return f"it is {with_article(found.title)} ({found.name})"


def is_foreign(path: Path) -> bool:
    """Tell whether a path that exists is not a rig file of our own: a folder, or a file without the key `format`."""
    if path.is_dir():
        return True
    try:
        with open(path, "rb") as file:
            return path.is_file() and not NATIVE.search(file.read(2**16))
    except OSError:
        return False


def _explain_no_rig(source: Source) -> str:
    """Explain what a source without a rig is, as far as it can be recognized."""
    values = merge_storages(source)
    if is_matrix(values.get("camera_matrix")) or is_matrix(values.get("cameraMatrix")) or is_matrix(values.get("K")):
        return (
            "this is an OpenCV calibration of one camera: its extrinsics are those of the boards, and a rig needs the "
            "poses of its cameras"
        )
    if {"R", "T"} <= values.keys() and is_matrix(values["R"]):
        return (
            "this is an OpenCV file with only extrinsics: give the file with M1, D1, M2, D2 as well, or the folder of "
            "both"
        )
    if isinstance(values.get("frames"), list) and ("transform_matrix" in str(values["frames"][:1])):
        return "this is a transforms.json of nerfstudio: convert its COLMAP model instead"
    if any(path.suffix == ".cal" for path in source.files):
        return "this looks like a Motive .cal, which is binary and not documented: export .mcal (Motive 3.2 or newer)"
    found = (
        f"found {source.describe()}" if not source.alone else f"found none of the keys of a calibration{_keys(values)}"
    )
    return f"{found}, expected a rig file (`format: imgcal-rig/1`), or another tool's: {', '.join(BY_NAME)}"


def _keys(values: dict[str, object]) -> str:
    return f" (its keys: {', '.join(key[:20] for key in list(values)[:6])})" if values else ""


def _read(source: Source, one: Format) -> ForeignRig:
    try:
        rig = one.read(source)
        copy = COPIES.get(one.name)
        if copy is not None and copy.recognizes(source):
            rig = _join_copy(rig, copy, source)
    except FormatError as error:
        raise InputError(f"{source.where}: this is {with_article(one.title)}: {error}") from error
    if len(rig.cameras) > limits.MOST_CAMERAS:
        raise InputError(f"{source.where}: found {len(rig.cameras)} cameras, expected at most {limits.MOST_CAMERAS}")
    return _make_names_sound(replace(rig, format=one.name))


def _check_others(rig: ForeignRig, source: Source, one: Format, *, by_content: bool) -> None:
    """Check that no file holds another calibration, and that every file that the user names is of use.

    Args:
        rig: as it was read.
        source: its files, and perhaps others.
        one: its format.
        by_content: the user has not named the format: a folder must not hold another calibration.

    Raises:
        InputError: there is one, or a file is of no use.
    """
    if source.alone:
        return
    used = {place.path for camera in rig.cameras for place in camera.places}
    used = used or {document.path for document in source.documents if one.recognizes(source.of_document(document))}
    others = {}
    for document in source.documents:
        if document.path not in used and (by_content or document.path in source.paths):
            name = _recognize_document(source, document)
            if name and name not in ORIGINALS.get(one.name, ()):
                others[document.path] = name
    if others:
        found = [f"{list_names(sorted(path.name for path in used))} ({one.name})"]
        found += [f"{path.name} ({name})" for path, name in others.items()]
        raise InputError(f"{source.where}: found {', '.join(found)}: give the files of one calibration")
    for path in source.paths:
        if path.is_file() and path not in used and not _is_needed(path, rig, source, one):
            raise InputError(f"{path}: found no part of {with_article(one.title)} in it, expected only its files")


def _recognize_document(source: Source, document: Document) -> str:
    """Name the format of a document alone; empty where it is no calibration."""
    value = document.value
    if isinstance(value, dict) and str(value.get("format")).startswith("imgcal-rig/"):
        return "imgcal"
    part = source.of_document(document)
    for one in FORMATS:
        with contextlib.suppress(FormatError):
            if one.recognizes(part):
                return one.name
    return ""


def _is_needed(path: Path, rig: ForeignRig, source: Source, one: Format) -> bool:
    """Tell whether a file without numbers of a camera says something: the size of images, for example."""
    if one.name in COPIES and path.stem in COLMAP_STEMS:
        return True
    try:
        rest = _read(Source([other for other in source.paths if other != path], source.rig), one)
    except InputError:
        return True
    described = [[(camera.name, camera.lens, camera.image_size) for camera in each.cameras] for each in (rig, rest)]
    return described[0] != described[1]


def _check_placed(rig: ForeignRig, source: Source, one: Format) -> ForeignRig:
    """Note cameras that have the pose of another one.

    Raises:
        InputError: all cameras have one pose.
    """
    groups = coinciding_cameras(rig)
    if groups and len(groups[0]) == len(rig.cameras):
        raise InputError(
            f"{source.where}: this is {with_article(one.title)}: {name_cameras(groups[0])}: all are at one place and "
            "look the same way: extrinsics were never calibrated; imgcal calibrate --cameras finds the poses"
        )
    notes = [
        f"{name_cameras(names)}: at one place, looking the same way: right for streams of one device, else their "
        "extrinsics were never calibrated"
        for names in groups
    ]
    return replace(rig, notes=(*rig.notes, *notes))


def _join_copy(rig: ForeignRig, one: Format, source: Source) -> ForeignRig:
    """Add the places of a copy of the rig in another format, so that both copies are written back.

    Raises:
        FormatError: the copy cannot be read, or says something else.
    """
    beside = f"found {with_article(one.title)} beside it"
    try:
        copy = one.read(source)
    except FormatError as error:
        raise FormatError(f"{beside}: {error}") from error
    pairs = list(zip(rig.cameras, copy.cameras, known_points(rig), strict=False))
    off = float(np.max([np.abs(other.project(points) - camera.project(points)) for camera, other, points in pairs]))
    if rig.names != copy.names or not off <= ROUNDING:
        differing = "other cameras" if rig.names != copy.names else f"cameras that are {off:.3g} px off"
        raise FormatError(f"{beside} with {differing}: remove the one that is out of date")
    cameras = [replace(camera, places=camera.places + other.places) for camera, other, _ in pairs]
    return replace(rig, cameras=tuple(cameras))


def _make_names_sound(rig: ForeignRig) -> ForeignRig:
    """Names are files of a capture, too: without slashes, each once."""
    cameras: list[ForeignCamera] = []
    renamed, frame = [], rig.frame
    for number, camera in enumerate(rig.cameras, start=1):
        name = (
            camera.name
            if is_file_name(camera.name)
            else re.sub(r"[/\\]+", "_", camera.name.strip().strip("/\\.")).strip()
        )
        name = name if is_file_name(name) else f"camera{number}"
        taken = {one.name for one in cameras}
        name = name if name not in taken else next(f"{name}_{n}" for n in range(2, 1000) if f"{name}_{n}" not in taken)
        if name != camera.name:
            renamed.append(f"{camera.name[:40]} -> {name}")
            frame = frame.replace(f"camera {camera.name}", f"camera {name}")
        cameras.append(replace(camera, name=name))
    notes = (f"cameras renamed: {', '.join(renamed[:8])}",) if renamed else ()
    return replace(rig, cameras=tuple(cameras), frame=frame, notes=rig.notes + notes)
