"""Frames in, `Detections` out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from imgcal.detection.finding import outline, screen
from imgcal.detection.measuring import Blobs, measure
from imgcal.detection.options import DetectionOptions, Frame, checked_frame, checked_mask, full_scale
from imgcal.errors import InputError
from imgcal.observations import BlobFlag, Detections

Mask = NDArray[np.bool_] | NDArray[np.uint8]  # (H, W) non-zero inside known reflections


def detect(
    frames: Mapping[str, Frame | Sequence[Frame | None] | None],
    options: DetectionOptions | None = None,
    *,
    masks: Mapping[str, Mask] | None = None,
) -> Detections:
    """Detect the blobs of all cameras in one or several snapshots.

    Args:
        frames: camera name -> frame (H, W) uint8 or uint16, or one frame a snapshot; None = the camera has no frame.
        options: what counts as a blob.
        masks: camera name -> (H, W), non-zero inside known reflections; blobs there are flagged.

    Raises:
        InputError: a frame is no grey image, or cameras have different numbers of snapshots.
    """
    options = options or DetectionOptions()
    names = tuple(frames)
    unknown = sorted(set(masks or ()) - set(names))
    if unknown:
        raise InputError(f"masks: found camera {unknown[0]}, expected one of {', '.join(names)}")
    snapshots = _snapshots(frames)
    if not snapshots:
        raise InputError("frames: found no snapshot, expected at least one frame for each camera")
    with ThreadPoolExecutor(_workers(len(names))) as pool:
        blobs = [detect_snapshot(snapshot, options, masks=masks, pool=pool) for snapshot in snapshots]
    return _table(blobs, names)


def detect_snapshot(
    frames: Mapping[str, Frame | None],
    options: DetectionOptions,
    *,
    masks: Mapping[str, Mask] | None = None,
    pool: ThreadPoolExecutor | None = None,
) -> Blobs:
    """Detect the blobs of one snapshot; `Blobs.camera` counts the cameras in the order of `frames`.

    Args:
        frames: camera name -> frame (H, W), None = missing.
        options: what counts as a blob.
        masks: camera name -> (H, W).
        pool: threads that live on between snapshots; None = a pool for this call.
    """
    if pool is None:
        with ThreadPoolExecutor(_workers(len(frames))) as own_pool:
            return detect_snapshot(frames, options, masks=masks, pool=own_pool)
    present = [(camera, name) for camera, name in enumerate(frames) if frames[name] is not None]
    images = [checked_frame(frames[name], name) for _, name in present]
    scales = [full_scale(image, options.bit_depth, name) for image, (_, name) in zip(images, present, strict=True)]
    if not images:
        return Blobs(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.uint8), np.zeros(0, np.int64))
    # Whole frames are read in parallel (OpenCV releases the interpreter), what stands out is handled as one batch.
    screenings = list(pool.map(screen, images, [options] * len(images), scales))
    blobs = measure(images, outline(images, screenings, options, scales), options, scales)
    for index, (image, (_, name)) in enumerate(zip(images, present, strict=True)):
        if masks is not None and name in masks:
            rows = np.flatnonzero(blobs.camera == index)
            blobs.flags[rows[_inside(checked_mask(masks[name], image, name), blobs.uv[rows])]] |= np.uint8(
                BlobFlag.MASKED
            )
    order = np.argsort(blobs.camera, kind="stable")
    camera = np.array([camera for camera, _ in present])[blobs.camera[order]]
    return Blobs(blobs.uv[order], blobs.sigma[order], blobs.radius[order], blobs.flags[order], camera)


def detect_frame(frame: Frame, options: DetectionOptions, mask: Mask | None = None) -> Blobs:
    """Detect the blobs of one frame (H, W)."""
    return detect_snapshot({"frame": frame}, options, masks=None if mask is None else {"frame": mask})


def _inside(mask: NDArray[np.bool_], uv: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which centres (K, 2) lie inside a mask (H, W)."""
    pixel = np.clip(np.rint(uv).astype(np.int64), 0, np.array(mask.shape[::-1]) - 1)
    return mask[pixel[:, 1], pixel[:, 0]]


def _workers(cameras: int) -> int:
    return max(1, min(cameras, os.cpu_count() or 1))


def _snapshots(frames: Mapping[str, Frame | Sequence[Frame | None] | None]) -> list[dict[str, Frame | None]]:
    """Turn camera -> frames into one mapping camera -> frame a snapshot."""
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


def _table(blobs: list[Blobs], names: tuple[str, ...]) -> Detections:
    """Stack the blobs of all snapshots; rows run over snapshots, then cameras."""
    counts = [len(shot.uv) for shot in blobs]
    digits = len(str(max(len(blobs) - 1, 0)))
    camera = np.concatenate([shot.camera for shot in blobs])
    return Detections(
        uv=np.concatenate([shot.uv for shot in blobs]),
        sigma=np.concatenate([shot.sigma for shot in blobs]),
        camera=camera,
        snapshot=np.repeat(np.arange(len(blobs)), counts),
        fiducial=np.full(len(camera), -1, np.int64),
        radius=np.concatenate([shot.radius for shot in blobs]),
        flags=np.concatenate([shot.flags for shot in blobs]),
        camera_names=names,
        snapshot_names=tuple(f"{index:0{digits}d}" for index in range(len(blobs))),
    )
