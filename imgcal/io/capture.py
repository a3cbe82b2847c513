"""Captured frames: `frames/<camera name>/<snapshot>.<png|tif|...>` or `frames/<camera name>.<png|tif|mp4|...>`.

Frames of one moment have the same name in all cameras, before or behind which the camera's own may stand
(`cam01_0002.png`). One file a camera holds one snapshot a page (TIFF) or frame (video), named "0", "1", ...; an image
is snapshot "0".
Optional beside `frames/`: `capture.yaml` (format, bit_depth, note) and `masks/<camera name>.png` (not black = ignored).
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io.atomic import is_unfinished, write_text
from imgcal.io.detections_csv import Fiducials, load_detections
from imgcal.io.frames import IMAGE_SUFFIXES, TIFF_SUFFIXES, VIDEO_SUFFIXES, Frame, Video, count_frames, read_frame
from imgcal.io.names import is_file_name, natural_key, nearest, require_left_out, sample_path, snapshot_name
from imgcal.io.validation import StrictModel, validate
from imgcal.io.yaml_file import read_yaml, yaml_text
from imgcal.messages import list_names
from imgcal.types import CameraRig, Detections

FORMAT = "imgcal-capture/1"
LEFT_BEHIND = ("thumbs.db", "desktop.ini")
"""Files that systems put into folders of images."""
DIFFER = "--videos-differ (in Python videos_differ=True) matches them by number anyway"


class _Settings(StrictModel):
    format: Literal["imgcal-capture/1"]
    bit_depth: Literal[8, 12, 16]
    note: str | None = None


@dataclass(frozen=True)
class Capture:
    """Frames of a rig on disk; nothing is decoded before it is asked for."""

    folder: Path
    camera_names: tuple[str, ...]  # C, in the order of the rig
    snapshot_names: tuple[str, ...]  # S, of all cameras together; "2" comes before "10"
    files: Mapping[str, Mapping[str, tuple[Path, int]]]  # camera -> snapshot -> file, page or frame in it
    image_size: Mapping[str, tuple[int, int]]  # camera -> width, height in pixels; empty when opened without a rig
    masks: Mapping[str, Path]  # camera -> file, of cameras that have one
    bit_depth: int | None = None  # 8, 12 or 16 as stated in capture.yaml; None = not stated
    videos_differ: bool = False  # time stamps of the videos need not agree

    def snapshots(self, first: int = 0, last: int | None = None) -> Iterator[tuple[str, dict[str, Frame | None]]]:
        """Read frames one snapshot at a time, so that memory does not grow with the length of the capture.

        Args:
            first: number of the first snapshot.
            last: number of the snapshot to stop before; None = to the end.

        Yields:
            Name of the snapshot and, for every camera, its frame (H, W), or None where there is none.

        Raises:
            InputError: a frame is unreadable, or of another size or bit depth than expected; or the videos' time stamps
                say that frames of one number are of different moments.
        """
        before: dict[str, tuple[int, int, int]] = {}
        with contextlib.ExitStack() as stack:
            videos: dict[Path, Video] = {}
            for snapshot in self.snapshot_names[first:last]:
                frames: dict[str, Frame | None] = {}
                for camera in self.camera_names:
                    path, index = self.files[camera].get(snapshot, (None, 0))
                    if path is None:
                        frames[camera] = None
                        continue
                    if path.suffix.lower() not in VIDEO_SUFFIXES:
                        alone = path.parent != self.folder / "frames"
                        frame = _read_image(path, index, alone, self.image_size.get(camera))
                    else:
                        if path not in videos:
                            videos[path] = stack.enter_context(Video(path))
                        frame = videos[path].read(index)
                    self._check(frame, camera, path, before)
                    frames[camera] = frame
                if not self.videos_differ:
                    check_times(tuple(videos.values()), snapshot)
                yield snapshot, frames

    def frames(self, first: int = 0, last: int | None = None) -> dict[str, list[Frame | None]]:
        """Read frames of several snapshots at once, as `imgcal.calibrate` takes them: camera name -> frames (H, W).

        Arguments and errors as in `snapshots`.
        """
        read = [frames for _, frames in self.snapshots(first, last)]
        return {name: [frames[name] for frames in read] for name in self.camera_names}

    def frames_of(self, number: int) -> dict[str, Frame | None]:
        """Read the frames of one snapshot by its number: camera -> frame (H, W) or None; errors as in `snapshots`."""
        return next(self.snapshots(number, number + 1))[1]

    def mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Read the mask of a camera.

        Returns:
            (H, W) bool, True where the image is to be ignored; None when the camera has no mask.
        """
        path = self.masks.get(camera)
        if path is None:
            return None
        mask = read_frame(path, size=self.image_size.get(camera))
        _check_size(mask, path, camera, self.image_size.get(camera))
        return np.asarray(mask > 0)

    def _check(self, frame: Frame, camera: str, path: Path, before: dict[str, tuple[int, int, int]]) -> None:
        """Compare with the rig, with capture.yaml and with the first frame of the camera."""
        bits = 8 * frame.itemsize
        width, height, first_bits = before.setdefault(camera, (frame.shape[1], frame.shape[0], bits))
        _check_size(frame, path, camera, self.image_size.get(camera, (width, height)))
        if self.bit_depth is not None and (self.bit_depth > 8) != (bits > 8):
            story = f"a {self.bit_depth}-bit frame saved as 8-bit" if bits == 8 else f"{bits}-bit pixels"
            raise InputError(f"{path}: found {story}, expected {self.bit_depth} bit as stated in capture.yaml")
        if first_bits != bits:
            story = "a 16-bit frame saved as 8-bit" if bits == 8 else f"{bits}-bit pixels"
            raise InputError(f"{path}: found {story}, expected {first_bits} bit as in the first frame of {camera}")
        if self.bit_depth == 12 and frame.max(initial=0) > 4095:
            raise InputError(f"{path}: found the value {frame.max()}, expected at most 4095 (12 bit in the low bits)")


