"""`ForeignRig`: what another tool's file says of a rig, before it is a `CameraRig`; and how far two are apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from imgcal.errors import InputError
from imgcal.formats.fitting import grid_rays
from imgcal.formats.lens import Array, Lens
from imgcal.io import RigCovariance
from imgcal.types import CameraRig

SIDE = 7  # points along each side of an image, its border included
DEPTHS = (0.5, 1.0, 4.0)  # in units of the rig's size
SAME = 1e-9
"""Most by which the poses of two cameras may differ, in rad and relative to the largest coordinate (1 at least)."""


class FormatError(InputError):
    """A recognized file holds no calibration. The reader prepends the file and the format."""


@dataclass(frozen=True)
class Place:
    """Where numbers of a camera stand in a document, and which numbers of the camera they are."""

    path: Path  # of the document
    keys: tuple[str | int, ...]  # to the value: of XML the element's number and "@attribute"; of bytes the offset
    numbers: Callable[[ForeignCamera], Sequence[float]]  # of a camera in the file's frame and unit, in their order
    first: int = 0  # how many other numbers of the value come before
    relative_to: int | None = None  # the pose is that of camera_from_camera[n], not of camera_from_rig


@dataclass(frozen=True)
class ForeignCamera:
    """One camera of a file, with its pose."""

    name: str
    lens: Lens
    image_size: tuple[int, int] | None  # pixels: width, height; None = the file does not say
    rotation: Array  # (3, 3) of cam_from_rig; camera x right, y down, z forward
    translation: Array  # (3,) of cam_from_rig, in units of the rig
    places: tuple[Place, ...] = field(default=(), compare=False, repr=False)  # of its numbers in the files
    one_focal_length: bool = False  # the file has one number for fx and fy

    def in_camera(self, points_rig: Array) -> Array:
        """Take points from the rig's frame to the camera's: (N, 3) -> (N, 3)."""
        return points_rig @ self.rotation.T + self.translation

    def project(self, points_rig: Array) -> Array:
        """Project points of the rig's frame by the lens of the file: (N, 3) -> (N, 2) pixels."""
        return self.lens.project(self.in_camera(points_rig))

    def in_frame_of(self, other: ForeignCamera) -> ForeignCamera:
        """The same camera in the frame of another one."""
        rotation = self.rotation @ other.rotation.T
        return replace(self, rotation=rotation, translation=self.translation - rotation @ other.translation)

    @property
    def centre(self) -> Array:
        """Where the camera stands in the rig's frame: (3,)."""
        return -self.rotation.T @ self.translation


def unplaced_camera(name: str, lens: Lens, image_size: tuple[int, int] | None) -> ForeignCamera:
    """Make a camera with an unknown pose: at the origin."""
    return ForeignCamera(name, lens, image_size, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class ForeignRig:
    """Cameras in a common frame, as in another tool's file."""

    format: str  # name, as `--from` and `--to` have it
    cameras: tuple[ForeignCamera, ...]
    unit: str | None  # of lengths: "mm", "m", ...; None = the file does not say
    frame: str  # which frame the rig's is, in words
    notes: tuple[str, ...] = ()  # what was assumed, and what was left out
    covariance: RigCovariance | None = None
    unit_hint: str = ""  # of a file that does not say its unit: which format would, if it is that
    root: int | None = None  # the camera whose frame is the rig's by definition; None = the frame is a world
    own: CameraRig | None = None  # what this was made from, for values that other tools lack (prior, volume, ...)

    @property
    def names(self) -> list[str]:
        """The cameras' names."""
        return [camera.name for camera in self.cameras]

    def scale(self, factor: float, unit: str) -> ForeignRig:
        """The same rig with every length `factor` times as many of another unit."""
        cameras = tuple(replace(camera, translation=camera.translation * factor) for camera in self.cameras)
        return replace(self, cameras=cameras, unit=unit)

    def in_camera_frame(self, root: int = 0) -> ForeignRig:
        """The same rig in the frame of its first camera, or of another one."""
        first = self.cameras[root]
        cameras = [camera.in_frame_of(first) for camera in self.cameras]
        cameras[root] = replace(first, rotation=np.eye(3), translation=np.zeros(3))
        return replace(self, cameras=tuple(cameras), frame=f"camera {first.name}")


def known_points(rig: ForeignRig) -> list[Array]:
    """Points in front of each camera, all over its image at three depths: (N, 3) in the rig's frame, one array each.

    Pixels that a lens has no ray for (beyond its fold) give none.
    """
    centres = np.array([camera.centre for camera in rig.cameras])
    size = float(np.linalg.norm(centres - centres.mean(axis=0), axis=-1).max()) or 1000.0
    found = []
    for camera in rig.cameras:
        assert camera.image_size is not None
        rays = grid_rays(camera.lens, camera.image_size, SIDE)
        rays = rays[np.isfinite(rays).all(axis=-1)]
        points_cam = np.concatenate([rays * depth * size for depth in DEPTHS])
        found.append((points_cam - camera.translation) @ camera.rotation)
    return found


def coinciding_cameras(rig: ForeignRig) -> list[list[str]]:
    """Find cameras that have the same pose, but for the digits of a double: names, a list for each such pose."""
    rotations = np.array([camera.rotation.ravel() for camera in rig.cameras])
    centres = np.array([camera.centre for camera in rig.cameras])
    turned = np.abs(rotations[:, None] - rotations).max(axis=-1)
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    same = (turned <= SAME) & (apart <= SAME * max(1.0, float(np.abs(centres).max())))
    groups = {tuple(np.flatnonzero(row)) for row in same if row.sum() > 1}
    return [[rig.names[place] for place in group] for group in sorted(groups)]


def worst_difference(rig: ForeignRig, other: ForeignRig) -> tuple[float, int]:
    """Compare two rigs in the same unit, with cameras in the same order, by the pixels of known points.

    The rig's frame is free: points are taken from one to the other through the first camera.

    Returns:
        The largest distance in pixels over all known points and cameras, and the number of points.
    """
    first, same = rig.cameras[0], other.cameras[0]
    worst, count = 0.0, 0
    for camera, counterpart, points in zip(rig.cameras, other.cameras, known_points(rig), strict=True):
        in_first = first.in_camera(points)
        there = (in_first - same.translation) @ same.rotation
        away = np.linalg.norm(counterpart.project(there) - camera.project(points), axis=-1)
        worst = max(worst, float(np.where(np.isfinite(away), away, np.inf).max(initial=0.0)))
        count += len(points)
    return worst, count
