"""Rigs and objects as buffers of modules, which `.to(device)` and `.double()` move with everything else."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor, nn

from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig


class RigBuffers(nn.Module):
    """A rig in buffers that are not part of the saved state."""

    focal_length: Tensor
    principal_point: Tensor
    distortion: Tensor
    rotation: Tensor
    translation: Tensor
    image_size: Tensor

    def __init__(self, rig: CameraRig) -> None:
        super().__init__()
        self._like = rig
        for name, tensor in (
            ("focal_length", rig.focal_length),
            ("principal_point", rig.principal_point),
            ("distortion", rig.distortion),
            ("rotation", rig.cam_from_rig.rotation),
            ("translation", rig.cam_from_rig.translation),
            ("image_size", rig.image_size),
        ):
            self.register_buffer(name, tensor.clone(), persistent=False)

    def forward(self) -> CameraRig:
        """Return the rig on the module's device."""
        return replace(
            self._like,
            focal_length=self.focal_length,
            principal_point=self.principal_point,
            distortion=self.distortion,
            cam_from_rig=RigidTransform(self.rotation, self.translation),
            image_size=self.image_size,
        )


class ObjectBuffers(nn.Module):
    """The fiducials of an object in buffers that are not part of the saved state, treated as exact."""

    points: Tensor
    colours: Tensor
    radius: Tensor | None

    def __init__(self, obj: CalibrationObject) -> None:
        super().__init__()
        self.name, self.fiducial_names = obj.name, obj.fiducial_names
        self.register_buffer("points", obj.points.clone(), persistent=False)
        self.register_buffer("colours", obj.colours.clone(), persistent=False)
        self.register_buffer("radius", None if obj.radius is None else obj.radius.clone(), persistent=False)

    def forward(self) -> CalibrationObject:
        """Return the object on the module's device."""
        return CalibrationObject(self.points, self.colours, self.radius, self.name, self.fiducial_names)
