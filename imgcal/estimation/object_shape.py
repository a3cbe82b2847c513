"""Does the object match its file? Tests of each fiducial from the residuals of a fit, and tolerances to fix it.

A misplaced fiducial shifts all its residuals in the same direction in the object's frame, in every snapshot. The score
is the gradient of the cost by the fiducials' coordinates. Its variance is the information that remains after rig and
poses are marginalized. This is a score test (Rao, Proc. Camb. Phil. Soc. 1948), which needs no second fit. The object's
scale is a separate direction: only the prior of the cameras' positions determines it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import fdtrc, ndtri

from imgcal.estimation.covariance import object_covariance
from imgcal.estimation.levenberg_marquardt import Solution, factorize
from imgcal.estimation.linearization import (
    POSE_PARAMETERS,
    Problem,
    State,
    Step,
    jacobian_at,
    points_at,
    robust_weight,
)
from imgcal.estimation.map_estimate import Estimate, equations_at
from imgcal.estimation.robust_losses import NamedLoss, RobustKernel
from imgcal.estimation.shape_modes import direction_evidence
from imgcal.geometry import pose_rank

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

# Tolerances of fiducials.
UNSURE = 1e-9
"""Relative to the largest information: directions of the shape below it are undetermined (e.g. a rigid motion)."""
WIDE = 0.05
"""Initial tolerance of a fiducial, relative to the object's size."""
NARROW = 1e-4
"""Relative to the object's size: smaller offsets of a fiducial count as none."""
MOST_FIDUCIALS = 64
"""Largest number of fiducials whose shape is tested: larger boards and clouds are trusted as measured."""
WIDEST = 2.0
"""Largest factor on the variance of a common tolerance that allows for the few displacements behind it."""

# Evidence for them.
COMPLEXITY = 3.0
"""Log evidence that each further tolerance must gain."""
LEAD = 5.0
"""Smallest log odds for treating some fiducials as exact and others as off: the exact ones then fix the scale.
Wands of five fiducials that are all off reach 3.7 in 800."""
SNAPSHOTS_TO_BEND = 8
"""Smallest number of snapshots whose scores are compared with each other."""
LEAST_NOISE = 0.01
"""Floor of the noise relative to the stated one: smaller residuals come from the solver, not from the object."""
ROUNDS = 60
"""Most iterations in `learnt_tolerances` and in `offsets`."""


