"""Detection of blobs: from frames to `Detections`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.blob_search import find_blobs
from imgcal.detection.boards import find_board, require_board
from imgcal.detection.centroids import Blobs, to_detections
from imgcal.detection.checks import Frame, check_frame, check_mask, full_scale
from imgcal.detection.options import DetectionOptions
from imgcal.detection.populations import drop_dim
from imgcal.errors import InputError
from imgcal.types import BlobFlag, Board, Detections

ANGLES = np.linspace(0, 2 * np.pi, 16, endpoint=False)
OUTLINE = np.concatenate(([[0.0, 0.0]], np.stack((np.cos(ANGLES), np.sin(ANGLES)), axis=1)))
"""Centre and outline of a blob of radius 1, where it is compared with a mask."""

Mask = NDArray[np.bool_] | NDArray[np.uint8]  # (H, W) non-zero inside known reflections


def detect(
    frames: Mapping[str, Frame | Sequence[Frame | None] | None],
    options: DetectionOptions | None = None,
    *,
    masks: Mapping[str, Mask] | None = None,
    board: Board | None = None,
) -> Detections:
    """Detect the blobs of all cameras in one or several snapshots.

    Args:
        frames: camera name -> frame (H, W) uint8 or uint16, or one frame per snapshot; None = no frame.
        options: what counts as a blob.
        masks: camera name -> (H, W), non-zero inside known reflections; blobs that reach there are flagged.
        board: a printed board to detect instead of blobs; its points are labelled.

    Raises:
        InputError: no frame shows the board; a frame is no grey image, or cameras differ in their number of snapshots.

    Examples:
        >>> import imgcal
        >>> from imgcal.io import data_path, open_capture
        >>> capture = open_capture(data_path("samples", "O10"))
        >>> _, frames = next(iter(capture.snapshots(0, 1)))  # {camera: (H, W) array}
        >>> blobs = imgcal.detect(frames)
        >>> len(blobs.camera_names), bool((blobs.sigma[blobs.usable] < 0.1).all())
        (10, True)
    """
    options = options or DetectionOptions()
    if not isinstance(frames, Mapping):
        raise InputError(f"frames: found a {type(frames).__name__}, expected {{camera name: frame or frames}}")
    names = tuple(frames)
    unknown = sorted(set(masks or ()) - set(names))
    if unknown:
        raise InputError(f"masks: found camera {unknown[0]}, expected one of {', '.join(names)}")
    snapshots = _snapshots(frames)
    if not snapshots:
        raise InputError("frames: found no snapshot, expected at least one frame for each camera")
    with ThreadPoolExecutor(_count_workers(len(names))) as pool:
        blobs = [
            detect_snapshot(snapshot, options, masks=masks, pool=pool, whole_capture=True, board=board)
            for snapshot in snapshots
        ]
    if board is not None:
        require_board(blobs, snapshots, board)
    digits = len(str(max(len(blobs) - 1, 0)))
    numbers = tuple(f"{index:0{digits}d}" for index in range(len(blobs)))
    return to_detections(drop_dim(blobs, options), names, numbers)


def detect_snapshot(
    frames: Mapping[str, Frame | None],
    options: DetectionOptions,
    *,
    masks: Mapping[str, Mask] | None = None,
    pool: ThreadPoolExecutor | None = None,
    whole_capture: bool = False,
    board: Board | None = None,
) -> Blobs:
    """Detect the blobs of one snapshot; `Blobs.camera` indexes the cameras in the order of `frames`.

    Args:
        frames: camera name -> frame (H, W), None = missing.
        options: what counts as a blob.
        masks: camera name -> (H, W).
        pool: threads that persist between snapshots; None = a pool for this call.
        whole_capture: skip `drop_dim`, because the caller applies it to all snapshots together.
        board: as in `detect`; a snapshot without it is no error.
    """
    if pool is None:
        with ThreadPoolExecutor(_count_workers(len(frames))) as own_pool:
            return detect_snapshot(
                frames, options, masks=masks, pool=own_pool, whole_capture=whole_capture, board=board
            )
    present = [(camera, name) for camera, name in enumerate(frames) if frames[name] is not None]
    images = [check_frame(frames[name], name) for _, name in present]
    covered = [
        None if masks is None or name not in masks else check_mask(masks[name], image, name)
        for image, (_, name) in zip(images, present, strict=True)
    ]
    names = [name for _, name in present]
    # OpenCV and the compiled functions release the GIL, so frames are processed in parallel.
    found = list(pool.map(_detect_one, images, names, covered, [options] * len(images), [board] * len(images)))
    camera = np.repeat([camera for camera, _ in present], [len(blobs.uv) for blobs in found]).astype(np.int64)
    blobs = Blobs(
        np.concatenate([np.zeros((0, 2)), *(blobs.uv for blobs in found)]),
        np.concatenate([np.zeros(0), *(blobs.sigma for blobs in found)]),
        np.concatenate([np.zeros(0), *(blobs.radius for blobs in found)]),
        np.concatenate([np.zeros(0, np.uint8), *(blobs.flags for blobs in found)]),
        camera,
        np.concatenate([np.zeros(0), *(blobs.contrast for blobs in found)]),
        np.concatenate([np.zeros(0, np.int64), *(blobs.fiducial for blobs in found)]),
        np.concatenate([np.zeros(0), *(blobs.blur for blobs in found)]),
    )
    return blobs if whole_capture or board is not None else drop_dim([blobs], options)[0]


def detect_frame(frame: Frame, options: DetectionOptions, mask: Mask | None = None) -> Blobs:
    """Detect the blobs of one frame (H, W)."""
    return detect_snapshot({"frame": frame}, options, masks=None if mask is None else {"frame": mask})


def _detect_one(
    frame: Frame, name: str, mask: NDArray[np.bool_] | None, options: DetectionOptions, board: Board | None
) -> Blobs:
    """Detect the blobs of one checked frame, or the points of a board; their camera is 0."""
    if board is not None:
        points = find_board(frame, board)
        return points if mask is None else points.select(~_is_in_mask(mask, points.uv))
    blobs = find_blobs(frame, options, full_scale(frame, options.bit_depth, name))
    if mask is not None:
        reach = blobs.uv[:, None] + blobs.radius[:, None, None] * OUTLINE
        touching = _is_in_mask(mask, reach.reshape(-1, 2)).reshape(-1, len(OUTLINE)).any(axis=1)
        blobs.flags[touching] |= np.uint8(BlobFlag.MASKED)
    return blobs


def _is_in_mask(mask: NDArray[np.bool_], uv: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Check which pixels (K, 2) lie inside a mask (H, W)."""
    pixel = np.clip(np.rint(uv).astype(np.int64), 0, np.array(mask.shape[::-1]) - 1)
    return mask[pixel[:, 1], pixel[:, 0]]


def _count_workers(cameras: int) -> int:
    return max(1, min(cameras, os.cpu_count() or 1))


def _snapshots(frames: Mapping[str, Frame | Sequence[Frame | None] | None]) -> list[dict[str, Frame | None]]:
    """Convert camera -> frames to one mapping camera -> frame per snapshot."""
    series: dict[str, list[Frame | None]] = {}
    for name, entry in frames.items():
        if entry is None or isinstance(entry, np.ndarray):
            series[name] = [entry]
        elif isinstance(entry, Sequence) and not isinstance(entry, str | bytes):
            series[name] = list(entry)
        else:
            raise InputError(f"camera {name}: found a {type(entry).__name__}, expected a frame or a sequence of frames")
    count = max((len(series[name]) for name, entry in frames.items() if entry is not None), default=1)
    for name, entries in series.items():
        if frames[name] is None:  # a camera without any frame
            series[name] = [None] * count
        elif len(entries) != count:
            raise InputError(f"camera {name}: found {len(entries)} snapshots, expected {count} as for other cameras")
    return [{name: entries[index] for name, entries in series.items()} for index in range(count)]
