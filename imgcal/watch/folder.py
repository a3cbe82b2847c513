"""A folder that fills with frames: `frames/<camera>/<snapshot>.png`, on a disk or a network share."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from imgcal.errors import InputError
from imgcal.io import IMAGE_SUFFIXES, is_file_name, natural_key, nearest, read_frame, snapshot_name
from imgcal.messages import list_names
from imgcal.types import CameraRig
from imgcal.watch.exposures import Exposure, FileStamp, Item, Unreadable
from imgcal.watch.timing import LEAP

TICK = 0.05  # s between two scans
GIVEN_UP = 2.0  # s for which an unreadable file may still be incomplete
REMEMBERED = 4096  # names of read files kept per camera; earlier names count as read
LATER = 0.5  # s by which a read file that was written again is younger: a copy may get its time last


@dataclass(frozen=True)
class Folder:
    """Frames of a growing capture; the name of a file, without the camera's, is that of its snapshot.

    No file is read half-written: its size must be equal in two scans, and the image must be complete. Names that begin
    with a dot or do not end in an image suffix (`1.png.part`) are ignored.
    """

    folder: Path  # holds frames/<camera name>/
    rig: CameraRig
    remove: bool = False  # delete frames once their result is `saved`
    after: str | None = None  # snapshots up to this one were processed before
    until_idle: float | None = None  # s without a new file until it counts as complete; None = never
    _caught_up: threading.Event = field(default_factory=threading.Event, repr=False)
    _read_files: deque[Path] = field(default_factory=deque, repr=False)  # to be deleted

    @property
    def live(self) -> bool:
        """Whether all files that existed at the start have been read; those are a recording, which waits."""
        return self._caught_up.is_set()

    def count_processed(self) -> int:
        """Count the existing snapshots that were processed before."""
        if self.after is None:
            return 0
        return sum(
            natural_key(name) <= natural_key(self.after) for name in {_snapshot(path) for path in self._frames()}
        )

    def compare(self, files: Mapping[str, FileStamp]) -> tuple[int, int]:
        """Count how many files that were read, by camera, are in this folder unchanged, and how many are missing."""
        paths = {name: self.folder / "frames" / name / file.name for name, file in files.items()}
        there = {name: path for name, path in paths.items() if path.is_file()}
        kept = 0
        for name, path in there.items():
            with contextlib.suppress(InputError, OSError):  # it is no frame now
                kept += FileStamp.of(path.name, read_frame(path)) == files[name]
        return kept, len(files) - len(there)

    def begins_anew(self, after: str, time: float) -> bool:
        """Tell whether frames up to snapshot `after` were written later than `time` (s since the epoch)."""
        for path in self._frames():
            with contextlib.suppress(OSError):  # deleted meanwhile
                if natural_key(_snapshot(path)) <= natural_key(after) and path.stat().st_mtime > time + LEAP:
                    return True
        return False

    def _frames(self) -> list[Path]:
        """The frames in this folder."""
        files = (path for name in self.rig.camera_names for path in (self.folder / "frames" / name).glob("*"))
        return [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and is_file_name(path.stem)]

    def delete_read(self, name: str) -> None:
        """Delete the frames read so far, up to snapshot `name`; they are not needed again.

        Raises:
            OSError: some cannot be deleted; the next call tries again.
        """
        failed: list[Path] = []
        problem: OSError | None = None
        for _ in range(len(self._read_files)):
            path = self._read_files.popleft()
            if natural_key(_snapshot(path)) > natural_key(name):
                self._read_files.append(path)
                continue
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                failed.append(path)
                problem = error
        self._read_files.extendleft(failed[-REMEMBERED:])
        if problem is not None:
            raise problem

    def items(self) -> Iterator[Item]:
        """Yield frames snapshot by snapshot: the existing ones first, then new ones as they come."""
        frames = self.folder / "frames"
        yield from self._check_names(frames)
        cameras = {name: _Camera(frames / name, self.after) for name in self.rig.camera_names}
        heard, looks = time.monotonic(), 0
        while self.until_idle is None or time.monotonic() - heard < self.until_idle:
            now = time.monotonic()
            ready = [(path, name) for name, camera in cameras.items() for path in camera.stable_files()]
            for path, name in sorted(ready, key=lambda pair: (natural_key(_snapshot(pair[0])), pair[1])):
                item = self._read(cameras[name], name, path, now)
                if item is not None:
                    yield item
                    heard = time.monotonic()
            for name, camera in cameras.items():
                if (again := camera.find_rewritten()) is not None:
                    yield Unreadable(
                        f"{again}: was read before and has been written again, expected a new name for each snapshot; "
                        "what comes under names that were read before is left out",
                        name,
                    )
            looks += 1
            if ready or looks > 1:  # no file is stable in the first scan
                self._caught_up.set()
            yield None
            time.sleep(TICK)

    def _check_names(self, frames: Path) -> Iterator[Item]:
        """Report likely typing errors; the cameras' own folders may be created later."""
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder, expected one that holds or will hold frames/<camera>/")
        if not frames.is_dir() and any((self.folder / name).exists() for name in self.rig.camera_names):
            raise InputError(
                f"{self.folder}: found the folders of cameras, expected a folder that holds frames/<camera>/"
            )
        if not frames.is_dir():
            yield Unreadable(f"{self.folder}: found no folder frames in it, expected frames/<camera>/<snapshot>.png")
        for path in sorted(frames.iterdir()) if frames.is_dir() else ():
            if not path.name.startswith(".") and path.name not in self.rig.camera_names:
                expected = f"the cameras of rig {self.rig.name}: {list_names(self.rig.camera_names)}"
                yield Unreadable(f"{path}: expected {expected}{nearest(path.name, self.rig.camera_names)}")

    def _read(self, camera: _Camera, name: str, path: Path, now: float) -> Item:
        """Read a file of stable size; None = it may still be incomplete."""
        size = self.rig.image_size[self.rig.camera_names.index(name)].tolist()
        try:
            found = path.stat()
            frame = read_frame(path, size=(size[0], size[1]))
        except (InputError, OSError) as error:
            if not camera.gives_up(path, now):
                return None
            return Unreadable(str(error), name)
        camera.mark_done(path)
        if self.remove:
            self._read_files.append(path)
        return Exposure(name, found.st_mtime, frame, _snapshot(path), FileStamp.of(path.name, frame))


