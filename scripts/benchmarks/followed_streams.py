"""Simulated streams that a monitor follows, and the errors of its belief."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import imgcal
from imgcal.errors import RefusedError
from imgcal.estimation import Gauge, estimate, initial_pose
from imgcal.geometry import RigidTransform
from imgcal.monitoring import Change, RigBelief, RigFilter, RigMonitor
from imgcal.types import CameraRig, DriftRate, Observations
from scripts.benchmarks.rig_streams import Bump, Conditions, Stream

RIGS = ("T4", "O6", "U7", "O10")
BLOCK = 100
"""Snapshots per simulated block."""
SURELY = 26.9
"""Chi-squared with ten degrees of freedom that corresponds to 3 sigma of a single value."""


class Followed:
    """A stream, and the monitor that follows its labelled fiducials."""

    def __init__(self, stream: Stream, drift: DriftRate | None = None) -> None:
        self.stream, self.monitor = stream, RigMonitor(RigFilter(stream.factory, stream.obj, drift))
        self.pose: RigidTransform | None = None
        self.told: list[tuple[int, Change]] = []  # (number of the snapshot in the stream, change)
        self.numbers: list[int] = []  # stream number of each snapshot of the filter
        self.last = 0
        self._ahead: Observations | None = None  # snapshots (S,) that are already simulated ...
        self._rigs, self._labels = stream.rig.expand(1), list[int]()  # ... their true rigs, and numbers of labels
        self._first = self._row = 0

    def step(self, number: int) -> Observations | None:
        """Learn from a snapshot; call for each in order. Returns None if the object is not visible."""
        row = number - self._first
        if self._ahead is None or row >= len(self._ahead.uv):
            self._first, row = number, 0
            self._ahead, self._rigs = self.stream.labelled(number, number + BLOCK)
            self._labels = self._ahead.seen.sum((1, 2)).tolist()
        self._row = row
        if self._labels[row] < 6:
            return None
        observations = self._ahead.of_snapshots([row])
        pose = self.pose
        if pose is None or number - self.last > 3:
            pose = initial_pose(observations, self.monitor.filter.belief.rig, self.stream.obj)
        seconds = (number - self.last) / self.stream.conditions.rate
        try:
            found = self.monitor.update(observations, pose, seconds)
        except RefusedError:
            return None
        self.pose, self.last = found.update.rig_from_object, number
        self.numbers.append(number)
        self.told += [(number, change) for change in found.changes]
        return observations

    @property
    def truth(self) -> CameraRig:
        """True rig at the last snapshot."""
        return self._rigs[self._row]


def stream_of(
    seed: int, name: str, drifting: bool = False, bumps: tuple[Bump, ...] = (), shake: float = 0.0, **more: Any
) -> Stream:
    """Make a labelled stream of a shipped rig and object."""
    drift = DriftRate() if drifting else DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
    factory, obj = imgcal.load_rig(name), imgcal.load_object("asymmetric8")
    return Stream(factory, obj, seed, Conditions(shake=shake, drift=drift, labelled=True), bumps, **more)


def held_out(rig: CameraRig, truth: CameraRig, stream: Stream) -> float:
    """RMS residual (px) of exact points in unseen poses, with fitted poses."""
    poses = RigidTransform.cat([stream.pose_at(1000.0 + 0.37 * number) for number in range(30)])
    image = truth.expand(30).project(poses.apply(stream.obj.points), stream.obj.radius)
    exact = Observations(image.uv, torch.full(image.uv.shape[:-1], 0.1, dtype=torch.float64), image.visible)
    held = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
    fit = estimate(exact, rig, stream.obj, poses, prior_std=held)
    return float(fit.residual[image.visible].square().sum(-1).mean().sqrt())


def distance(belief: RigBelief, truth: CameraRig) -> Tensor:
    """Chi-squared (C,) of ten parameters of each camera, after alignment with the truth."""
    gauge = Gauge(torch.full((truth.num_cameras,), 1 / truth.num_cameras, dtype=torch.float64))
    error, jacobian = gauge.difference(belief.rig, truth)[:, :10], gauge.jacobian(truth)
    covariance = jacobian @ belief.covariance() @ jacobian.mT
    blocks = covariance.unflatten(0, (-1, 15)).unflatten(-1, (-1, 15)).diagonal(dim1=0, dim2=2).movedim(-1, 0)
    return (error * torch.linalg.solve(blocks[:, :10, :10], error[..., None])[..., 0]).sum(-1)
