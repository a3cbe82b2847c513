"""`ReprojectionLoss`: reprojection error of the fiducials in pixels; projected by kornia."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from imgcal.geometry import project_kornia
from imgcal.nn.buffers import ObjectBuffers
from imgcal.types import CalibrationObject, CameraRig, Prediction

# Nearer points are projected at a least depth: mm, or this share of the working distance if that is less. Differences
# are clipped to this size (pixels). Otherwise predictions behind a camera, as of an untrained network, overflow float32
# and give nan gradients even where the loss itself is clamped.
LEAST_DEPTH, LEAST_SHARE, LARGEST_DIFFERENCE = 50.0, 0.1, 1e6


class ReprojectionLoss(nn.Module):
    """Root mean squared difference between pixel coordinates of fiducials.

    Computed in float32 or better even under autocast: bfloat16 would round a coordinate of 1234.567 to 1232. Finite
    with finite gradients also for cameras with fiducials behind them.

    Args:
        obj: N fiducials (mm); those with a radius are spheres, whose apparent centres are projected.
        reduction: "mean" over rigs, "sum", or "none".

    Shape:
        - prediction: (*B) rigs of C cameras, and poses.
        - target: the true (*B) prediction, or (*B, C, N, 2) true pixels of the fiducials.
        - seen: (*B, C, N) bool: valid fiducials; None = all.
        - Output: pixels, () or with reduction "none" (*B); zero without valid fiducials.

    Source: paper section 4.3; projection through `kornia.geometry.calibration.distort_points`.

    Example:
        >>> import imgcal
        >>> from imgcal.nn import ReprojectionLoss
        >>> from imgcal.types import Prediction
        >>> rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
        >>> pose = imgcal.RigidTransform.identity(dtype=rig.focal_length.dtype)
        >>> pose.translation[2] = rig.working_distance
        >>> target = rig.project(pose.apply(obj.points)).uv
        >>> round(ReprojectionLoss(obj)(Prediction(rig, pose), target + 1).item(), 6)
        1.0
    """

    def __init__(self, obj: CalibrationObject, reduction: Literal["mean", "sum", "none"] = "mean") -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', found {reduction!r}")
        self.obj, self.reduction = ObjectBuffers(obj), reduction

    def forward(self, prediction: Prediction, target: Prediction | Tensor, seen: Tensor | None = None) -> Tensor:
        """Compute the loss in pixels, () or (*B); arguments as under Shape.

        Raises:
            ValueError: target or seen have another shape.
        """
        with torch.autocast(prediction.rig.focal_length.device.type, enabled=False):
            obj = self.obj()
            uv = project_fiducials(_exact(prediction).cameras_from_object, obj)
            if isinstance(target, Prediction):
                target = project_fiducials(_exact(target).cameras_from_object, obj)
            for name, found, expected in (("target", target, uv), ("seen", seen, uv[..., 0])):
                if found is not None and found.shape != expected.shape:  # broadcast, it would mix cameras
                    raise ValueError(f"{name}: found shape {tuple(found.shape)}, expected {tuple(expected.shape)}")
            each = rms_per_axis(uv - target, seen)
        if self.reduction == "none":
            return each
        return each.mean() if self.reduction == "mean" else each.sum()

    def extra_repr(self) -> str:
        """Describe the settings."""
        return f"reduction={self.reduction!r}"


def project_fiducials(cameras: CameraRig, obj: CalibrationObject) -> Tensor:
    """Project the fiducials through kornia into cameras given in the object's frame.

    Args:
        cameras: (*B) rigs whose cam_from_rig is cam_from_object.
        obj: the object, including the radius of spherical fiducials.

    Returns:
        (*B, C, N, 2) pixels, finite for finite cameras. Fiducials nearer than 50 mm, or a tenth of the rig's working
        distance if that is less, are projected at that depth.
    """
    points = cameras.cam_from_rig.apply(obj.points.to(cameras.focal_length))
    least = LEAST_DEPTH
    if cameras.working_distance is not None:
        least = min(least, LEAST_SHARE * cameras.working_distance)
    points = torch.cat((points[..., :2], points[..., 2:].clamp_min(least)), dim=-1)
    radius = None if obj.radius is None else obj.radius.to(points)
    lens = (cameras.focal_length, cameras.principal_point, cameras.distortion)
    return project_kornia(points, *lens, cameras.image_size, radius, cameras.lens_model).uv


def rms_per_axis(difference: Tensor, seen: Tensor | None = None) -> Tensor:
    """Root mean square of the coordinates of differences, for each rig.

    Args:
        difference: (*B, C, N, 2) pixels between two images of the fiducials.
        seen: (*B, C, N) bool: valid fiducials, the others may have any value; None = all.

    Returns:
        (*B) pixels.
    """
    if seen is None:
        return root(squared(difference).mean((-3, -2, -1)))
    counted = torch.where(seen[..., None], difference, 0.0)
    mean = squared(counted).sum((-3, -2, -1)) / (2 * seen.sum((-2, -1))).clamp_min(1)
    return root(mean)


def squared(difference: Tensor) -> Tensor:
    """Square differences in pixels, clipped so that float32 does not overflow."""
    return difference.clamp(-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE).square()


def root(mean_square: Tensor) -> Tensor:
    """Square root with zero gradient at zero instead of an infinite one."""
    return mean_square.clamp_min(1e-20).sqrt()


def _exact(prediction: Prediction) -> Prediction:
    """Convert half precision to float32."""
    dtype = prediction.rig.focal_length.dtype
    return prediction.to(torch.float32) if dtype in (torch.bfloat16, torch.float16) else prediction