class _Camera:
    """The new files of a camera, and whether they still grow."""

    def __init__(self, folder: Path, after: str | None) -> None:
        self._folder = folder
        self._floor = None if after is None else natural_key(after)
        self._read: OrderedDict[str, int] = OrderedDict()  # modification time then, ns
        self._asking: Iterator[str] = iter(())  # read files to ask, one per scan, whether they were written again
        self._told = False  # one was
        self._growing: dict[str, tuple[int, int]] = {}  # size and modification time in the last scan
        self._since: dict[str, float] = {}  # when a file was first found stable but unreadable

    def stable_files(self) -> list[Path]:
        """New files whose size has not changed since the last scan."""
        steady: list[Path] = []
        growing: dict[str, tuple[int, int]] = {}
        try:
            with os.scandir(self._folder) as entries:
                for entry in entries:
                    if not self._is_new(entry.name):
                        continue
                    state = entry.stat()
                    seen = (state.st_size, state.st_mtime_ns)
                    growing[entry.name] = seen
                    if seen == self._growing.get(entry.name) and state.st_size:
                        steady.append(self._folder / entry.name)
        except OSError:  # missing, or on a share that is offline for a while
            return []
        self._growing = growing
        self._since = {name: since for name, since in self._since.items() if name in growing}
        return steady

    def mark_done(self, path: Path) -> None:
        """Mark a file as processed, in bounded memory."""
        self._since.pop(path.name, None)
        self._read[path.name] = self._growing.pop(path.name, (0, 0))[1]
        if len(self._read) > REMEMBERED:
            first, _ = self._read.popitem(last=False)
            key = natural_key(_snapshot(self._folder / first))
            self._floor = key if self._floor is None else max(self._floor, key)

    def find_rewritten(self) -> Path | None:
        """Find a read file that has been written again, as in a ring of names; only once."""
        name = None if self._told else next(self._asking, None)
        if name is None:
            self._asking = iter(list(self._read))
            return None
        with contextlib.suppress(OSError, KeyError):  # deleted or forgotten meanwhile
            self._told = (self._folder / name).stat().st_mtime_ns > self._read[name] + LATER * 1e9
        return self._folder / name if self._told else None

    def gives_up(self, path: Path, now: float) -> bool:
        """Tell whether a stable file has been unreadable for too long."""
        if now - self._since.setdefault(path.name, now) < GIVEN_UP:
            return False
        self.mark_done(path)
        return True

    def _is_new(self, name: str) -> bool:
        stem, _, suffix = name.rpartition(".")
        if name.startswith(".") or f".{suffix.lower()}" not in IMAGE_SUFFIXES or name in self._read:
            return False
        if self._floor is None or not is_file_name(stem):
            return is_file_name(stem)
        return natural_key(snapshot_name(stem, self._folder.name)) > self._floor


def _snapshot(path: Path) -> str:
    """Name the snapshot of a frame, `frames/<camera name>/<file>`."""
    return snapshot_name(path.stem, path.parent.name)
