"""Detect the blobs of a capture on disk, with only one snapshot in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from imgcal.association import Sight
from imgcal.detection import Blobs, DetectionOptions, detect_snapshot, drop_dim, require_board, to_detections
from imgcal.errors import InputError
from imgcal.io import Capture, Frame
from imgcal.pipeline.learned_measurer import LearnedMeasurer
from imgcal.pipeline.sources import DetectorName, choose_proposer
from imgcal.types import Board, Detections

Snapshots = Iterable[tuple[str, dict[str, Frame | None]]]
Bar = Callable[[Snapshots, int], Snapshots]


def detect_capture(
    capture: Capture,
    first: int = 0,
    last: int | None = None,
    options: DetectionOptions = DetectionOptions(),
    measurer: LearnedMeasurer | None = None,
    board: Board | None = None,
    bar: Bar = lambda snapshots, count: snapshots,
) -> tuple[Detections, dict[str, Frame | None]]:
    """Find blobs in the frames of a capture.

    Args:
        capture: the capture.
        first: number of the first snapshot.
        last: number of the snapshot to stop before; None = to the end.
        options: what counts as a blob.
        measurer: measures the blobs of frames again.
        board: a printed board, whose points are found instead of blobs.
        bar: wraps the loop over snapshots, for a progress bar.

    Returns:
        The blobs, and the frames of the first snapshot, for pictures.

    Raises:
        InputError: a frame cannot be read, or no frame shows the board.
    """
    names, masks = capture.snapshot_names[first:last], read_masks(capture)
    found: list[Blobs] = []
    shown: dict[str, Frame | None] = {}
    with ThreadPoolExecutor() as pool:
        for _, frames in bar(capture.snapshots(first, last), len(names)):
            shown = shown or dict(frames)
            blobs = detect_snapshot(frames, options, masks=masks, pool=pool, whole_capture=True, board=board)
            found.append(blobs if measurer is None else measurer(frames, blobs, options))
    if board is not None:
        if measurer is not None:
            raise InputError(f"measurer {measurer.name}: found a printed board, expected an object with markers")
        require_board(found, (frames for _, frames in capture.snapshots(first, last)), board)
        return to_detections(found, capture.camera_names, names), shown
    return to_detections(drop_dim(found, options), capture.camera_names, names), shown


def read_masks(capture: Capture) -> dict[str, NDArray[np.bool_]]:
    """Read the cameras' masks (H, W), where present: True = ignore this pixel."""
    return {camera: mask for camera in capture.camera_names if (mask := capture.mask(camera)) is not None}


def capture_sight(
    capture: Capture,
    detector: DetectorName,
    options: DetectionOptions = DetectionOptions(),
    first: int = 0,
    measurer: LearnedMeasurer | None = None,
) -> Sight:
    """Prepare a detector other than blobs for the frames of a capture.

    Args:
        capture: the capture.
        detector: its name or file.
        options: how blobs are found as well.
        first: number of the first snapshot.
        measurer: reads the markers that a network finds.

    Raises:
        InputError: there is no such detector.
    """
    proposer, where_blobs_fail = choose_proposer(detector, measurer)
    return Sight(proposer, lambda s: capture.frames_of(first + s), where_blobs_fail, options, read_masks(capture))