@dataclass(frozen=True)
class ShapeEvidence:
    """Linearized information of a fit about the object's N fiducials."""

    information: Array  # (3 N, 3 N) mm^-2, of the fiducials' coordinates, rig and poses marginalized
    pull: Array  # (3 N,) mm^-1, information times the best-fitting displacement from `places`
    places: Array  # (N, 3) mm, the fiducials as in the object's file, relative to their centroid
    points: Array  # (N, 3) mm, the fiducials as fitted, relative to the same point
    tolerance: Array  # (N,) mm, their tolerances in this fit
    scale_tolerance: float  # relative, that of all distances together
    chi2: float  # of the fit, data and priors
    freedom: float  # its degrees of freedom

    @cached_property
    def directions(self) -> tuple[Floats, Floats, Floats]:
        """Determined directions (3 N, D), the noise variance (D,) along them, and displacements (D,)."""
        values, vectors = np.linalg.eigh(self.information)
        sure = values > UNSURE * values[-1]
        vectors, variance = vectors[:, sure], 1 / values[sure]
        return vectors, variance, variance * (vectors.T @ self.pull)

    def marginalize_scale(self) -> ShapeEvidence:
        """Take out what the common scale may explain within its tolerance, so that no fiducial is blamed for it."""
        if self.scale_tolerance == 0:
            return self
        scale = self.information @ self.places.ravel()
        variance = 1 / (float(self.places.ravel() @ scale) + self.scale_tolerance**-2.0)
        return replace(
            self,
            information=self.information - variance * np.outer(scale, scale),
            pull=self.pull - variance * float(self.places.ravel() @ self.pull) * scale,
            scale_tolerance=0.0,
        )

    def _covariance(self, tolerance: Array) -> Array:
        """Covariance (D, D) of those displacements if the fiducials had tolerances (N,) mm."""
        vectors, variance, _ = self.directions
        return (vectors.T * np.repeat(tolerance**2, 3)) @ vectors + np.diag(variance)

    @cached_property
    def _determined_directions(self) -> tuple[Floats, Floats, Floats]:
        """Directions (3 N, D), displacements along them (D,), and the inverse of their covariance (D, D)."""
        vectors, variance, displacement = self.directions
        if not self.tolerance.any():
            return vectors, displacement, np.diag(1 / variance)
        return vectors, displacement, np.linalg.inv(self._covariance(self.tolerance))

    def log_evidence(self, tolerance: Array) -> float:
        """Log likelihood of the displacements if the fiducials had tolerances (N,) mm."""
        covariance, displacement = self._covariance(tolerance), self.directions[2]
        _, log_det = np.linalg.slogdet(covariance)
        return -0.5 * float(displacement @ np.linalg.solve(covariance, displacement) + log_det)

    @cached_property
    def scale_error(self) -> tuple[float, float]:
        """Best-fitting relative scale of the object, minus one, and its standard deviation."""
        scale = self.points.ravel()
        weight, found = float(scale @ self.information @ scale), float(scale @ self.pull)
        # A single camera cannot determine the object's size.
        if weight <= UNSURE * float(np.abs(self.information).max()) * float(scale @ scale):
            return 0.0, np.inf
        if self.tolerance.any():
            vectors, displacement, precision = self._determined_directions
            pull = vectors.T @ scale @ precision
            weight, found = float(pull @ (vectors.T @ scale)), float(pull @ displacement)
        return found / weight, weight**-0.5

    def bent_sigma(self, scatter: float = 1.0) -> float:
        """Significance of a deformation of the object other than scale, in standard deviations of a normal variable.

        An F test: the chi2 that displacements beyond the tolerances would explain, against the remaining chi2.

        Args:
            scatter: excess disagreement of the snapshots over the noise; see `pull_scatter`.

        Returns:
            Zero for an object of more than `MOST_FIDUCIALS`: there, lens errors that the model cannot express look like
            a deformed grid, too.
        """
        ratio, mine, rest = self._ratio
        if mine <= 0 or rest <= 0:
            return 0.0
        return -float(ndtri(max(fdtrc(mine, rest, max(ratio / scatter, 0.0)), 1e-300)))

    @cached_property
    def _ratio(self) -> tuple[float, float, float]:
        """F statistic of `bent_sigma` for a scatter of one, and its degrees of freedom."""
        if len(self.places) > MOST_FIDUCIALS:
            return 0.0, 0.0, 0.0
        _, displacement, precision = self._determined_directions
        error, deviation = self.scale_error
        explained = float(displacement @ precision @ displacement) - (error / deviation) ** 2
        mine, rest = len(displacement) - int(np.isfinite(deviation)), self.freedom - len(displacement)
        if mine <= 0 or rest <= 0:
            return 0.0, mine, rest
        left = max((self.chi2 - explained) / rest, LEAST_NOISE**2)
        return explained / (mine * left), mine, rest


@dataclass(frozen=True)
class ScaleEvidence:
    """Information of a fit about the size of an object whose shape is not tested: it is a stick, or too large."""

    scale_error: tuple[float, float]  # as in `ShapeEvidence`

    def bent_sigma(self) -> float:
        """Zero: the shape is not tested; see `ShapeEvidence.bent_sigma`."""
        return 0.0


def object_evidence(problem: Problem, solution: Solution, loss: NamedLoss) -> ShapeEvidence | ScaleEvidence | None:
    """Extract a fit's evidence about its object, for one rig (B = 1); None where rig and poses are undetermined."""
    ranks = [pose_rank(points) for points in problem.points_of_parts()]
    if problem.object_prior_std is None and (len(problem.points) > MOST_FIDUCIALS or min(ranks) < 6):
        return scale_evidence(problem, solution, loss)
    shape = shape_evidence(problem, solution, loss)
    return shape if shape is None or max(ranks) == 6 else ScaleEvidence(shape.scale_error)


