"""What is known about a rig (`RigBelief`), its update by snapshots (`MeasurementUpdate`), and its decay with time.

Information is kept as its Cholesky factor, about errors in which a motion of the whole rig has the same direction
everywhere (`rig_error.py`). It therefore says nothing about directions that no image shows, however often the estimate
has moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import Problem, levenberg_marquardt_cpu, object_prior_std, step_by_error
from imgcal.geometry import RigidTransform
from imgcal.monitoring.change_test import camera_change_errors
from imgcal.monitoring.measurement_update_cpu import NOTHING_KNOWN, WHY_NOT
from imgcal.monitoring.rig_arrays import RigArrays
from imgcal.monitoring.snapshot_information import SnapshotInformation, add_blocks
from imgcal.types import CalibrationObject, CameraRig, DriftRate, RigPrior

LEAST_STD = (1e-9,) * 3 + (1e-6,) * 3 + (1e-6,) * 4
LEAST_COEFFICIENT = 1e-9
"""Standard deviation (rad, mm, pixels, 1) of a fixed value: small, but not zero."""


@dataclass(frozen=True)
class ObjectArrays:
    """An object and lenses as compiled loops need them."""

    shared: tuple[NDArray[np.float64] | None, ...]  # see `linearization_cpu`
    centroid: NDArray[np.float64]  # (3,) mm
    own_std: NDArray[np.float64]  # (M,) prior standard deviation of the object's offset
    pose_rank: int  # degrees of freedom of a pose that the object determines
    parts: tuple[tuple[int, NDArray[np.float64]], ...]  # known objects among lights: first number, markers (n, 3) mm

    @classmethod
    def of(cls, obj: CalibrationObject, rig: CameraRig) -> ObjectArrays:
        """Take an object and the lenses of a rig."""
        centroid = obj.points.mean(0)
        own_std = obj.points.new_zeros(0) if obj.exact else object_prior_std(obj)
        squared = None if obj.radius is None else obj.radius.double().square()
        none = obj.points.new_zeros(0)
        problem = Problem(none, none, obj.points - centroid, centroid, squared, rig, none)
        shared = levenberg_marquardt_cpu.shared_arrays(problem)
        return cls(shared, centroid.numpy(), own_std.numpy(), obj.pose_rank, obj.known_parts)


@dataclass(frozen=True)
class RigBelief:
    """The most probable rig, and its uncertainty."""

    rig: CameraRig  # without batch axes, float64
    obj: CalibrationObject  # as given, with its tolerances
    object_offset: Tensor  # (M,) estimate in units of its prior standard deviation; M = 0 if it is exact
    factor: Tensor  # (D, D) lower Cholesky factor of the information; D = K C + M
    unit: Tensor  # (C, K) rad, mm, pixels, 1: units of the cameras' errors

    STATE: ClassVar = {
        "rig": ("rig", CameraRig),
        "object": ("obj", CalibrationObject),
        "object_offset": ("object_offset", Tensor),
        "factor": ("factor", Tensor),
        "unit": ("unit", Tensor),
        # `absorb` has these at hand; the properties would round them differently.
        "information": ("information", Tensor),
        "arrays": ("arrays", RigArrays),
    }

    @classmethod
    def of_prior(cls, rig: CameraRig, obj: CalibrationObject, prior_std: Tensor | None = None) -> RigBelief:
        """The factory calibration: `prior_std` (C, K), None = as in the rig file."""
        rig = rig.to(torch.float64)
        std = (rig.prior or RigPrior()).std(rig) if prior_std is None else prior_std
        least = torch.full((rig.num_parameters,), LEAST_COEFFICIENT, dtype=torch.float64)
        least[: len(LEAST_STD)] = torch.tensor(LEAST_STD, dtype=torch.float64)
        unit = std.double().clamp_min(least)
        step = whiten(step_by_error(rig), unit)
        own, wide = 0 if obj.exact else 3 * obj.num_fiducials + 1, rig.num_cameras * rig.num_parameters
        information = torch.eye(wide + own, dtype=torch.float64)
        add_blocks(information, step.mT @ step - torch.eye(rig.num_parameters, dtype=torch.float64))
        return cls(rig, obj, rig.focal_length.new_zeros(own), cholesky_factor(information), unit)

    @cached_property
    def information(self) -> Tensor:
        """Inverse covariance (D, D) of the errors in their units."""
        return self.factor @ self.factor.mT

    @cached_property
    def arrays(self) -> RigArrays:
        """The values of the rig, (C, ...) each, for compiled loops."""
        return RigArrays.of(self.rig)

    @cached_property
    def half_log_determinant(self) -> float:
        """Half of the log determinant of the information."""
        return float(np.log(self.factor.numpy().diagonal()).sum())

    @cached_property
    def constants(self) -> ObjectArrays:
        """The object and the lenses as compiled loops need them; shared by all beliefs about them."""
        return ObjectArrays.of(self.obj, self.rig)

    def covariance(self) -> Tensor:
        """Joint covariance (K C, K C) of the cameras in the units and order of `CameraRig.parameter_names`."""
        cameras, wide = self.rig.num_cameras, self.unit.numel()
        covariance = torch.cholesky_inverse(self.factor)[:wide, :wide]
        blocks = covariance.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
        step = step_by_error(self.rig) * self.unit[:, None, :]
        return torch.einsum("cij,cjdk,dlk->cidl", step, blocks, step).reshape(wide, wide)

    def with_covariance(self, covariance: Tensor) -> RigBelief:
        """Replace what is known by a joint covariance (D, D) of all errors in their units.

        Raises:
            RefusedError: it is not positive definite.
        """
        information = torch.cholesky_inverse(cholesky_factor(covariance))
        belief = replace(self, factor=cholesky_factor(information))
        vars(belief)["information"] = information  # the property would multiply the factor out again
        return belief

    def std(self) -> Tensor:
        """One standard deviation of every parameter: (C, K)."""
        inverse, _ = dtrtri(self.factor.numpy().T)  # of the factor, transposed: a third of the work of a covariance
        white = torch.from_numpy(inverse)[: self.unit.numel()].unflatten(0, self.unit.shape)  # (C, K, D)
        step = step_by_error(self.rig) * self.unit[:, None, :]
        return (step @ (white @ white.mT) @ step.mT).diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()

    def scale_std(self) -> float:
        """One standard deviation of the rig's relative size, which lights do not determine."""
        away = self.rig.positions - self.rig.positions.mean(0)
        by_step = torch.zeros_like(self.unit)
        by_step[:, 3:6] = away / away.square().sum()
        by_error = ((step_by_error(self.rig) * self.unit[:, None]).mT @ by_step[..., None]).flatten()
        padded = torch.cat((by_error, by_error.new_zeros(len(self.factor) - len(by_error))))
        return float(torch.linalg.solve_triangular(self.factor, padded[:, None], upper=False).norm())

    @property
    def pose_freedom(self) -> int:
        """Maximum number of degrees of freedom of a snapshot's pose: six, or a position of each light."""
        return 3 * max(self.obj.num_fiducials, 2) if self.obj.unknown_markers else 6

    def points_at(self, rig_from_object: RigidTransform) -> Tensor:
        """Fiducials of an object in poses (S,), or lights (S, N), in the rig's frame: (S, N, 3) mm."""
        if self.obj.unknown_markers:
            return rig_from_object.translation
        return rig_from_object.apply(self.points_object)

    @cached_property
    def points_object(self) -> Tensor:
        """The fiducials as currently estimated: (N, 3) mm."""
        if not len(self.object_offset):
            return self.obj.points
        offset = self.object_offset * object_prior_std(self.obj)
        centroid = self.obj.points.mean(0)
        return centroid + (self.obj.points - centroid) * (1 + offset[-1]) + offset[:-1].unflatten(0, (-1, 3))


