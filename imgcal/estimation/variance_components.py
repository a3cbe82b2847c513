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
from imgcal.medians import MEDIAN_SQUARED
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
    MODES = "its modes alone"
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

    def find_inliers(self, outlier: float) -> NDArray[np.bool_]:
        """Find labels (S, C, N) within `outlier` standard deviations. What was left out has no residual, and stays out.

        They are judged by the noise of the fit, because a coarse fit cannot detect fine outliers, or by that of its
        residuals if this is more, because blobs may be far noisier than they say.
        """
        noise = np.maximum(self.noise, self.variance + self.additive_noise**2)
        return np.asarray(self.seen & (self.squared <= outlier**2 * noise))

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
    for start in starts:
        rounds = _Rounds(problem, start, variance, labels, options, question)
        if start is starts[-1] or rounds.all_labels_fit():
            break
    for _ in range(ROUNDS):
        rounds.fit_again()
        if not (
            rounds.correct_gross_object() or rounds.correct_noise() or rounds.correct_object() or rounds.correct_prior()
        ):
            return rounds.result()
    raise RefusedError(
        f"estimation: noise, outliers and prior do not converge in {ROUNDS} fits: the rig has changed far "
        "more than its prior allows, or many labels are wrong",
        python="if the rig may have changed that much, give it a wider prior: replace(rig, prior=RigPrior(...))",
        command="if the rig may have changed that much, write larger values under `prior` in the rig file",
    )