def scale_evidence(problem: Problem, solution: Solution, loss: NamedLoss) -> ScaleEvidence | None:
    """Compute the `scale_error` of an exact object without differentiating by its fiducials.

    If object, poses and the cameras' positions about their centre are all scaled alike, no image changes. So a larger
    object is as good as smaller distances, and only the prior of the positions tells them apart. Where v is the step of
    the whitened offsets that scales the positions, and S their covariance, the scale's information is v^T (v - S v).

    Args:
        problem: of one rig, with an exact object.
        solution: the minimum.
        loss: of the fit.

    Returns:
        The evidence; None where rig and poses are undetermined.
    """
    if not bool(problem.points.any()):  # one point has no scale
        return ScaleEvidence((0.0, np.inf))
    offset, prior_std = solution.state.offset, problem.prior_std[..., 3:6]
    if not bool((prior_std > 0).all()):
        return _scale_evidence_of_fixed(problem, solution, loss)
    factorization = solution.factorization
    if bool(factorization.reduced.failed.any()):
        return None
    position = problem.factory.positions + offset[..., 3:6] * prior_std
    step = torch.zeros_like(offset)
    step[..., 3:6] = (position - position.mean(1, keepdim=True)) / prior_std
    pose = torch.zeros_like(solution.equations.pose_gradient)
    left = float((step * (step - factorization.solve(Step(step, pose, None)).camera)).sum())
    if left <= UNSURE * float(step.square().sum()):
        return ScaleEvidence((0.0, np.inf))
    return ScaleEvidence((-float((step * offset).sum()) / left, left**-0.5))


def _scale_evidence_of_fixed(problem: Problem, solution: Solution, loss: NamedLoss) -> ScaleEvidence | None:
    """Do the work of `scale_evidence` where positions of cameras are fixed, in time linear in the fiducials."""
    found = direction_evidence(problem, solution, loss, problem.points[None])
    if found is None:
        return None
    left = float(found.information[0, 0])
    # As in `ShapeEvidence`, but relative to a fiducial's information before rig and poses are marginalized.
    if left <= UNSURE * found.alone * float(problem.points.square().sum()):
        return ScaleEvidence((0.0, np.inf))
    return ScaleEvidence((float(found.pull[0]) / left, left**-0.5))


def shape_evidence(problem: Problem, solution: Solution, loss: NamedLoss) -> ShapeEvidence | None:
    """Extract a fit's evidence about the whole shape, one rig (B = 1); None where rig and poses are undetermined."""
    state = solution.state
    points = points_at(problem, state)[0]
    size = 3 * len(points) + 1
    unit = torch.ones(1, size, dtype=points.dtype, device=points.device)
    free = replace(problem, points=points, object_prior_std=unit)
    equations = equations_at(free, replace(state, object_offset=torch.zeros_like(unit)), loss)
    reduced, own = factorize(equations).reduced, equations.object
    if own is None or bool(reduced.failed.any()):
        return None
    # The object comes after cameras or poses: the last part of the factor belongs to its marginal information.
    lower = reduced.kept[0, -size:, -size:][:-1, :-1].cpu().double().numpy()
    information = lower @ lower.T - np.eye(size - 1)  # the prior of `unit`
    gradient = own.gradient[0, :-1].cpu().double().numpy()
    places = problem.points.cpu().double().numpy()
    displaced = (points.cpu().double().numpy() - places).ravel()
    tolerance, scale_tolerance, cost = np.zeros(len(places)), 0.0, float(equations.cost)
    if problem.object_prior_std is not None and state.object_offset is not None:
        given = problem.object_prior_std[0].cpu().double().numpy()
        tolerance, scale_tolerance = given[:-1:3], float(given[-1])
        cost += 0.5 * float(state.object_offset.square().sum())
    return ShapeEvidence(
        information=information,
        pull=information @ displaced - gradient,
        places=places,
        points=points.cpu().double().numpy(),
        tolerance=tolerance,
        scale_tolerance=scale_tolerance,
        chi2=2 * cost,
        freedom=2 * int((problem.root_weight > 0).sum()) - int(problem.pose_freedom),
    )


