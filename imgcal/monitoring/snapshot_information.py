"""Information of snapshots about cameras and object, linearized: `SnapshotInformation`.

It is the sum of their information, less the part lost to their poses, and their gradient. Both are kept per snapshot in
a compact form: a block per camera, less the outer product of one row for each of the pose's numbers (six).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from imgcal.estimation import error_between
from imgcal.monitoring.rig_arrays import RigArrays
from imgcal.types import CameraRig


@dataclass(frozen=True)
class SnapshotInformation:
    """Log likelihood of S snapshots as a function of a rig and an object's offset, to second order, poses eliminated.

    D = K C + M errors in units: of C cameras, and M values of the object.
    """

    rig: CameraRig  # point of linearization, without batch axes
    object_offset: Tensor  # (M,)
    unit: Tensor  # (C, K) rad, mm, pixels, 1
    camera: Tensor  # (S, C, K, K) information of each camera with known poses
    border: Tensor  # (S, M, D) the same for the object
    carried: Tensor  # (S, P, D) information lost to the unknown poses: minus its outer product
    pull: Tensor  # (S, D) gradient of the log likelihood

    def __len__(self) -> int:
        return len(self.pull)

    @cached_property
    def arrays(self) -> RigArrays:
        """The point of linearization, for compiled loops."""
        return RigArrays.of(self.rig)

    def select(self, snapshots: slice) -> SnapshotInformation:
        """Keep some snapshots."""
        parts = {name: getattr(self, name)[snapshots] for name in ("camera", "border", "carried", "pull")}
        return replace(self, **parts)

    def information(self) -> Tensor:
        """Information of all snapshots together: (D, D)."""
        flat, wide = self.carried.flatten(0, 1), self.rig.num_cameras * self.rig.num_parameters
        information = -(flat.mT @ flat)
        add_blocks(information, self.camera.sum(0))
        if len(self.object_offset):
            border = self.border.sum(0)
            information[wide:] += border
            information[:wide, wide:] += border[:, :wide].mT
        return information

    def distance_from(self, rig: CameraRig, object_offset: Tensor) -> Tensor:
        """Error (D,) in units of another rig and object relative to the point of linearization."""
        cameras = (error_between(rig, self.rig) / self.unit).flatten()
        return torch.cat((cameras, object_offset - self.object_offset))


def add_blocks(matrix: Tensor, blocks: Tensor) -> None:
    """Add blocks (C, K, K) along the diagonal of the cameras' part."""
    count = len(blocks)
    wide = matrix[: count * blocks.shape[-1], : count * blocks.shape[-1]]
    square = wide.unflatten(0, (count, -1)).unflatten(-1, (count, -1))
    square.diagonal(dim1=0, dim2=2).add_(blocks.movedim(0, -1))
