"""The fit of labelled snapshots, together with its noise, its outliers, and the width of the prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.errors import RefusedError
from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import Problem, State, points_at
from imgcal.estimation.map_estimate import EstimationOptions, descend, make_loss, minimize
from imgcal.estimation.object_shape import (
    ScaleEvidence,
    ShapeEvidence,
    learnt_tolerances,
    object_evidence,
    pull_scatter,
)
from imgcal.estimation.pose_support import require_poses
from imgcal.estimation.remaining_variance import remaining_variance
from imgcal.estimation.shape_modes import ModeEvidence, bend_object, mode_evidence
from imgcal.types import PARAMETER_KINDS

ROUNDS = 40
"""Most fits: noise, outliers, object and prior depend on each other, and most captures need three to six."""
PATIENCE = 10
"""Iterations after which a fit without a minimum is given up, as a multiple of those of one attempt."""
BENT = 5.0
"""Standard deviations from which the object does not match its file."""
WRONG_SCALE = 4.0
"""Standard deviations of a common change of the cameras' positions from which the object's scale is wrong."""

GROSS_SCALE = 0.05
"""Relative error of the scale that is reported at once: it spoils noise and labels of any fit."""
MOST_SCALE = 0.5
"""Relative error of the scale above which something else is wrong, for example exchanged cameras."""


class FitOptions(Protocol):
    """The pipeline options that decide when a fit has converged."""

    @property
    def estimation(self) -> EstimationOptions:
        """The solver's options."""

    @property
    def outlier(self) -> float:
        """Standard deviations beyond which a label is an outlier."""

    @property
    def widest_prior(self) -> float:
        """Largest factor by which the prior of a kind of factory values may be widened."""


@dataclass(frozen=True)
class VarianceComponents:
    """A fit whose noise, outliers, object and prior are consistent with its residuals."""

    problem: Problem
    solution: Solution
    sigma: NDArray[np.floating]  # (S, C, N) px, with the additive noise
    seen: NDArray[np.bool_]  # (S, C, N) inliers
    additive_noise: float  # px
    prior_scale: Mapping[str, float]
    shape: ShapeEvidence | ScaleEvidence | None = None  # evidence on the object's shape; None = not tested
    modes: ModeEvidence | None = None  # evidence on its modes


class ObjectQuestion(Enum):
    """What to test about the object."""

    NONE = "nothing"
    SHAPE = "its shape; misplaced fiducials are freed"
    SHAPE_OF_TURNS = "its shape, but labels may differ by a symmetry: misplaced fiducials cannot be identified"


@dataclass(frozen=True)
class Start:
    """A start for the fit."""

    state: State
    additive_noise: float  # px
    solution: Solution | None = None  # minimum from this start with all labels, if known
    nearer: State | None = None  # state of an earlier fit with the noise of these residuals


@dataclass(frozen=True)
class _Fit:
    """A solution for given noise and labels."""

    problem: Problem
    solution: Solution
    noise: NDArray[np.floating]  # (S, C, N) px^2
    seen: NDArray[np.bool_]  # (S, C, N)
    variance: NDArray[np.floating]  # (S, C, N) px^2, the blobs' own

    @cached_property
    def squared(self) -> NDArray[np.floating]:
        """Squared residuals: (S, C, N) px^2."""
        return np.square(self.solution.equations.residual[0].numpy()).sum(-2)

    @cached_property
    def remaining(self) -> NDArray[np.float64]:
        """Share of each factory value's prior variance that remains after the observations: (C, K)."""
        return np.asarray(remaining_variance(self.solution)[0])

    @cached_property
    def additive_noise(self) -> float:
        """Noise in the residuals beyond the blobs' own sigma, px; see `_additive_noise`."""
        taken = float(self.problem.pose_freedom) + float((1 - self.remaining).sum())
        return _additive_noise(self.squared[self.seen], self.variance[self.seen], taken)

    @property
    def noise_of_residuals(self) -> NDArray[np.floating]:
        """What outliers are judged by: (S, C, N) px^2.

        At least the noise of the fit, because a coarse fit cannot detect fine outliers; more where its residuals show
        more, because blobs may be far noisier than they say.
        """
        return np.maximum(self.noise, self.variance + self.additive_noise**2)

    @property
    def converged(self) -> bool:
        """Whether a minimum was found."""
        return bool(self.solution.converged)

    def is_clean(self, outlier: float) -> bool:
        """Check that all labels fit within `outlier` of their own sigma, without additive noise."""
        within = self.squared[self.seen] <= outlier**2 * self.variance[self.seen]
        return self.converged and bool(within.all()) and self.additive_noise == 0


