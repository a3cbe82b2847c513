"""Input (`Views`) and output (`Prediction`) of a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.geometry import Join, RigidTransform, rotation_from_6d, sixd_from_rotation
from imgcal.messages import brief_repr
from imgcal.types.rig import CameraRig


@dataclass(frozen=True)
class Views:
    """One snapshot of each rig, as the networks take it: labelled points, colour-coded images, or both.

    Examples:
        >>> uv = torch.zeros(2, 10, 8, 2)  # rigs, cameras, fiducials, (u, v)
        >>> len(Views(uv=uv, seen=torch.ones(2, 10, 8, dtype=torch.bool)))
        2
    """

    uv: Tensor | None = None  # (B, C, N, 2) pixels of the sensor; any finite value where not seen
    seen: Tensor | None = None  # (B, C, N) bool
    images: Tensor | None = None  # (B, C, 3, H, W) in [0, 1], colour-coded splats on black

    def __len__(self) -> int:
        given = self.images if self.uv is None else self.uv
        if given is None:
            raise ValueError("views hold neither points nor images")
        return len(given)


@dataclass(frozen=True)
class Prediction:
    """A rig and the object's pose in it. Images determine only their product, the cameras in the object's frame."""

    rig: CameraRig  # (B,)
    rig_from_object: RigidTransform  # (B,)
    log_sigma: Tensor | None = None  # (B, C, N) log of the factor on each fiducial's sigma in a refinement; None = 1

    __repr__ = brief_repr

    def __getitem__(self, rows: Tensor | slice) -> Prediction:
        """Keep some rigs of the batch."""
        log_sigma = None if self.log_sigma is None else self.log_sigma[rows]
        return Prediction(self.rig[rows], self.rig_from_object[rows], log_sigma)

    @property
    def cameras_from_object(self) -> CameraRig:
        """The cameras in the object's frame: what the paper's 21 numbers per camera describe."""
        return self.rig.from_object(self.rig_from_object)

    @classmethod
    def from_cameras(cls, cameras: CameraRig, factory: CameraRig) -> Prediction:
        """Split cameras in the object's frame into a rig near the factory's, and the object's pose.

        Args:
            cameras: (B,) rigs whose cam_from_rig is cam_from_object, each camera independent (the paper's networks).
            factory: the factory rig, without batch axes.

        Returns:
            The same cameras. The pose is the mean of the poses that each camera implies with its factory extrinsics.
        """
        each = factory.to(cameras.focal_length.dtype).cam_from_rig.inverse() @ cameras.cam_from_rig  # (B, C)
        rotation = rotation_from_6d(sixd_from_rotation(each.rotation.mean(-3)))
        pose = RigidTransform(rotation, each.translation.mean(-2))
        inverse = pose.inverse()
        cam_from_rig = cameras.cam_from_rig @ RigidTransform(inverse.rotation[:, None], inverse.translation[:, None])
        rig = replace(
            factory,
            focal_length=cameras.focal_length,
            principal_point=cameras.principal_point,
            distortion=cameras.distortion,
            cam_from_rig=cam_from_rig,
        )
        return cls(rig, pose)

    @classmethod
    def stack(cls, parts: Sequence[Prediction]) -> Prediction:
        """Stack several along a new first batch axis."""
        return cls.combine(parts, torch.stack)

    @classmethod
    def cat(cls, parts: Sequence[Prediction]) -> Prediction:
        """Concatenate several along their first batch axis."""
        return cls.combine(parts, torch.cat)

    @classmethod
    def combine(cls, parts: Sequence[Prediction], join: Join) -> Prediction:
        """Combine several like `CameraRig.combine`; `log_sigma` is left out."""
        poses = RigidTransform.combine([part.rig_from_object for part in parts], join)
        return cls(CameraRig.combine([part.rig for part in parts], join), poses)

    def detach(self) -> Prediction:
        """Detach all tensors from the graph."""
        pose = RigidTransform(self.rig_from_object.rotation.detach(), self.rig_from_object.translation.detach())
        log_sigma = None if self.log_sigma is None else self.log_sigma.detach()
        return Prediction(self.rig.map_tensors(lambda tensor, _: tensor.detach()), pose, log_sigma)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Prediction:
        """Change the floating-point type, move to a device, or both."""
        log_sigma = None if self.log_sigma is None else self.log_sigma.to(dtype=dtype, device=device)
        return Prediction(self.rig.to(dtype, device), self.rig_from_object.to(dtype, device), log_sigma)
