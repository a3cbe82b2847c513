"""Gauges: which cameras are taken to have stood still, since motion of cameras is only relative.

No image shows a motion of the whole rig, so two calibrations can only be compared after one is aligned with the other.
Aligned on a single reference camera, all others seem to have moved if the reference was bumped. Aligned on what most
cameras agree on, the bumped camera stands out, whichever it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.estimation.covariance import camera_covariance
from imgcal.estimation.curvature import curvature_covariance
from imgcal.estimation.map_estimate import Estimate
from imgcal.estimation.rig_error import error_between, step_by_error
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.types import CameraRig

EXTRINSICS = 6
VOTE_SCALE = (0.01,) * 3 + (10.0,) * 3
"""Radians and millimetres with equal weight when cameras vote: they move an image equally at about arm's length."""
ROUNDS = 30
ALIGNMENTS = 4
"""Alignment rounds; each squares the remaining error."""
LEAST_APART = 1e-6
"""In units of `VOTE_SCALE`: cameras closer than this to the common motion have equal weight."""


@dataclass(frozen=True)
class Gauge:
    """Weights of the cameras when a rig is aligned with its factory values."""

    weights: Tensor  # (C,) float64, at least one positive
    reference: int | None = None  # the only camera with weight; None = what most cameras agree on

    @classmethod
    def from_camera(cls, reference: int, cameras: int) -> Gauge:
        """Assume that one camera has stood still."""
        return cls(torch.nn.functional.one_hot(torch.tensor(reference), cameras).double(), reference)

    @classmethod
    def from_majority(cls, rig: CameraRig, factory: CameraRig) -> Gauge:
        """Let the cameras vote: those that moved differently from most lose their weight.

        Args:
            rig: a calibration, without batch axes.
            factory: the calibration to compare with.
        """
        weights = torch.ones(rig.num_cameras, dtype=torch.float64)
        there = cls(weights).align(rig, factory)
        for round_ in range(ROUNDS):
            if round_:  # one step is enough from the previous alignment
                there = cls(weights)._align_once(there, factory)
            apart = _scale(there.local(factory)).norm(dim=-1).clamp_min(LEAST_APART)
            # First the geometric median, which is robust up to half of the cameras; then Cauchy weights about it.
            weights = 1 / apart if round_ < ROUNDS // 2 else 1 / (1 + (apart / apart.median()).square())
            weights = weights / weights.sum()
        return cls(weights)

    def align(self, rig: CameraRig, factory: CameraRig) -> CameraRig:
        """Align a whole rig (*B) with another one, which may have fewer batch axes."""
        for _ in range(ALIGNMENTS):
            rig = self._align_once(rig, factory)
        return rig

    def _align_once(self, rig: CameraRig, factory: CameraRig) -> CameraRig:
        """Do one alignment step."""
        motion = self.averaging_matrix(factory) @ error_between(rig, factory)[..., :EXTRINSICS].flatten(-2)[..., None]
        turn = rotation_from_vector(motion[..., :3, 0])
        transform = RigidTransform(turn.unsqueeze(-3), motion[..., 3:, 0].unsqueeze(-2))
        return replace(rig, cam_from_rig=rig.cam_from_rig @ transform)

    def difference(self, rig: CameraRig, factory: CameraRig) -> Tensor:
        """Change of every parameter without the motion of the whole rig: (*B, C, K)."""
        return self.align(rig, factory).local(factory)

    def jacobian(self, factory: CameraRig) -> Tensor:
        """Jacobian of the difference by the parameters: (K C, K C)."""
        cameras = factory.num_cameras
        step = step_by_error(factory)[:, :EXTRINSICS, :EXTRINSICS]
        averaging = self.averaging_matrix(factory).unflatten(-1, (cameras, EXTRINSICS))  # (6, C, 6)
        common = torch.einsum("cij,jdk,dkl->cidl", step, averaging, torch.linalg.inv(step))
        jacobian = torch.eye(cameras * factory.num_parameters, dtype=torch.float64)
        blocks = jacobian.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
        blocks[:, :EXTRINSICS, :, :EXTRINSICS] -= common
        return jacobian

    def std(self, estimate: Estimate) -> Tensor:
        """Standard deviation of the difference of an estimate (no batch axes) from a fixed rig: (C, K)."""
        jacobian = self.jacobian(estimate.rig)
        covariance = jacobian @ camera_covariance(estimate, curved=False) @ jacobian.mT
        centre = estimate.rig.reshape(1).map_tensors(lambda tensor, _: tensor.unsqueeze(1))
        covariance = covariance + curvature_covariance(
            estimate, lambda rigs, _: self.difference(rigs, centre).flatten(-2), covariance
        )
        return self._root(covariance.diagonal())

    def spread(self, rig: CameraRig, covariance: Tensor) -> Tensor:
        """Standard deviation of the difference of a rig whose cameras have a covariance (K C, K C): (C, K)."""
        jacobian = self.jacobian(rig)
        return self._root((jacobian @ covariance * jacobian).sum(-1))

    def prior_std(self, factory: CameraRig, std: Tensor) -> Tensor:
        """The same for the prior, from independent standard deviations (C, K): (C, K)."""
        return self._root(self.jacobian(factory).square() @ std.double().flatten().square())

    def _root(self, variance: Tensor) -> Tensor:
        """Standard deviations; exactly zero for the reference camera."""
        std = variance.clamp_min(0).sqrt().unflatten(0, (len(self.weights), -1)).clone()
        if self.reference is not None:
            std[self.reference, :EXTRINSICS] = 0
        return std

    def averaging_matrix(self, factory: CameraRig) -> Tensor:
        """Matrix from the errors of all cameras (6 C,) to their common motion (6,): (*B, 6, 6 C)."""
        scaled = _scale(step_by_error(factory)[..., :EXTRINSICS, :EXTRINSICS].mT).mT
        weighted = scaled.mT @ scaled * self.weights.to(scaled)[:, None, None]
        return torch.linalg.solve(weighted.sum(-3), weighted.movedim(-3, -2).flatten(-2))


def _scale(step: Tensor) -> Tensor:
    """Extrinsics (..., 6 or K) in units of `VOTE_SCALE`: (..., 6)."""
    return step[..., :EXTRINSICS] / step.new_tensor(VOTE_SCALE)