def pull_scatter(problem: Problem, state: State, loss: RobustKernel) -> float:
    """Variance of the snapshots' scores about their mean, relative to noise; at least 1, and 1 for few snapshots.

    Errors of lenses and centroids depend on places, not on fiducials, so their scores differ between snapshots.

    Args:
        problem: of one rig, with an object that is not exact.
        state: the minimum.
        loss: of the fit.
    """
    snapshots = problem.uv.shape[1]
    if snapshots < SNAPSHOTS_TO_BEND:
        return 1.0
    at = jacobian_at(problem, state)
    assert at.by_fiducial is not None
    weight = robust_weight(problem, at, loss)[0, :, :, None, None, :]
    by_pose, by_fiducial = at.by_rig[0, ..., -POSE_PARAMETERS - 1 : -1, :, :], at.by_fiducial[0]  # (S, C, 6 or 3, 2, N)
    pull = (by_fiducial * weight * at.residual[0].unsqueeze(-3)).sum((1, 3)).mT.flatten(1)  # (S, 3 N)
    # Each snapshot's fit has adapted its pose: subtract the part of the variance that the pose absorbed.
    own = (by_fiducial.square() * weight).sum((1, 3)).mT.flatten(1)
    across = torch.einsum("scirn,scjrn->sinj", by_pose, by_fiducial * weight).flatten(2)  # (S, 6, 3 N)
    among = torch.einsum("scirn,scjrn->sij", by_pose, by_pose * weight)
    taken = (across * torch.linalg.solve(among, across)).sum(1)
    variance = (own - taken).clamp_min(0).sum(0)
    found = (pull - pull.mean(0)).square().sum(0) * (snapshots / (snapshots - 1))
    seen = variance > 1e-6 * variance.max()
    return max(1.0, float((found[seen] / variance[seen]).mean()))


def learnt_tolerances(shape: ShapeEvidence) -> Array:
    """Estimate each fiducial's tolerance from the data by automatic relevance determination.

    Where one or two are off, the others stay in place and fix the object's frame and scale. Where many are off, the
    data cannot tell which, and all get the same tolerance. The evidence decides between the two.

    Returns:
        (N,) mm, standard deviations; the given tolerances where they are large enough.

    Source: MacKay, "Bayesian interpolation" (Neural Computation 1992), one precision per fiducial.
    """
    shape = shape.marginalize_scale()
    size = float(np.sqrt(np.square(shape.places).sum(1).mean()))
    floor = np.maximum(shape.tolerance, NARROW * size)
    one, freedom = _learn_one(shape, size)
    common = np.maximum(one, shape.tolerance)
    alone = _learn_each(shape, size, floor)
    alone = np.where(alone > 1.5 * floor, alone, shape.tolerance)
    off = int((alone > shape.tolerance).sum())
    if shape.log_evidence(alone) - COMPLEXITY * off >= shape.log_evidence(common) - COMPLEXITY + LEAD:
        return alone
    # No image shows the scale, so it is as uncertain as a tolerance that few displacements determine. Its distribution
    # is Student's t; use its variance.
    return np.maximum(one * (freedom / max(freedom - 2, freedom / WIDEST)) ** 0.5, shape.tolerance)


def _learn_each(shape: ShapeEvidence, size: float, floor: Array) -> Array:
    """Iterate tolerances (N,) mm to match the displacements that they allow, not below `floor`."""
    prior_std = np.maximum(WIDE * size, floor)
    for _ in range(ROUNDS):
        precision = np.repeat(prior_std**-2.0, 3)
        covariance = np.linalg.inv(shape.information + np.diag(precision))
        square = np.square(covariance @ shape.pull).reshape(-1, 3).sum(1)
        determined = 3 - (covariance.diagonal() * precision).reshape(-1, 3).sum(1)
        previous = prior_std
        prior_std = np.clip(np.sqrt(square / np.maximum(determined, 1e-3)), floor, 10 * WIDE * size)
        if np.abs(prior_std / previous - 1).max() < 0.01:
            break
    return prior_std


