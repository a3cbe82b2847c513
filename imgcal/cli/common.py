"""What several commands share: loading inputs, snapshot ranges, progress bars."""

from __future__ import annotations

import ctypes
import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from imgcal.cli.arguments import StartPose
from imgcal.detection import DetectionOptions
from imgcal.errors import InputError
from imgcal.formats import find_format, is_foreign, load_rig, read_foreign_rig
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import Capture, Frame
from imgcal.messages import plural, shorten, with_article
from imgcal.pipeline import LearnedMeasurer, detect_capture
from imgcal.types import Board, CameraRig, Detections

Item = TypeVar("Item")
RESULT = "result.json"
"""File of a calibration's result for scripts."""
EVERY = 60.0  # s between lines on progress without a terminal
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # as glibc's malloc.h numbers them
KEPT, LARGEST = 256 << 20, 32 << 20  # bytes: that are free and kept, and of an array that is


def open_rig(given: str) -> CameraRig:
    """Read what a user gives as `--rig`: a rig file, the name of a shipped rig, or a calibration of another tool.

    Raises:
        InputError: as `load_rig`; or it is another tool's file of a single camera, which says nothing of a rig.
    """
    rig, path = load_rig(given), Path(given)
    if rig.num_cameras == 1 and path.exists() and is_foreign(path):
        title = find_format(read_foreign_rig(path).format).title
        raise InputError(
            f"{given}: this is {with_article(title)} of one camera, without its pose in the rig; give the folder "
            f"of all files, or make a rig from this one camera: imgcal convert {given} --out rig.yaml"
        )
    return rig


def parse_range(text: str | None) -> tuple[int, int | None]:
    """Read `A:B` (either may be left out) as numbers of snapshots, B excluded."""
    if text is None:
        return 0, None
    match = re.fullmatch(r"(\d{0,18}):(\d{0,18})", text)
    if not match:
        raise InputError(f"--snapshots: found {shorten(text)!r}, expected A:B, numbers in file order from 0, without B")
    first, last = int(match[1] or 0), int(match[2]) if match[2] else None
    if last is not None and last <= first:
        raise InputError(f"--snapshots: found the empty range {text!r}, expected A < B")
    return first, last


def read_detections(
    source: Capture | Detections,
    snapshots: str | None,
    options: DetectionOptions,
    measurer: LearnedMeasurer | None = None,
    board: Board | None = None,
) -> tuple[Detections, dict[str, Frame | None]]:
    """Take detections from a file as they are, or find blobs in the frames of a capture.

    Args:
        source: what was opened.
        snapshots: A:B, or None for all.
        options: what counts as a blob.
        measurer: measures the blobs of frames again.
        board: the printed board whose points are found instead of blobs.

    Returns:
        The detections of the chosen snapshots, and the frames of the first one, for pictures (empty without frames).

    Raises:
        InputError: the range of snapshots is empty, or a measurer has no frames.
    """
    first, last = parse_range(snapshots)
    count = len(source.snapshot_names)
    if first >= count:
        raise InputError(
            f"--snapshots: found {snapshots}, expected a range within the {plural(count, 'snapshot')} of the input"
        )
    if isinstance(source, Detections):
        if measurer is not None:
            raise InputError(f"--measurer {measurer.name}: found blobs without frames, expected a capture with frames")
        return source.of_snapshots(first, count if last is None else min(last, count)), {}
    bar = partial(progress, label="detecting blobs")
    return detect_capture(source, first, last, options, measurer, board, bar)


def require_board_files(objects: Sequence[str], source: Capture | Detections) -> None:
    """Require a board's own file for frames: its points alone do not say how they are printed.

    Raises:
        InputError: an object is the `object.csv` of a calibration from a printed board.
    """
    for given in objects:
        path = Path(given)
        board = path.with_name("board.yaml")
        if isinstance(source, Capture) and path.name == "object.csv" and board.is_file():
            raise InputError(
                f"--object {given}: found the corners of a printed board, which frames show without markers; expected "
                f"the board's file, {board}"
            )


