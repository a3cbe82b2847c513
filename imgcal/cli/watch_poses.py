"""Outputs of `imgcal watch --poses`: files and addresses, told apart by their names."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from imgcal.errors import InputError
from imgcal.extras import advice, missing
from imgcal.messages import shorten
from imgcal.types import CalibrationObject, CameraRig
from imgcal.watch import MarkerFile, OpenIGTLink, PoseFile, PosePublisher, Poses, PoseSink, listening_address

MARKER_SUFFIXES, TABLE_SUFFIXES = (".c3d", ".trc"), (".csv", ".jsonl")
POSE_OUTPUTS = "FILE.csv, FILE.jsonl, FILE.c3d, FILE.trc, tcp://HOST:PORT, ipc://PATH or igtl://[HOST:]PORT"


def check_pose_outputs(names: tuple[str, ...], obj: CalibrationObject, out: Path) -> None:
    """Refuse outputs of poses that cannot be, before anything is written.

    Args:
        names: files and addresses.
        obj: the object whose pose they get.
        out: output folder, which may not exist yet.

    Raises:
        InputError: names the first of them, and what it could be.
    """
    for number, name in enumerate(names):
        path, (scheme, separator, _) = Path(name), name.partition("://")
        is_file, suffix = not separator, path.suffix.lower()
        if name in names[:number]:
            raise InputError(f"--poses: found {shorten(name)} twice, expected each output once")
        if not is_file and scheme not in ("tcp", "ipc", "igtl"):
            raise InputError(f"--poses: found {shorten(name)!r}, expected {POSE_OUTPUTS}")
        if is_file and suffix not in (*MARKER_SUFFIXES, *TABLE_SUFFIXES):
            raise InputError(f"--poses: found {shorten(name)!r}, expected {POSE_OUTPUTS}")
        if obj.pose_rank == 3 and not (is_file and suffix in MARKER_SUFFIXES):
            found = f"found {shorten(name)!r} with {shorten(obj.name or 'a light')}, which has no pose"
            raise InputError(f"--poses: {found}, expected FILE.c3d or FILE.trc: points")
        if is_file and path.is_dir():
            raise InputError(f"--poses: {shorten(name)}: found a folder, expected a file")
        if is_file and not (path.parent.is_dir() or out.resolve().is_relative_to(path.parent.resolve())):
            raise InputError(f"--poses: {shorten(name)}: found no folder {path.parent}, expected one")
        if is_file and path.parent.is_dir() and not os.access(path.parent, os.W_OK):
            raise InputError(f"--poses: {shorten(name)}: no permission to write to {path.parent}")


@contextlib.contextmanager
def open_pose_outputs(names: tuple[str, ...], rig: CameraRig, obj: CalibrationObject) -> Iterator[list[Poses]]:
    """Open outputs of poses; they are closed at the end of the block.

    Tables come last, when all others are known to work: opening one makes a file.

    Raises:
        InputError: one cannot be opened.
    """
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(Poses(name, _open_sink(name, rig, obj))) for name in sorted(names, key=_is_table)]


def _is_table(name: str) -> bool:
    return "://" not in name and Path(name).suffix.lower() in TABLE_SUFFIXES


def _open_sink(name: str, rig: CameraRig, obj: CalibrationObject) -> PoseSink:
    scheme, separator, _ = name.partition("://")
    if not separator and Path(name).suffix.lower() in MARKER_SUFFIXES:
        return MarkerFile(Path(name), rig, obj)
    if not separator:
        return PoseFile(Path(name))
    if scheme == "igtl":
        return OpenIGTLink(*listening_address(name))
    if missing("zmq"):
        raise InputError(f"--poses: {shorten(name)} {advice('zmq')}")
    return PosePublisher(name)
