"""What is known of a running rig after a snapshot."""

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

CameraHealth = Literal["ok", "doubtful", "relearning", "blind", "dirty", "defocused", "lost", "unseen"]
UNTRUSTED: frozenset[CameraHealth] = frozenset({"doubtful", "lost"})
"""Cameras whose labels say nothing of where the object is."""


@dataclass(frozen=True)
class RigState:
    """A rig that is kept calibrated, as it is after a snapshot.

    Health of a camera: `ok`, what is said of it holds; `doubtful`, its last snapshots do not fit, and it is not decided
    yet whether it moved; `relearning`, it has moved, and is not known again as well as before; `lost`, nothing comes
    from it, or what it sees cannot be told apart: its values may hold no more; `unseen`, it has not seen the object
    yet: the factory's values. The others are told by detectors that look at frames.

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
    belief: RigBelief  # the rig, and how surely it is known
    factory: CameraRig
    cameras: Mapping[str, CameraHealth]
    sentence: str  # of state, for people
    refused: str | None  # why this snapshot taught nothing
    detections: Detections  # blobs of this snapshot, labelled where identified
    lag: NDArray[np.float64]  # (M, 2) pixels to be added to these, where cameras expose later and the object moves
    predicted: NDArray[np.float64]  # (C, N, 2) pixels where the rig puts the fiducials; nan where that is not known
    residual: NDArray[np.float64]  # (C,) RMS pixels of this snapshot; nan where nothing was seen
    rig_from_object: RigidTransform | None
    events: tuple[Event, ...]  # that became known with this snapshot
    clock_offset: NDArray[np.float64]  # (C,) s that a camera exposes later than most; nan = not known
    clock_offset_sigma: NDArray[np.float64]  # (C,) s, one standard deviation
    noise: NDArray[np.float64]  # (C,) pixels, that blobs have beyond what they say of themselves
    shake: NDArray[np.float64]  # (C,) pixels, by which all that a camera sees is shifted alike, each time otherwise
    lights: FoundLights | None = None  # which blobs show the same light; None = an object is known, or none was found

    @property
    def rig(self) -> CameraRig:
        """The rig as it is now."""
        return self.belief.rig

    @cached_property
    def object_pose(self) -> ObjectPose | None:
        """The object's pose in this snapshot with its covariance; None = it was not seen, or not well enough."""
        if self.rig_from_object is None:
            return None
        trusted = np.array([health not in UNTRUSTED for health in self.cameras.values()])
        return object_pose(self.belief, self.rig_from_object, self.detections, self.noise, self.shake, trusted)

    @cached_property
    def light_points(self) -> LightPoints | None:
        """Where the lights are that were found in this snapshot; None = there are none, or an object is known."""
        if self.lights is None:
            return None
        trusted = np.array([health not in UNTRUSTED for health in self.cameras.values()])
        return light_points(self.belief, self.lights, self.noise, self.shake, trusted)

    @cached_property
    def gauge(self) -> Gauge:
        """Which cameras are taken to have stood still since the factory calibration: what most agree on."""
        return Gauge.from_majority(self.rig, self.factory)

    @cached_property
    def moved(self) -> Tensor:
        """Change of every parameter against the factory rig, a motion of the whole rig taken out: (C, K)."""
        return self.gauge.difference(self.rig, self.factory)

    @cached_property
    def scale(self) -> tuple[float, float]:
        """Size of the rig against the factory's, relative, and one standard deviation of it.

        Lights of which nothing is known say nothing of it by themselves. It goes along with what they teach of the
        cameras as far as a calibration has left both open together.
        """
        now, before = (rig.positions - rig.positions.mean(0) for rig in (self.rig, self.factory))
        return float((now.norm() / before.norm()) - 1), self.belief.scale_std()

    @cached_property
    def std(self) -> Tensor:
        """One standard deviation of `moved`, and so of the cameras against most of the others: (C, K)."""
        return self.gauge.spread(self.rig, self.belief.covariance())