def open_capture(
    folder: str | Path, rig: CameraRig | None = None, videos_differ: bool = False, without: Collection[str] = ()
) -> Capture:
    """Find the frames of a capture.

    Args:
        folder: the folder that holds `frames/`, or the name of a shipped sample: `sample:O10`.
        rig: gives the cameras, their order and image sizes; a camera without files is allowed. None = what is there.
        videos_differ: accept videos (and TIFFs of several pages) whose numbers of frames or time stamps differ; their
            frames go together by number.
        without: cameras that the rig does not have, whose files are left out.

    Raises:
        InputError: one line with the file or folder, what was found and what was expected; with a rig also where no
            frame of a camera has the name of another camera's: what was exposed at the same moment would be unknown.

    Examples:
        >>> from imgcal.io import data_path
        >>> capture = open_capture(data_path("samples", "O10"))
        >>> len(capture.camera_names), len(capture.snapshot_names)
        (10, 4)
    """
    folder = sample_path(folder)
    frames = folder / "frames"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a capture that holds frames/<camera name>/")
    if not frames.is_dir() and is_unfinished(folder):
        raise InputError(f"{folder}: found a capture that was not finished, expected a complete one")
    if not frames.is_dir():
        found = list_names(path.name for path in _listing(folder)) or "an empty folder"
        raise InputError(f"{folder}: found {found}, expected a capture that holds frames/<camera name>/")
    files: dict[str, dict[str, tuple[Path, int]]] = {}
    for path in _listing(frames):
        camera = path.name if path.is_dir() else path.stem
        if camera in files:
            raise InputError(f"{frames}: found camera {camera} more than once, expected one folder or file for it")
        files[camera] = _folder_snapshots(path, camera) if path.is_dir() else _file_snapshots(path)
    if rig is not None:
        require_left_out(frames, without, files)
        files = {camera: found for camera, found in files.items() if camera not in without}
        _check_cameras(frames, files, rig)
        _require_shared_names(frames, files)
    if not any(files.values()):
        raise InputError(f"{frames}: found no frames, expected images or videos of the cameras")
    if not videos_differ:
        _check_counts(frames, files)
    names = tuple(files) if rig is None else rig.camera_names
    settings = folder / "capture.yaml"
    return Capture(
        folder=folder,
        camera_names=names,
        snapshot_names=tuple(sorted({snapshot for found in files.values() for snapshot in found}, key=natural_key)),
        files={name: files.get(name, {}) for name in names},
        image_size={} if rig is None else _sizes(rig),
        masks=_find_masks(folder / "masks", names),
        bit_depth=read_yaml(settings, _Settings, FORMAT).bit_depth if settings.exists() else None,
        videos_differ=videos_differ,
    )


