"""`imgcal rig`: rig files made up."""

from __future__ import annotations

import sys
from pathlib import Path

from imgcal.cli import arguments
from imgcal.errors import InputError
from imgcal.io import open_capture, save_cameras, save_rig
from imgcal.messages import list_names, plural
from imgcal.synthesis import arrange_rig
from imgcal.types import ConvexVolume


class Rig(arguments.Rig):
    """Run `imgcal rig`."""

    def run(self) -> None:
        """Make and write the file that was asked for."""
        check_new_file(self.what.out)
        if isinstance(self.what, arguments.LookAt):
            _look_at(self.what)
        else:
            _cameras(self.what)


def _look_at(given: arguments.LookAt) -> None:
    volume = None if given.volume is None else ConvexVolume.box(given.volume[:3], given.volume[3:])
    rig = arrange_rig(
        given.shape,
        given.cameras,
        given.radius,
        height=given.height,
        target=given.target,
        lens=given.lens,
        volume=volume,
        name=given.out.stem,
    )
    save_rig(rig, given.out)
    print(f"{plural(rig.num_cameras, 'camera')} written to {given.out}", file=sys.stderr)


def _cameras(given: arguments.Cameras) -> None:
    capture = open_capture(given.capture)
    sizes: dict[str, tuple[int, int]] = {}
    for _, frames in capture.snapshots():
        found = {name: (frame.shape[1], frame.shape[0]) for name, frame in frames.items() if frame is not None}
        sizes = {**found, **sizes}
        if len(sizes) == len(capture.camera_names):
            break
    if without := [name for name in capture.camera_names if name not in sizes]:
        raise InputError(
            f"{given.capture}: found no readable frame of {list_names(without)}, expected some of each camera"
        )
    save_cameras({name: sizes[name] for name in capture.camera_names}, given.field_of_view_deg, given.out)
    print(f"{plural(len(sizes), 'camera')} written to {given.out}", file=sys.stderr)


def check_new_file(path: Path) -> None:
    """Raise `InputError` where a file cannot be written, or would replace another."""
    if path.exists() or not path.parent.is_dir():
        raise InputError(f"--out: found {path}, expected a new file in an existing folder")
