"""A rig's values for compiled loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.types import CameraRig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigArrays:
    """A rig's values, or two rows of them."""

    rotation: Array  # (C, 3, 3) of cam_from_rig
    position: Array  # (C, 3) mm
    focal_length: Array  # (C, 2)
    principal_point: Array  # (C, 2)
    distortion: Array  # (C, K - 10)

    @classmethod
    def of(cls, rig: CameraRig) -> RigArrays:
        """Take the values of a rig without batch axes."""
        rotation = rig.cam_from_rig.rotation.contiguous().numpy()
        position = -(rotation.swapaxes(-1, -2) @ rig.cam_from_rig.translation.numpy()[..., None])[..., 0]
        position = np.ascontiguousarray(position)
        lens = (rig.focal_length, rig.principal_point, rig.distortion)
        return cls(rotation, position, *(part.contiguous().numpy() for part in lens))

    @property
    def parts(self) -> tuple[Array, ...]:
        """The arrays in the order of the compiled loops."""
        return (self.rotation, self.position, self.focal_length, self.principal_point, self.distortion)