def estimate_variance_components(
    problem: Problem,
    starts: Sequence[Start],
    variance: NDArray[np.floating],
    labels: NDArray[np.bool_],
    options: FitOptions,
    question: ObjectQuestion = ObjectQuestion.SHAPE,
) -> VarianceComponents:
    """Fit; re-estimate noise, outliers, object and prior width from the residuals; repeat until nothing changes.

    Args:
        problem: with the initial prior.
        starts: starts in order. One that leaves any label out gives way to the next; the last one is final.
        variance: (S, C, N) px^2, the blobs' own.
        labels: (S, C, N) bool, the labelled fiducials, which determine the pose in every snapshot.
        options: thresholds and the solver's options.
        question: what to test about the object.

    Raises:
        RefusedError: no minimum was found, or noise, outliers, object and prior do not converge.
        UndeterminedPosesError: without outliers, some snapshots do not determine the object's pose.
    """
    start, *later = starts
    state, additive_noise, known = start.state, start.additive_noise, start.solution
    prior_scale: dict[str, float] = {}
    kept, unexamined, shape = labels, question is not ObjectQuestion.NONE, None
    nearer, needed = start.nearer, 0.0
    for _ in range(ROUNDS):
        fit, known = _fit(problem, state, additive_noise, variance, kept, options, known), None
        if not (fit.converged or later):
            fit = _continue(fit, options)
        problem, solution, seen = fit.problem, fit.solution, fit.seen
        if unexamined and not later and fit.converged and not fit.is_clean(options.outlier):
            # Test before removing outliers, because they may include all labels of a misplaced fiducial.
            unexamined = False
            if (softer := _bend(fit, options)) is not None:
                problem, state, kept, unexamined = softer, solution.state, labels, True
                continue
            shape, free = _examine(fit, options, GROSS_SCALE, question)
            if free is not None:
                (problem, state), kept = free, labels
                continue
        kept = seen & (fit.squared <= options.outlier**2 * fit.noise_of_residuals)
        if (kept != seen).any():
            require_poses(kept, problem.points, problem.part_of)
        if later and not (fit.converged and (kept == labels).all()):
            start, *later = later
            state, additive_noise, known, kept = start.state, start.additive_noise, start.solution, labels
            nearer = start.nearer
            continue
        later = []
        if not fit.converged:
            rms = float(np.sqrt(fit.squared[seen].mean()))
            raise RefusedError(f"estimation: no minimum after {solution.iterations} iterations (RMS {rms:.3g} px)")
        state, nearer = nearer or solution.state, None
        previous, additive_noise = additive_noise, fit.additive_noise
        # Barely significant noise appears when none is assumed, and vanishes when it is: keep it.
        if previous == 0:
            needed = additive_noise
        if additive_noise == 0 and (kept == seen).all():
            additive_noise = min(needed, previous)
        if abs(additive_noise - previous) > 0.02 * previous or (kept != seen).any():
            continue
        if question is not ObjectQuestion.NONE:
            unexamined = False
            if (softer := _bend(fit, options)) is not None:
                problem, state = softer, solution.state
                continue
            shape, free = _examine(fit, options, 0.0, question)
            if free is not None:
                (problem, state), kept = free, labels
                continue
        state = solution.state
        too_narrow = _find_narrow_priors(state.offset[0].numpy(), fit.remaining)
        if not too_narrow or max(prior_scale.values(), default=1.0) > options.widest_prior:
            modes = mode_evidence(problem, solution, make_loss(options.estimation))
            sigma = np.sqrt(fit.noise)
            return VarianceComponents(problem, solution, sigma, seen, additive_noise, prior_scale, shape, modes)
        prior_scale |= {kind: prior_scale.get(kind, 1.0) * factor for kind, factor in too_narrow.items()}
        problem, state = _widen(problem, state, too_narrow)
    raise RefusedError(
        f"estimation: noise, outliers and prior do not converge in {ROUNDS} fits: the rig has changed far "
        "more than its prior allows, or many labels are wrong",
        python="if the rig may have changed that much, give it a wider prior: replace(rig, prior=RigPrior(...))",
        command="if the rig may have changed that much, write larger values under `prior` in the rig file",
    )


