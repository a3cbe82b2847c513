"""`imgcal rig`: rig files made up."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from imgcal.errors import InputError
from imgcal.io import open_capture, save_cameras, save_rig
from imgcal.messages import listed
from imgcal.synthesis import Lens, Shape, arranged_rig
from imgcal.types import Volume


@dataclass(frozen=True)
class LookAt:
    """Make a rig of equal cameras in a ring, a dome or a row that all look at one point; z is up.

    Example: imgcal rig look-at --shape ring --cameras 8 --radius 4000 --height 2500 --target 0 0 1000 --out ring8.yaml
    """

    out: Path  #: rig file to write
    shape: Shape = "ring"
    """ring = on a circle about the z axis; dome = over a half sphere; row = on a line along x"""
    cameras: int = 8  #: how many
    radius: float = 4000.0  #: mm: of the circle or the sphere; half the length of a row
    height: float = 2500.0  #: mm: z of the circle or the line, or of the sphere's centre
    target: tuple[float, float, float] = (0.0, 0.0, 1000.0)  #: mm: what all look at
    lens: Annotated[Lens, tyro.conf.arg(name="")] = field(default_factory=Lens)
    volume: tuple[float, float, float, float, float, float] | None = None
    """mm: the box in which the rig is used, least x y z and largest x y z; default: about the target"""

    def run(self) -> None:
        """Make and write."""
        check_new_file(self.out)
        volume = None if self.volume is None else Volume.box(self.volume[:3], self.volume[3:])
        rig = arranged_rig(
            self.shape,
            self.cameras,
            self.radius,
            height=self.height,
            target=self.target,
            lens=self.lens,
            volume=volume,
            name=self.out.stem,
        )
        save_rig(rig, self.out)
        print(f"{rig.num_cameras} cameras written to {self.out}", file=sys.stderr)


@dataclass(frozen=True)
class Cameras:
    """Make a file of cameras of which nothing is known but their images and roughly how much they see.

    It is what imgcal calibrate --cameras begins with where there is no factory calibration.
    Example: imgcal rig cameras my_capture --field-of-view-deg 65 --out cameras.yaml
    """

    capture: Annotated[Path, tyro.conf.Positional]  #: capture folder: its cameras, and the sizes of their images
    field_of_view_deg: float  #: degrees across the longer side of the image, roughly (15 %)
    out: Path  #: file to write

    def run(self) -> None:
        """Look and write."""
        check_new_file(self.out)
        capture = open_capture(self.capture)
        sizes: dict[str, tuple[int, int]] = {}
        for _, frames in capture.snapshots():
            found = {name: (frame.shape[1], frame.shape[0]) for name, frame in frames.items() if frame is not None}
            sizes = {**found, **sizes}
            if len(sizes) == len(capture.camera_names):
                break
        if without := [name for name in capture.camera_names if name not in sizes]:
            raise InputError(
                f"{self.capture}: found no readable frame of {listed(without)}, expected some of each camera"
            )
        save_cameras({name: sizes[name] for name in capture.camera_names}, self.field_of_view_deg, self.out)
        print(f"{len(sizes)} cameras written to {self.out}", file=sys.stderr)


@dataclass(frozen=True)
class Rig:
    """Make rig files: cameras that look at a point, for simulations, or cameras yet to be calibrated.

    imgcal rig look-at --help and imgcal rig cameras --help tell more.
    """

    what: Annotated[
        Annotated[LookAt, tyro.conf.subcommand("look-at", prefix_name=False)]
        | Annotated[Cameras, tyro.conf.subcommand("cameras", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> None:
        """Do what was asked for."""
        self.what.run()


def check_new_file(path: Path) -> None:
    """Raise `InputError` where a file cannot be written, or would replace another."""
    if path.exists() or not path.parent.is_dir():
        raise InputError(f"--out: found {path}, expected a new file in an existing folder")