@dataclass(frozen=True)
class MeasurementUpdate:
    """The result of absorbing some snapshots."""

    belief: RigBelief
    rig_from_object: RigidTransform  # (S,) the object's poses; (S, N) of lights, see `CalibrationObject.unknown`
    residual: Tensor  # (S, C, N, 2) pixels, predicted minus observed; zero where not seen
    chi2: float  # sum of squared whitened residuals (robust) and the squared whitened change of the belief
    dof: int  # expected chi2: 2 per observation less the degrees of freedom of all poses
    evidence: float  # log probability of the observations, up to a constant for every prior belief (Laplace)
    before: RigBelief  # the belief before them
    brought: SnapshotInformation  # their own information

    def of_last(self) -> MeasurementUpdate:
        """The same, with the pose and residual of the last snapshot only: (1,) and (1, C, N, 2)."""
        return replace(self, rig_from_object=self.rig_from_object[-1:], residual=self.residual[-1:])


def age_belief(belief: RigBelief, seconds: float, rate: DriftRate | Tensor) -> RigBelief:
    """Lower the confidence in a rig after some time, in which every value took its own random walk.

    Args:
        belief: at an earlier time.
        seconds: since then.
        rate: of the random walks; or the standard deviation (C, K) of each after an hour.
    """
    if seconds <= 0:
        return belief
    walk = rate.std(belief.rig) if isinstance(rate, DriftRate) else rate
    variance = walk.square() * (seconds / 3600)
    return widen(belief, variance) if variance.any() else belief


def widen(belief: RigBelief, variance: Tensor) -> RigBelief:
    """Add variances (C, K) to some parameters, in the units and order of `CameraRig.parameter_names`."""
    covariance = torch.cholesky_inverse(belief.factor)
    change = camera_change_errors(belief.rig, belief.unit)
    add_blocks(covariance, (change * variance[:, None, :]) @ change.mT)
    return belief.with_covariance(covariance)


def widen_along(belief: RigBelief, steps: Tensor) -> RigBelief:
    """Add uncertainty along joint changes of all cameras, each one standard deviation long: steps (M, C, K)."""
    covariance = torch.cholesky_inverse(belief.factor)
    error = (camera_change_errors(belief.rig, belief.unit) @ steps[..., None]).flatten(1)
    wide = error.shape[1]
    covariance[:wide, :wide] += error.mT @ error
    return belief.with_covariance(covariance)


def cholesky_factor(matrix: Tensor) -> Tensor:
    """Factorize a matrix that is positive definite up to rounding.

    Raises:
        RefusedError: the matrix is not positive definite.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed):
        raise RefusedError(f"estimation: {WHY_NOT[NOTHING_KNOWN]}")
    return factor


def whiten(step: Tensor, unit: Tensor) -> Tensor:
    """Derivative of whitened offsets by errors in units, from that of a step by an error: (C, K, K)."""
    return step * unit[:, None, :] / unit[:, :, None]
