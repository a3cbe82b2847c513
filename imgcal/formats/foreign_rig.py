"""`ForeignRig`: what another tool's file says of a rig, before it is a `CameraRig`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from imgcal.errors import InputError
from imgcal.formats.lens import Array, Lens
from imgcal.io import RigCovariance
from imgcal.types import CameraRig


class FormatError(InputError):
    """Why a file that was recognized holds no calibration; who reads it puts the file and the format before it."""


@dataclass(frozen=True)
class ForeignCamera:
    """One camera of a file that knows where it stands."""

    name: str
    lens: Lens
    image_size: tuple[int, int] | None  # pixels: width, height; None = the file does not say
    rotation: Array  # (3, 3) of cam_from_rig; camera x right, y down, z forward
    translation: Array  # (3,) of cam_from_rig, in units of the rig

    def in_camera(self, points_rig: Array) -> Array:
        """Take points from the rig's frame to the camera's: (N, 3) -> (N, 3)."""
        return points_rig @ self.rotation.T + self.translation

    def project(self, points_rig: Array) -> Array:
        """Project points of the rig's frame by the lens of the file: (N, 3) -> (N, 2) pixels."""
        return self.lens.project(self.in_camera(points_rig))

    @property
    def centre(self) -> Array:
        """Where the camera stands in the rig's frame: (3,)."""
        return -self.rotation.T @ self.translation


def unplaced_camera(name: str, lens: Lens, image_size: tuple[int, int] | None) -> ForeignCamera:
    """Make a camera of which nobody knows where it is: at the origin."""
    return ForeignCamera(name, lens, image_size, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class ForeignRig:
    """Cameras in a common frame, as a file of another tool has them."""

    format: str  # name, as `--from` and `--to` have it
    cameras: tuple[ForeignCamera, ...]
    unit: str | None  # of lengths: "mm", "m", ...; None = the file does not say
    frame: str  # which frame the rig's is, in words
    notes: tuple[str, ...] = ()  # what was assumed, and what was left out
    covariance: RigCovariance | None = None
    own: CameraRig | None = None  # that it was made of: what other tools have no words for (prior, volume, ...)

    @property
    def names(self) -> list[str]:
        """The cameras' names."""
        return [camera.name for camera in self.cameras]

    def scaled(self, factor: float, unit: str) -> ForeignRig:
        """The same rig with every length `factor` times as many of another unit."""
        cameras = tuple(replace(camera, translation=camera.translation * factor) for camera in self.cameras)
        return replace(self, cameras=cameras, unit=unit)

    def seen_from_first(self) -> ForeignRig:
        """The same rig in the frame of its first camera."""
        first = self.cameras[0]
        cameras = []
        for camera in self.cameras:
            rotation = camera.rotation @ first.rotation.T
            cameras.append(
                replace(camera, rotation=rotation, translation=camera.translation - rotation @ first.translation)
            )
        cameras[0] = replace(cameras[0], rotation=np.eye(3), translation=np.zeros(3))
        return replace(self, cameras=tuple(cameras), frame=f"camera {first.name}")