def progress(items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
    """Show a progress bar while going through `items`; see `progress_bar`."""
    with progress_bar(label, total) as advance:
        for item in items:
            yield item
            advance(1)


def start_pose(values: StartPose | None) -> RigidTransform | None:
    """Make rig_from_object of a rotation vector (rad) and a translation (mm)."""
    if values is None:
        return None
    if not all(map(math.isfinite, values)):
        raise InputError(f"--start-pose: found {' '.join(map(str, values))}, expected six finite numbers")
    numbers = torch.tensor(values, dtype=torch.float64)
    return RigidTransform(rotation_from_vector(numbers[:3]), numbers[3:])


def drop_cameras(rig: CameraRig, names: tuple[str, ...]) -> CameraRig:
    """Leave cameras out of a rig."""
    if set(rig.camera_names) <= set(names):
        raise InputError(f"--without: found all {rig.num_cameras} cameras of the rig, expected at least one to remain")
    return rig.select([i for i, name in enumerate(rig.camera_names) if name not in names])


def select_cameras(detections: Detections, rig: CameraRig) -> Detections:
    """Leave out the blobs of cameras that a reduced rig does not have."""
    kept = [name in rig.camera_names for name in detections.camera_names]
    number = np.cumsum(kept) - 1
    rows = np.array(kept, dtype=bool)[detections.camera] if len(detections) else np.zeros(0, dtype=bool)
    some = detections.select(rows)
    names = tuple(name for name, keep in zip(detections.camera_names, kept, strict=True) if keep)
    return replace(some, camera=number[some.camera].astype(np.int64), camera_names=names)


def check_folder(path: Path) -> None:
    """Make sure, before any work, that an output folder exists or can be made."""
    existing = path
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        found = "found a file" if existing == path else f"{existing} is a file"
        raise InputError(f"{path}: {found}, expected a folder to write to")
    if not os.access(existing, os.W_OK):
        raise InputError(f"{path}: no permission to write to {existing}")


def check_inputs_survive(out: Path, written: Iterable[str], inputs: Iterable[tuple[str, Path]]) -> None:
    """Make sure that no input would be overwritten.

    Args:
        out: the output folder.
        written: names of the files that are written to it.
        inputs: the option of each input, and its path.

    Raises:
        InputError: names the file and the option.
    """
    for name in written:
        for option, given in inputs:
            if (out / name).exists() and given.exists() and (out / name).samefile(given):
                raise InputError(f"--out: {out / name} is also the input of {option}, expected another folder")


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show progress on standard error: a bar on a terminal, a line a minute elsewhere.

    Args:
        what: that is done.
        total: number of items.

    Yields:
        A function to call with the number of items that have been done since the last call.
    """
    console = Console(file=sys.stderr)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    if not console.is_terminal:  # some versions of rich write a line even where it is disabled
        yield _count_by_lines(what, total)
        return
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.advance(task, done)


def _count_by_lines(what: str, total: int) -> Callable[[int], None]:
    """Make a function that counts what is done, and prints the count at most once in `EVERY` seconds."""
    count, printed = 0, math.inf

    def advance(done: int) -> None:
        nonlocal count, printed
        now = time.monotonic()
        count, printed = count + done, min(printed, now)
        if count < total and now - printed > EVERY:
            printed = now
            print(f"{what}: {count:,} of {total:,}", file=sys.stderr, flush=True)

    return advance


def keep_memory() -> bool:
    """Let the allocator keep what was freed, and tell whether it does: glibc's can.

    Networks and maps make arrays of some megabytes for every snapshot. Given back each time, their pages are new each
    time, and the kernel takes longer to clear them than the arithmetic takes.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library, or Windows
        return False
    return bool(mallopt(TRIM_THRESHOLD, KEPT) and mallopt(MMAP_THRESHOLD, LARGEST))