def open_input(
    path: str | Path,
    rig: CameraRig | None = None,
    fiducials: Fiducials | None = None,
    videos_differ: bool = False,
    without: Collection[str] = (),
) -> Capture | Detections:
    """Open the input of a command: a capture folder, a detections file, or a sample by its name (`sample:O10`).

    Arguments as for `open_capture` and `load_detections`.

    Raises:
        InputError: there is no such file or folder, it holds neither frames nor blobs, or it does not fit the rig.
    """
    path = sample_path(path)
    if path.is_dir():
        return open_capture(path, rig, videos_differ, without)
    if not path.is_file():
        found = "found a device or pipe" if path.exists() else "no such file or folder"
        raise InputError(f"{path}: {found}, expected a capture folder or a detections file (.csv, .csv.gz)")
    suffix = path.suffix.lower()
    if suffix in IMAGE_SUFFIXES | VIDEO_SUFFIXES:
        raise InputError(f"{path}: found one image or video, expected the capture folder that holds frames/")
    return load_detections(path, rig, fiducials, without)


def save_capture_settings(folder: str | Path, bit_depth: int, note: str | None = None) -> None:
    """Write `capture.yaml`: the bit depth (8, 12 or 16) of all frames and a remark for people."""
    content: dict[str, Any] = {"format": FORMAT, "bit_depth": bit_depth}
    if note is not None:
        content["note"] = note
    path = Path(folder) / "capture.yaml"
    validate(content, _Settings, f"{path}: not written")
    write_text(path, yaml_text(content))


def _listing(folder: Path) -> list[Path]:
    """Entries in natural order, without hidden files."""
    if not folder.is_dir():
        raise InputError(f"{folder}: found a file, expected a folder")
    entries = [path for path in folder.iterdir() if path.name[0] != "." and path.name.lower() not in LEFT_BEHIND]
    for path in entries:
        if not is_file_name(path.name):
            raise InputError(f"{path}: found a name that is not valid text, or is too long: rename it")
    return sorted(entries, key=lambda path: natural_key(path.name))


def _find_masks(folder: Path, cameras: Sequence[str]) -> dict[str, Path]:
    """Find the mask of each camera that has one."""
    found: dict[str, Path] = {}
    for path in _listing(folder) if folder.exists() else ():
        if path.stem not in cameras or path.suffix.lower() != ".png":
            raise InputError(f"{path}: expected masks named <camera name>.png, cameras: {list_names(cameras)}")
        if path.stem in found:
            both = f"{found[path.stem].name} and {path.name}"
            raise InputError(f"{folder}: found {both}, expected one mask of camera {path.stem}")
        found[path.stem] = path
    return found


def _folder_snapshots(folder: Path, camera: str) -> dict[str, tuple[Path, int]]:
    """One image a snapshot."""
    found: dict[str, tuple[Path, int]] = {}
    for path in _listing(folder):
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            raise InputError(f"{path}: expected an image of one snapshot ({', '.join(sorted(IMAGE_SUFFIXES))})")
        name = snapshot_name(path.stem, camera)
        if name in found:
            raise InputError(f"{path}: found snapshot {name} more than once, also in {found[name][0].name}")
        found[name] = (path, 0)
    return found


