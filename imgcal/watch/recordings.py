"""Recordings, read as fast as they are processed: one video per camera, or a table of blobs."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imgcal.io import VIDEO_SUFFIXES, Video, check_times, open_capture
from imgcal.types import CameraRig, Detections
from imgcal.watch.exposures import CameraBlobs, Exposure, Item


@dataclass(frozen=True)
class Videos:
    """Videos `frames/<camera>.<mp4|avi|...>` with their own time stamps, from 0 s.

    A difference in length or time stamps is an error; with `differ`, frames are matched by their time stamps instead.
    """

    folder: Path  # holds frames/
    rig: CameraRig
    differ: bool = False  # lengths and time stamps may differ
    live: bool = False

    def items(self) -> Iterator[Item]:
        """Yield frames in the order of time."""
        capture = open_capture(self.folder, self.rig, self.differ)
        paths = {camera: next(iter(files.values()))[0] for camera, files in capture.files.items() if files}
        with contextlib.ExitStack() as stack:
            videos = {camera: stack.enter_context(Video(path)) for camera, path in paths.items()}
            yield from _read_by_time(videos) if self.differ else _read_numbered(videos)


@dataclass(frozen=True)
class BlobTable:
    """A table of blobs at a given rate; its labels are not used."""

    blobs: Detections
    rate: float  # snapshots per second
    live: bool = False

    def items(self) -> Iterator[Item]:
        """Yield blobs snapshot by snapshot, including cameras without any."""
        usable = self.blobs.select(self.blobs.usable)
        order = np.lexsort((usable.camera, usable.snapshot))
        rows = usable.select(order)
        cameras = len(rows.camera_names)
        starts = np.searchsorted(
            rows.snapshot * cameras + rows.camera, np.arange(len(rows.snapshot_names) * cameras + 1)
        )
        sees = np.bincount(rows.camera, minlength=cameras) > 0
        for snapshot, name in enumerate(rows.snapshot_names):
            for camera in np.flatnonzero(sees):
                first, last = starts[snapshot * cameras + camera : snapshot * cameras + camera + 2]
                content = CameraBlobs(rows.uv[first:last], rows.sigma[first:last], rows.radius[first:last])
                yield Exposure(rows.camera_names[camera], snapshot / self.rate, content, name)


def holds_videos(folder: Path) -> bool:
    """Tell whether a folder is a capture of videos."""
    frames = folder / "frames"
    return frames.is_dir() and any(path.suffix.lower() in VIDEO_SUFFIXES for path in frames.iterdir())


def _read_numbered(videos: dict[str, Video]) -> Iterator[Item]:
    """Frames with equal numbers together, after a check of their time stamps."""
    for index in range(min(video.count for video in videos.values())):
        frames = {camera: video.read(index) for camera, video in videos.items()}
        check_times(tuple(videos.values()), str(index))
        for camera, frame in frames.items():
            yield Exposure(camera, videos[camera].seconds, frame, str(index))


def _read_by_time(videos: dict[str, Video]) -> Iterator[Item]:
    heads: list[tuple[float, str, int, Exposure]] = []

    def read(camera: str, index: int) -> None:
        if index < videos[camera].count:
            frame = videos[camera].read(index)
            heapq.heappush(
                heads, (videos[camera].seconds, camera, index, Exposure(camera, videos[camera].seconds, frame))
            )

    for camera in videos:
        read(camera, 0)
    while heads:
        _, camera, index, exposure = heapq.heappop(heads)
        yield exposure
        read(camera, index + 1)
