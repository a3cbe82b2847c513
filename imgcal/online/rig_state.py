"""The state of a running rig after a snapshot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import Gauge
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.online.events import Event
from imgcal.online.light_points import FoundLights, LightPoints, light_points
from imgcal.online.object_pose import ObjectPose, object_pose
from imgcal.types import CameraRig, Detections

ImageHealth = Literal["blind", "dirty", "defocused"]
"""Health of a camera according to tests of its images."""
CameraHealth = Literal["ok", "hidden", "doubtful", "relearning", "lost", "unseen", ImageHealth]
CALIBRATED: frozenset[CameraHealth] = frozenset({"ok", "hidden"})
"""Health of cameras whose values hold, as far as is known."""
UNTRUSTED: frozenset[CameraHealth] = frozenset({"hidden", "doubtful", "lost"})
"""Cameras with this health do not count for the object's pose."""


@dataclass(frozen=True)
class RigState:
    """A rig that is kept calibrated, after a snapshot.

    Health of a camera: `ok`, its values hold; `hidden`, it does not see the object, which should be in view, and keeps
    its values; `doubtful`, its last snapshots do not fit, and it is undecided whether it moved; `relearning`, it has
    moved, and is not known as well yet as before; `lost`, it sends nothing, or its blobs cannot be labelled, so its
    values may no longer hold; `unseen`, it has not seen the object yet and has the factory's values. The other values
    come from tests of the images.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 1, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> with imgcal.RigKeeper(factory, obj) as keeper:
        ...     state = keeper.update(true_detections(truth), time=0.0)
        >>> state.cameras["cam01"], state.refused, state.events
        ('ok', None, ())
    """

    time: float  # s since the epoch
    snapshot: int  # number of the update
    belief: RigBelief  # the rig and its uncertainty
    factory: CameraRig
    cameras: Mapping[str, CameraHealth]
    sentence: str  # description of the state
    refused: str | None  # why this snapshot taught nothing
    detections: Detections  # blobs of this snapshot, labelled where identified
    lag: NDArray[np.float64]  # (M, 2) pixels to add to these of late cameras; nan if the object's motion is unknown
    predicted: NDArray[np.float64]  # (C, N, 2) pixels, predicted fiducials; nan if unknown
    residual: NDArray[np.float64]  # (C,) RMS pixels of this snapshot; nan if nothing was seen
    rig_from_object: RigidTransform | None
    events: tuple[Event, ...]  # that this snapshot has revealed
    clock_offset: NDArray[np.float64]  # (C,) s, delay of a camera relative to most; nan = unknown
    clock_offset_sigma: NDArray[np.float64]  # (C,) s, one standard deviation
    noise: NDArray[np.float64]  # (C,) pixels, noise of blobs beyond their own sigmas
    shake: NDArray[np.float64]  # (C,) pixels, random shift shared by all blobs of a camera
    persistent: NDArray[np.float64]  # (C,) pixels, the same of shifts that last, as if each snapshot had another one
    lights: FoundLights | None = None  # which blobs show the same light; None = no lights found, or a known object

    @property
    def rig(self) -> CameraRig:
        """The rig as currently estimated."""
        return self.belief.rig

    @property
    def uncalibrated(self) -> tuple[str, ...]:
        """Cameras whose values may not hold."""
        return tuple(name for name, health in self.cameras.items() if health not in CALIBRATED)

    @cached_property
    def object_pose(self) -> ObjectPose | None:
        """The object's pose in this snapshot with its covariance; None = not seen, or not well enough."""
        if self.rig_from_object is None:
            return None
        trusted = np.array([health not in UNTRUSTED for health in self.cameras.values()])
        return object_pose(self.belief, self.rig_from_object, self.detections, self.noise, self.shake, trusted)

    @cached_property
    def light_points(self) -> LightPoints | None:
        """Positions of the lights in this snapshot; None = there are none, or the object is known."""
        if self.lights is None:
            return None
        trusted = np.array([health not in UNTRUSTED for health in self.cameras.values()])
        return light_points(self.belief, self.lights, self.noise, self.shake, trusted)

    @cached_property
    def gauge(self) -> Gauge:
        """The cameras assumed to have stood still since the factory calibration: the largest group that agrees."""
        return Gauge.from_majority(self.rig, self.factory)

    @cached_property
    def moved(self) -> Tensor:
        """Change of every parameter since the factory calibration, without a motion of the whole rig: (C, K)."""
        return self.gauge.difference(self.rig, self.factory)

    @cached_property
    def scale(self) -> tuple[float, float]:
        """Size of the rig relative to the factory's, and its standard deviation.

        Unknown lights do not determine it. It changes with what they show about the cameras, as far as an earlier
        calibration left a correlation between both. Sticks and several objects do; lengths in their files count as
        exact.
        """
        now, before = (rig.positions - rig.positions.mean(0) for rig in (self.rig, self.factory))
        return float((now.norm() / before.norm()) - 1), self.belief.scale_std()

    @cached_property
    def std(self) -> Tensor:
        """Standard deviation of `moved`, which is relative to most of the other cameras: (C, K)."""
        return self.gauge.spread(self.rig, self.belief.covariance())