def _bend(fit: _Fit, options: FitOptions) -> Problem | None:
    """Apply the step of the object's modes; None = they have converged."""
    asked = mode_evidence(fit.problem, fit.solution, make_loss(options.estimation))
    return None if asked is None or asked.at_rest else bend_object(fit.problem, asked)


def _examine(
    fit: _Fit, options: FitOptions, least_scale: float, question: ObjectQuestion
) -> tuple[ShapeEvidence | ScaleEvidence | None, tuple[Problem, State] | None]:
    """Test a fit's object; errors of its scale count from `least_scale`, relative.

    Returns:
        The evidence, and a problem in which misplaced fiducials have tolerances, with a state to continue from; None =
        no fiducial is significantly misplaced.

    Raises:
        RefusedError: the object has another scale, or it is bent and symmetric.
    """
    shape = object_evidence(fit.problem, fit.solution, make_loss(options.estimation))
    if shape is None:
        return None, None
    bent = shape.bent_sigma() >= BENT
    if bent and question is ObjectQuestion.SHAPE_OF_TURNS:
        raise RefusedError(
            "object: some fiducials are not where its file says, but the object is symmetric: snapshots may be "
            "labelled in different orientations, so the displaced fiducials cannot be identified",
            python="measure it again, give labels (Detections.fiducial), or use an object without symmetry",
            command="measure it again, give labels (a column `fiducial`), or use an object without symmetry",
        )
    free = None
    if bent and isinstance(shape, ShapeEvidence):
        free = _free_object(shape, fit.problem, fit.solution, options)
    if free is None:
        _require_scale(shape, fit, least_scale)
    return shape, free


def _free_object(
    shape: ShapeEvidence, problem: Problem, solution: Solution, options: FitOptions
) -> tuple[Problem, State] | None:
    prior_std = learnt_tolerances(shape)
    if not (prior_std > 1.01 * shape.tolerance).any():
        return None
    before = problem.object_prior_std
    scale = problem.points.new_zeros(1) if before is None else before[0, -1:]
    free = torch.cat((torch.from_numpy(prior_std).to(problem.uv).repeat_interleave(3), scale))
    # Keep the displacements in the new units; a fiducial whose tolerance is still zero has none.
    displaced = (points_at(problem, solution.state)[0] - problem.points).flatten()
    whitened = torch.where(free > 0, torch.cat((displaced, torch.zeros_like(scale))) / free.clamp_min(1e-30), 0.0)
    problem = replace(problem, object_prior_std=free[None])
    state = replace(solution.state, object_offset=whitened[None])
    found = minimize(problem, state, options.estimation)
    # If snapshots disagree about the fiducials, the cause is not the object.
    loss = make_loss(options.estimation)
    if not bool(found.converged) or shape.bent_sigma(pull_scatter(problem, found.state, loss)) < BENT:
        return None
    return problem, found.state


def _require_scale(shape: ShapeEvidence | ScaleEvidence, fit: _Fit, least: float) -> None:
    """Refuse if the cameras have moved together as a wrong scale of the object would make them.

    Their other motion shows how far the prior of their positions can be trusted.
    """
    position, problem = PARAMETER_KINDS["position"], fit.problem
    offset, prior_std = (tensor[0, :, position].numpy() for tensor in (fit.solution.state.offset, problem.prior_std))
    places = problem.factory.positions[0].numpy() + offset * prior_std
    direction = np.where(prior_std > 0, (places - places.mean(0)) / np.maximum(prior_std, 1e-30), 0.0).ravel()
    along = float(direction @ offset.ravel()) ** 2 / max(float(direction @ direction), 1e-30)
    freedom = float((1 - fit.remaining[:, position]).sum())
    usual = (float(np.square(offset).sum()) - along) / max(freedom, 1.0)
    usual = usual if usual > 1 + 2 * (2 / max(freedom, 1.0)) ** 0.5 else 1.0
    error, deviation = shape.scale_error
    granted = 0.0 if problem.object_prior_std is None else float(problem.object_prior_std[0, -1])
    if MOST_SCALE > abs(error) > max(least, WRONG_SCALE * np.hypot(deviation * usual**0.5, granted)):
        size = "larger" if error > 0 else "smaller"
        raise RefusedError(
            f"object: all cameras have moved together, as if it were {100 * abs(error):.2g} +- {100 * deviation:.1g} % "
            f"{size} than its file says",
            python=f"measure it again, check its unit, or give its scale a tolerance (now {granted:g}): "
            "replace(obj, scale_tolerance=...)",
            command=f"measure it again, check its unit, or give its scale a tolerance (now {granted:g}): "
            "--object-scale-tolerance",
        )