def _learn_one(shape: ShapeEvidence, size: float) -> tuple[float, float]:
    """Iterate one tolerance (mm) for all fiducials. Returns it and the effective number of displacements behind it."""
    _, variance, displacement = shape.directions
    prior_std, freedom = WIDE * size, 0.0
    for _ in range(ROUNDS):
        kept = prior_std**2 / (variance + prior_std**2)  # shrinkage factor of each displacement
        previous, freedom = prior_std, max(float(kept.sum()), 1e-3)
        prior_std = float(np.sqrt(np.square(kept * displacement).sum() / freedom))
        prior_std = min(max(prior_std, NARROW * size), 10 * WIDE * size)
        if abs(prior_std / previous - 1) < 0.01:
            break
    return prior_std, freedom


@dataclass(frozen=True)
class FiducialOffset:
    """Offset of a fiducial from its place in the object's file."""

    fiducial: int  # row of the object file
    offset: Array  # (3,) mm in the object's frame
    sigma: float  # mm, one standard deviation of the offset along itself

    @property
    def distance(self) -> float:
        """Length of the offset, mm."""
        return float(np.linalg.norm(self.offset))


def offsets(estimate: Estimate, points: Array) -> tuple[FiducialOffset, ...]:
    """Compare the estimated fiducials with their places `points` (N, 3) mm, one by one.

    A rigid motion of the object is no displacement, and neither is its common scale, where that has a tolerance. The
    object is first aligned so that as many fiducials as possible are in their places; each of several objects
    separately.

    Source: S-transformation (Baarda 1973) with weights that depend on the displacements, as in deformation analysis.
    """
    problem, prior_std = estimate.problem, estimate.problem.object_prior_std
    if prior_std is not None:  # the scale stays estimated, and adds nothing to the fiducials and their covariance
        unscaled = torch.cat((prior_std[:, :-1], torch.zeros_like(prior_std[:, -1:])), dim=1)
        problem = replace(problem, object_prior_std=unscaled)
    found = (points_at(problem, estimate.solution.state)[0] + problem.centroid).double().numpy()
    covariance = object_covariance(replace(estimate, problem=problem), curved=False).double().numpy()
    moved, part_of = (found - points).ravel(), problem.part_of
    number = np.zeros(len(points), dtype=int) if part_of is None else part_of.numpy()
    centred = points - np.stack([points[number == part].mean(0) for part in range(number.max() + 1)])[number]
    # Displacement of each object by a rotation about its centroid and a translation.
    motions = np.zeros((len(points), 3, number.max() + 1, 6))
    rows = np.arange(len(points))
    motions[rows, :, number, 3:] = np.eye(3)
    for axis in range(3):
        motions[rows, :, number, axis] = np.cross(np.eye(3)[axis], centred)
    rigid = motions.reshape(len(moved), -1)
    own = np.sqrt(covariance.diagonal().reshape(-1, 3).sum(1))
    least = NARROW * np.sqrt(np.square(centred).sum(1).mean()) + own
    left = moved.reshape(-1, 3)
    for _ in range(ROUNDS):
        weight = np.repeat(1 / (np.square(left).sum(1) + least**2), 3)
        fit = np.linalg.pinv(rigid.T * weight @ rigid) @ (rigid.T * weight)
        left = (moved - rigid @ (fit @ moved)).reshape(-1, 3)
    project = np.eye(len(moved)) - rigid @ fit
    remaining = project @ covariance @ project.T
    result = []
    for n, offset in enumerate(left):
        block = remaining[3 * n : 3 * n + 3, 3 * n : 3 * n + 3]
        length = float(np.linalg.norm(offset))
        along = offset / length if length > 0 else np.full(3, 3**-0.5)
        result.append(FiducialOffset(n, offset, float(np.sqrt(max(along @ block @ along, 0.0)))))
    return tuple(result)