def _file_snapshots(path: Path) -> dict[str, tuple[Path, int]]:
    """All snapshots of a camera in one file."""
    if path.suffix.lower() not in IMAGE_SUFFIXES | VIDEO_SUFFIXES:
        expected = ", ".join(sorted(IMAGE_SUFFIXES | VIDEO_SUFFIXES))
        raise InputError(f"{path}: expected a folder, an image or a video of one camera ({expected})")
    return {str(index): (path, index) for index in range(count_frames(path))}


def _require_shared_names(frames: Path, files: Mapping[str, Mapping[str, object]]) -> None:
    """Require of each camera a snapshot that another camera has, too."""
    shown = Counter(snapshot for found in files.values() for snapshot in found)
    alone = [camera for camera, found in files.items() if found and all(shown[name] == 1 for name in found)]
    others = [camera for camera, found in files.items() if found and camera not in alone] or alone[1:]
    if alone and others:
        raise InputError(
            f"{frames / alone[0]}: found {list_names(files[alone[0]])}, of which no other camera has one "
            f"({others[0]}: {list_names(files[others[0]])}), expected frames of one moment to have the same name"
        )


def check_times(videos: Sequence[Video], snapshot: str) -> None:
    """Raise `InputError` where the frames that were read last are further apart than half a frame."""
    if len(videos) < 2:
        return
    first, last = min(videos, key=lambda video: video.seconds), max(videos, key=lambda video: video.seconds)
    if last.seconds - first.seconds > 0.5 / max(first.rate, last.rate):
        raise InputError(
            f"{last.path}: found frame {snapshot} at {last.seconds:.3f} s, in {first.path.name} at {first.seconds:.3f} "
            f"s, expected the same moment; {DIFFER}"
        )


def _check_counts(frames: Path, files: Mapping[str, Mapping[str, tuple[Path, int]]]) -> None:
    """Compare the lengths of files with several snapshots: a missing frame would shift all later ones."""
    counts: dict[Path, int] = {}
    for found in files.values():
        path, _ = next(iter(found.values()), (frames, 0))
        if path.parent == frames and (len(found) > 1 or path.suffix.lower() in VIDEO_SUFFIXES):
            counts[path] = len(found)
    if len(set(counts.values())) > 1:
        shortest, longest = min(counts, key=lambda path: counts[path]), max(counts, key=lambda path: counts[path])
        raise InputError(
            f"{shortest}: found {counts[shortest]} frames, and {counts[longest]} in {longest.name}, expected as many "
            f"in each: after a missing one the others are of different moments; {DIFFER}"
        )


def _read_image(path: Path, page: int, alone: bool, size: tuple[int, int] | None) -> Frame:
    if alone and path.suffix.lower() in TIFF_SUFFIXES and (pages := count_frames(path)) != 1:
        raise InputError(f"{path}: found {pages} pages, expected 1 in a file of one snapshot")
    return read_frame(path, page, size)


def _check_cameras(frames: Path, found: Iterable[str], rig: CameraRig) -> None:
    unknown = [camera for camera in found if camera not in rig.camera_names]
    if unknown:
        hint = f"; put the snapshots into {frames / rig.camera_names[0]}" if rig.num_cameras == 1 else ""
        raise InputError(
            f"{frames}: found {list_names(unknown)}, expected the cameras of rig {rig.name}: "
            f"{list_names(rig.camera_names)}{nearest(unknown[0], rig.camera_names)}{hint}"
        )


def _check_size(frame: Frame, path: Path, camera: str, size: tuple[int, int] | None) -> None:
    if size is not None and frame.shape != size[::-1]:
        height, width = frame.shape
        raise InputError(f"{path}: found {width}x{height} pixels, expected {size[0]}x{size[1]} for camera {camera}")


def _sizes(rig: CameraRig) -> dict[str, tuple[int, int]]:
    sizes = rig.image_size.tolist()
    return {name: (int(width), int(height)) for name, (width, height) in zip(rig.camera_names, sizes, strict=True)}