def _fit(
    problem: Problem,
    state: State,
    additive_noise: float,
    variance: NDArray[np.floating],
    seen: NDArray[np.bool_],
    options: FitOptions,
    known: Solution | None,
) -> _Fit:
    """Fit labels `seen` (S, C, N) with the blobs' variance (px^2) plus noise (px), unless the solution is known."""
    noise = variance + additive_noise**2
    root_weight = torch.from_numpy(np.where(seen, noise**-0.5, 0.0)).to(problem.uv)
    problem = replace(problem, root_weight=root_weight[None])
    return _Fit(problem, known or minimize(problem, state, options.estimation), noise, seen, variance)


def _continue(fit: _Fit, options: FitOptions) -> _Fit:
    """Continue a fit that has not converged: the way to values that the data hardly determine is long."""
    patient = replace(options.estimation, max_iterations=PATIENCE * options.estimation.max_iterations)
    return replace(fit, solution=descend(fit.problem, fit.solution.state, patient))


def _additive_noise(squared: NDArray[np.floating], variance: NDArray[np.floating], taken: float) -> float:
    """Standard deviation (px, each axis) of the residuals beyond the blobs' own sigma; 0 = insignificant.

    The median of squared distances over two axes is 1.386 for unit noise, whatever a minority of outliers does, so half
    of the residuals must have `squared / 1.386 - variance` below the square of the result. The residuals are smaller
    than the noise by the degrees of freedom of the parameters: each counts as one observation times the share of its
    information that comes from the data.

    Args:
        squared: (M,) px^2, squared lengths of the residuals.
        variance: (M,) px^2 of each axis, the blobs' own.
        taken: effective degrees of freedom of the parameters.
    """
    count = 2 * len(squared)
    free = max(count - taken, 1.0)
    unit = squared * (count / free / 1.386)
    middle = (len(squared) - 1) // 2
    # Six standard deviations of a chi-squared mean: below, the residuals agree with the blobs' sigmas.
    if np.partition(unit / variance, middle)[middle] <= 1 + 6 * (2 / free) ** 0.5:
        return 0.0
    return float(np.partition(unit - variance, middle)[middle]) ** 0.5


def _find_narrow_priors(offset: NDArray[np.floating], remaining: NDArray[np.float64]) -> dict[str, float]:
    """Find kinds of values that have drifted more than their prior allows, and the factor that the prior needs.

    The whitened offsets (C, K) of a kind should have a mean square of one over the values that the data determine:
    those with a small remaining share (C, K) of the prior's variance.
    """
    factors = {}
    for kind, part in PARAMETER_KINDS.items():
        freedom = float((1 - remaining[:, part]).sum())
        if freedom > 1:
            excess = float(np.square(offset[:, part]).sum()) / freedom
            if excess > 1 + 4 * (2 / freedom) ** 0.5:
                factors[kind] = excess**0.5
    return factors


def _widen(problem: Problem, state: State, factors: Mapping[str, float]) -> tuple[Problem, State]:
    """Widen the prior; the state, in prior standard deviations, keeps its physical values."""
    scale = torch.ones_like(problem.prior_std[0, 0])
    for kind, factor in factors.items():
        scale[PARAMETER_KINDS[kind]] = factor
    return replace(problem, prior_std=problem.prior_std * scale), replace(state, offset=state.offset / scale)
