"""`RigPosterior`: how well a calibration knows a rig and its object, jointly."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from imgcal.types.rig import CameraRig


@dataclass(frozen=True)
class RigPosterior:
    """The joint posterior of a rig's values and of the object's shape, as `monitoring.RigBelief` has it.

    D = K C + M errors in units: of C cameras, and M values of the object.
    """

    rig: CameraRig  # the most probable one, float64, without batch axes
    points: Tensor  # (N, 3) mm, fiducials as the object's file says
    tolerance: Tensor  # (N,) mm, by which they may be off; zeros = exact
    scale_tolerance: float
    object_offset: Tensor  # (M,) in standard deviations of that tolerance; M = 0 where the object is exact
    factor: Tensor  # (D, D) lower Cholesky factor of the information
    unit: Tensor  # (C, K) rad, mm, pixels, 1
    snapshots: int  # from which it was made
    time: float | None = None  # s since the epoch, when that was; None = not known

    def belongs_to(self, rig: CameraRig) -> bool:
        """Tell whether this is about a rig with just these values: not one that has been changed since."""
        mine, others = (
            (one.cam_from_rig.rotation, one.cam_from_rig.translation, one.focal_length, one.principal_point,
             one.distortion)
            for one in (self.rig, rig)
        )  # fmt: skip
        return all(
            a.shape == b.shape and bool((a.double() - b.double()).abs().max() <= 1e-9 * (1 + a.double().abs().max()))
            for a, b in zip(mine, others, strict=True)
        )
