"""`ProjectRig`: projection of fiducials into the cameras of a rig."""

from __future__ import annotations

from torch import nn

from imgcal.geometry import Projection, RigidTransform
from imgcal.nn.buffers import ObjectBuffers
from imgcal.types import CalibrationObject, CameraRig


class ProjectRig(nn.Module):
    """Project an object's fiducials into the cameras of a rig.

    Differentiable in the rig and in the pose. Convention: pixel (0, 0) is the centre of the top-left pixel; `visible`
    tells whether a pixel is valid; its coordinates are finite in any case.

    Args:
        obj: N fiducials (mm); those with a radius are spheres, whose apparent centres are projected.

    Shape:
        - rig: (*B) rigs of C cameras.
        - rig_from_object: (*B) poses (mm); None = the rig is given in the object's frame.
        - Output: `Projection` of uv (*B, C, N, 2) pixels, depth (*B, C, N) mm and visible (*B, C, N).

    Source: each camera's own lens model, as in OpenCV; `imgcal.CameraRig.project`.

    Example:
        >>> import imgcal
        >>> from imgcal.nn import ProjectRig
        >>> rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
        >>> pose = imgcal.RigidTransform.identity(2, 3, dtype=rig.focal_length.dtype)
        >>> pose.translation[..., 2] = rig.working_distance
        >>> ProjectRig(obj)(rig, pose).uv.shape
        torch.Size([2, 3, 10, 8, 2])
    """

    def __init__(self, obj: CalibrationObject) -> None:
        super().__init__()
        self.obj = ObjectBuffers(obj)

    def forward(self, rig: CameraRig, rig_from_object: RigidTransform | None = None) -> Projection:
        """Project the N fiducials into the C cameras of (*B) rigs; arguments as under Shape."""
        points = self.obj.points.to(rig.focal_length)
        radius = None if self.obj.radius is None else self.obj.radius.to(points)
        if rig_from_object is not None:
            points = rig_from_object.to(points.dtype).apply(points)
        return rig.project(points, radius)
