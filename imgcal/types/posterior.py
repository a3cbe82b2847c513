"""`RigPosterior`: joint uncertainty of a calibrated rig and its object."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from imgcal.types.rig import CameraRig


@dataclass(frozen=True)
class RigPosterior:
    """Joint posterior of a rig's values and the object's shape, in the form of `monitoring.RigBelief`.

    D = K C + M errors: K for each of C cameras, in units of `unit`, and M for the object, in standard deviations.
    """

    rig: CameraRig  # the most probable one, float64, without batch axes
    points: Tensor  # (N, 3) mm, fiducials from the object's file
    tolerance: Tensor  # (N,) mm, one standard deviation of each coordinate; zeros = exact
    scale_tolerance: float
    object_offset: Tensor  # (M,) in standard deviations of that tolerance; M = 0 where the object is exact
    factor: Tensor  # (D, D) lower Cholesky factor of the information
    unit: Tensor  # (C, K) rad, mm, pixels, 1
    snapshots: int  # number of snapshots that it is based on
    time: float | None = None  # s since the epoch, when it was made; None = unknown

    def belongs_to(self, rig: CameraRig) -> bool:
        """Tell whether this describes a rig with exactly these values, not one that has been changed since."""
        mine, others = (
            (one.cam_from_rig.rotation, one.cam_from_rig.translation, one.focal_length, one.principal_point,
             one.distortion)
            for one in (self.rig, rig)
        )  # fmt: skip
        return all(
            a.shape == b.shape and bool((a.double() - b.double()).abs().max() <= 1e-9 * (1 + a.double().abs().max()))
            for a, b in zip(mine, others, strict=True)
        )
