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
from imgcal.estimation.rig_error import step_by_error
from imgcal.geometry import RigidTransform, cross_matrix, rotate, rotation_from_vector, vector_from_rotation
from imgcal.types import EXTRINSICS, CameraRig

VOTE_SCALE = (0.01,) * 3 + (10.0,) * 3
"""Radians and millimetres with equal weight when cameras vote: they move an image equally at about arm's length."""
ROUNDS = 15
"""Rounds of each of the two kinds of votes."""
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
        squares, positions, moved = _error_squares(factory), factory.positions, _motions(rig, factory)
        gauge = cls(torch.ones(rig.num_cameras, dtype=torch.float64))
        scale, at = positions.new_tensor(VOTE_SCALE), cross_matrix(positions)
        # First the geometric median, which is robust up to half of the cameras; then Cauchy weights about it.
        for vote in (lambda apart: 1 / apart, lambda apart: 1 / (1 + (apart / apart.median()).square())):
            moved = gauge._common(moved, squares).inverse() @ moved
            errors = _errors(moved)
            shifts = errors[:, 3:] + rotate(moved.rotation, positions) - positions
            steps = torch.cat((errors[:, :3], shifts), dim=-1)
            # What is left is small for most cameras: to first order, all follow a change of the common motion at once.
            for _ in range(ROUNDS):
                common = gauge._averaging(squares) @ errors.flatten()
                turned = common[:3]
                step = torch.cat((turned.expand_as(shifts), common[3:] - at @ turned), dim=-1)
                weights = vote(((steps - step) / scale).norm(dim=-1).clamp_min(LEAST_APART))
                gauge = cls(weights / weights.sum())
        return gauge

    def align(self, rig: CameraRig, factory: CameraRig) -> CameraRig:
        """Align a whole rig (*B) with another one, which may have fewer batch axes."""
        common = self._common(_motions(rig, factory), _error_squares(factory))
        return replace(rig, cam_from_rig=rig.cam_from_rig @ common)

    def _common(self, moved: RigidTransform, squares: Tensor) -> RigidTransform:
        """What the motions of the cameras (*B, C) have in common: (*B, 1)."""
        averaging = self._averaging(squares)
        common = _average(_errors(moved), averaging)
        for _ in range(ALIGNMENTS - 1):
            common = common @ _average(_errors(common.inverse() @ moved), averaging)
        return common

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
        return self._averaging(_error_squares(factory))

    def _averaging(self, squares: Tensor) -> Tensor:
        """As `averaging_matrix`, from the squares of the cameras' errors (*B, C, 6, 6)."""
        weighted = squares * self.weights.to(squares)[:, None, None]
        return torch.linalg.solve(weighted.sum(-3), weighted.movedim(-3, -2).flatten(-2))


def _motions(rig: CameraRig, factory: CameraRig) -> RigidTransform:
    """Motion of each camera in the rig's frame since the factory: (*B, C)."""
    return rig.cam_from_rig.inverse() @ factory.cam_from_rig


def _errors(moved: RigidTransform) -> Tensor:
    """Motions of cameras as errors (rad, mm), see `rig_error`: (*B, C, 6)."""
    return torch.cat((vector_from_rotation(moved.rotation), moved.translation), dim=-1)


def _average(errors: Tensor, averaging: Tensor) -> RigidTransform:
    """Average motion of the cameras, to first order, by their errors (*B, C, 6): (*B, 1)."""
    common = (averaging @ errors.flatten(-2)[..., None])[..., 0].unsqueeze(-2)
    return RigidTransform(rotation_from_vector(common[..., :3]), common[..., 3:])


def _error_squares(factory: CameraRig) -> Tensor:
    """Matrices S of the cameras' votes: an error e (6,) of a camera counts e^T S e; (*B, C, 6, 6)."""
    scaled = _scale(step_by_error(factory)[..., :EXTRINSICS, :EXTRINSICS].mT).mT
    return scaled.mT @ scaled


def _scale(step: Tensor) -> Tensor:
    """Extrinsics (..., 6 or K) in units of `VOTE_SCALE`: (..., 6)."""
    return step[..., :EXTRINSICS] / step.new_tensor(VOTE_SCALE)