class _Rounds:
    """Fits that follow one another. Each `correct_` method changes what the next fit assumes, or returns False."""

    def __init__(
        self,
        problem: Problem,
        start: Start,
        variance: NDArray[np.floating],
        labels: NDArray[np.bool_],
        options: FitOptions,
        question: ObjectQuestion,
    ) -> None:
        """Begin with all labels; arguments as for `estimate_variance_components`."""
        self.problem, self.state, self.additive_noise = problem, start.state, start.additive_noise
        self.known, self.nearer = start.solution, start.nearer
        self.variance, self.labels, self.options, self.question = variance, labels, options, question
        self.kept = labels
        self.needed = 0.0  # additive noise (px) of a fit that assumed none
        self.examined = question is ObjectQuestion.NONE
        self.shape: ShapeEvidence | ScaleEvidence | None = None
        self.prior_scale: dict[str, float] = {}

    def all_labels_fit(self) -> bool:
        """Check that the start leads to a minimum without outliers."""
        fit = self._fit()
        self.known = fit.solution
        return fit.converged and bool((fit.find_inliers(self.options.outlier) == self.labels).all())

    def fit_again(self) -> None:
        """Fit with what is assumed now."""
        fit, self.known = self._fit(), None
        self.fit = fit if fit.converged else _continue(fit, self.options)

    def correct_gross_object(self) -> bool:
        """Correct the object before outliers are removed, which may include all labels of a misplaced fiducial."""
        if self.examined or not self.fit.converged or self.fit.is_clean(self.options.outlier):
            return False
        if self._bend():
            return True
        self.examined = True
        return self._free_fiducials(GROSS_SCALE)

    def correct_noise(self) -> bool:
        """Take noise and outliers from the residuals.

        Raises:
            RefusedError: the fit has no minimum.
            UndeterminedPosesError: without outliers, some snapshots do not determine the object's pose.
        """
        fit, solution = self.fit, self.fit.solution
        self.kept = fit.find_inliers(self.options.outlier)
        fewer = bool((self.kept != fit.seen).any())
        if fewer:
            require_poses(self.kept, fit.problem.points, fit.problem.part_of)
        if not fit.converged:
            rms = float(np.sqrt(fit.squared[fit.seen].mean()))
            raise RefusedError(f"estimation: no minimum after {solution.iterations} iterations (RMS {rms:.3g} px)")
        self.state, self.nearer = self.nearer or solution.state, None
        previous, self.additive_noise = self.additive_noise, fit.additive_noise
        # Barely significant noise appears when none is assumed, and vanishes when it is: keep it.
        if previous == 0:
            self.needed = self.additive_noise
        if self.additive_noise == 0 and not fewer:
            self.additive_noise = min(self.needed, previous)
        return fewer or abs(self.additive_noise - previous) > 0.02 * previous

    def correct_object(self) -> bool:
        """Bend the object, or free misplaced fiducials."""
        if self.question is ObjectQuestion.NONE:
            return False
        self.examined = True
        return self._bend() or self._free_fiducials(0.0)

    def correct_prior(self) -> bool:
        """Widen the prior of values that have drifted more than it allows."""
        self.state = self.fit.solution.state
        too_narrow = _find_narrow_priors(self.state.offset[0].numpy(), self.fit.remaining)
        if not too_narrow or max(self.prior_scale.values(), default=1.0) > self.options.widest_prior:
            return False
        self.prior_scale |= {kind: self.prior_scale.get(kind, 1.0) * factor for kind, factor in too_narrow.items()}
        self.problem, self.state = _widen(self.fit.problem, self.state, too_narrow)
        return True

    def result(self) -> VarianceComponents:
        """The latest fit, which has changed nothing."""
        fit = self.fit
        modes = mode_evidence(fit.problem, fit.solution, make_loss(self.options.estimation))
        sigma = np.sqrt(fit.noise)
        return VarianceComponents(
            fit.problem, fit.solution, sigma, fit.seen, self.additive_noise, self.prior_scale, self.shape, modes
        )

    def _fit(self) -> _Fit:
        """Fit the kept labels with the blobs' variance plus the additive noise, unless the minimum is known."""
        noise = self.variance + self.additive_noise**2
        root_weight = torch.from_numpy(np.where(self.kept, noise**-0.5, 0.0)).to(self.problem.uv)
        problem = replace(self.problem, root_weight=root_weight[None])
        solution = self.known or minimize(problem, self.state, self.options.estimation)
        return _Fit(problem, solution, noise, self.kept, self.variance)

    def _bend(self) -> bool:
        """Take the step of the object's modes, unless they have converged."""
        fit = self.fit
        asked = mode_evidence(fit.problem, fit.solution, make_loss(self.options.estimation))
        if asked is None or asked.at_rest:
            return False
        self.problem, self.state = bend_object(fit.problem, asked), fit.solution.state
        return True

    def _free_fiducials(self, least_scale: float) -> bool:
        """Give misplaced fiducials tolerances; see `_examine`."""
        self.shape, free = _examine(self.fit, self.options, least_scale, self.question)
        if free is None:
            return False
        (self.problem, self.state), self.kept = free, self.labels
        return True


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
    if question is ObjectQuestion.MODES:
        return None, None
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
    scale = grown = problem.points.new_zeros(1)
    if problem.object_prior_std is not None and solution.state.object_offset is not None:
        scale = problem.object_prior_std[0, -1:]
        grown = scale * solution.state.object_offset[0, -1:]
    free = torch.cat((torch.from_numpy(prior_std).to(problem.uv).repeat_interleave(3), scale))
    # Keep the displacements in the new units; a fiducial whose tolerance is still zero has none.
    displaced = points_at(problem, solution.state)[0] - problem.points * (1 + grown)
    whitened = torch.where(free > 0, torch.cat((displaced.flatten(), grown)) / free.clamp_min(1e-30), 0.0)
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
        size = f"{100 * abs(error):.2g} +- {100 * deviation:.1g} % {'larger' if error > 0 else 'smaller'}"
        if problem.part_of is not None:  # of several objects, the scale has no tolerance
            advice = "measure them again, and check their units"
            raise RefusedError(
                f"object: all cameras have moved together, as if all objects were {size} than their files say",
                python=advice,
                command=advice,
            )
        advice = f"measure it again, check its unit, or give its scale a tolerance (now {granted:g})"
        raise RefusedError(
            f"object: all cameras have moved together, as if it were {size} than its file says",
            python=f"{advice}: replace(obj, scale_tolerance=...)",
            command=f"{advice}: --object-scale-tolerance",
        )


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
    unit = squared * (count / free / MEDIAN_SQUARED)
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
