"""How far each camera has moved since the factory calibration, assuming that most cameras stood still."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from imgcal.estimation import Gauge
from imgcal.pipeline.calibration import Calibration
from imgcal.types import SHOWN_UNITS, Kind, MovedCamera

MOVED = 3.0
"""A value has moved if its change from the factory is larger than this many standard deviations."""


@dataclass(frozen=True)
class Motion:
    """Changes of all cameras, without a motion of the whole rig."""

    gauge: Gauge
    camera_names: tuple[str, ...]  # C
    change: Tensor  # (C, K) recalibrated minus factory, as `CameraRig.parameter_names`
    std: Tensor  # (C, K) one standard deviation of the change; zero for fixed values

    @property
    def rotation_deg(self) -> Tensor:
        """Rotation angle of each camera: (C,)."""
        return self.change[:, :3].norm(dim=-1) * (180 / math.pi)

    @property
    def position_mm(self) -> Tensor:
        """Displacement of each camera: (C,)."""
        return self.change[:, 3:6].norm(dim=-1)

    @property
    def moved(self) -> tuple[int, ...]:
        """Cameras whose rotation or position has changed significantly, largest change first."""
        beyond = ((self.change.abs() > MOVED * self.std) & (self.std > 0))[:, :6].any(dim=-1)
        far = self.rotation_deg + self.position_mm / 10
        return tuple(int(c) for c in far.argsort(descending=True) if beyond[c])

    @property
    def moves(self) -> tuple[MovedCamera, ...]:
        """The same cameras with their most significant change: a rotation (deg) or a position (mm)."""
        return tuple(self._move(c) for c in self.moved)

    def _move(self, camera: int) -> MovedCamera:
        change, std = self.change[camera, :6].view(2, 3), self.std[camera, :6].view(2, 3)
        size = change.norm(dim=-1)
        sigma = (change * std).norm(dim=-1) / size.clamp_min(1e-30)  # of the length, along the change
        turned = bool(size[0] * sigma[1] >= size[1] * sigma[0])
        kind: Kind = "rotation" if turned else "position"
        row, (_, scale) = int(not turned), SHOWN_UNITS[kind]
        return MovedCamera(self.camera_names[camera], None, kind, float(size[row]) * scale, float(sigma[row]) * scale)

    @property
    def sentence(self) -> str:
        """Describe them: "1 of 8 cameras moved since the factory calibration: mocap1 (2.01 deg, 15.2 mm)"."""
        moved, count = self.moved, len(self.camera_names)
        if count == 1:
            return ""
        if not moved:
            return "no camera has moved measurably relative to the others since the factory calibration"
        named = ", ".join(
            f"{self.camera_names[c]} ({float(self.rotation_deg[c]):.2f} deg, {float(self.position_mm[c]):.1f} mm)"
            for c in moved[:3]
        )
        most = ", most of all" if len(moved) > 3 else ":"
        return f"{len(moved)} of {count} cameras moved since the factory calibration{most} {named}"


def motion_since_factory(calibration: Calibration, gauge: Gauge | None = None) -> Motion:
    """Compare a calibration with the factory rig.

    Args:
        calibration: the calibration.
        gauge: the cameras assumed to have stood still; None = the largest group that agrees.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
        >>> step = torch.zeros(10, 15, dtype=torch.float64)
        >>> step[0, 3] = 5.0  # mm: the first camera has been bumped
        >>> truth = simulate_truth(factory.retract(step), obj, 6, torch.Generator().manual_seed(1), None)
        >>> motion = motion_since_factory(imgcal.calibrate(true_detections(truth), factory, obj))
        >>> motion.camera_names[motion.moved[0]], round(float(motion.position_mm[0]))
        ('cam01', 5)
    """
    rig, factory = calibration.rig, calibration.factory
    if gauge is None:
        gauge = Gauge.from_camera(0, 1) if rig.num_cameras == 1 else Gauge.from_majority(rig, factory)
    change = gauge.difference(rig, factory).detach()
    return Motion(gauge, rig.camera_names, change, gauge.std(calibration.estimate))
