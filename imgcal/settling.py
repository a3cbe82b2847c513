"""The fit of labelled snapshots together with what it depends on: noise, outliers, and how wide the prior must be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.errors import RefusedError
from imgcal.estimation.covariance import remaining_variance
from imgcal.estimation.estimate import minimize
from imgcal.estimation.linearize import Problem, State
from imgcal.estimation.solver import Solution
from imgcal.labelling import PipelineOptions
from imgcal.pose_support import require_poses

KINDS = {
    "rotation": slice(0, 3),
    "position": slice(3, 6),
    "focal_length": slice(6, 8),
    "principal_point": slice(8, 10),
    "distortion": slice(10, 15),
}


@dataclass(frozen=True)
class SettledFit:
    """A fit whose noise, outliers and prior agree with its residuals."""

    problem: Problem
    solution: Solution
    sigma: NDArray[np.floating]  # (S, C, N) px, with the model error
    seen: NDArray[np.bool_]  # (S, C, N) labels that fit
    model_error: float  # px
    widened: Mapping[str, float]


def settle(
    problem: Problem,
    starts: Sequence[tuple[State, float]],
    variance: NDArray[np.floating],
    labels: NDArray[np.bool_],
    options: PipelineOptions,
) -> SettledFit:
    """Fit, ask the residuals for the model error, the outliers and the prior's width, and fit again until they stay.

    Args:
        problem: with the prior to begin with.
        starts: where to begin, and with which model error (px). One by which some label does not fit gives way to the
            next; the last one stays.
        variance: (S, C, N) px^2, the blobs' own.
        labels: (S, C, N) bool, what was labelled.
        options: how sure the result must be.

    Raises:
        RefusedError: no minimum was found.
        UndeterminedPosesError: without outliers some snapshots do not say where the object is.
    """
    (state, model_error), *later = starts
    widened: dict[str, float] = {}
    kept = labels
    for _ in range(8):
        seen, noise = kept, variance + model_error**2
        problem, solution, squared = _fit(problem, state, noise, seen, options)
        # Judged by the sigma of this fit: what a coarse fit leaves says little about fine outliers. Where a fiducial
        # was left out there is no residual: it stays out.
        kept = seen & (squared <= options.outlier**2 * noise)
        require_poses(kept, problem.points)
        if later and not (bool(solution.converged) and (kept == labels).all()):
            (state, model_error), *later = later
            kept = labels
            continue
        later = []
        if not bool(solution.converged):
            rms = float(np.sqrt(squared[seen].mean()))
            raise RefusedError(f"estimation: no minimum after {solution.iterations} iterations (RMS {rms:.3g} px)")
        state, remaining = solution.state, remaining_variance(solution)[0]
        taken = 6 * len(seen) + float((1 - remaining).sum())
        previous, model_error = model_error, _model_error(squared[seen], variance[seen], taken)
        if abs(model_error - previous) > 0.02 * previous or (kept != seen).any():
            continue
        too_narrow = _too_narrow(state.offset[0].numpy(), remaining)
        widened |= {kind: widened.get(kind, 1.0) * factor for kind, factor in too_narrow.items()}
        if not too_narrow or max(widened.values()) > options.widest_prior:
            break
        problem, state = _widen(problem, state, too_narrow)
    return SettledFit(problem, solution, np.sqrt(noise), seen, model_error, widened)


def _fit(
    problem: Problem, state: State, noise: NDArray[np.floating], seen: NDArray[np.bool_], options: PipelineOptions
) -> tuple[Problem, Solution, NDArray[np.floating]]:
    """Fit with a noise (px^2), and give the problem, its solution and the squared residuals, (S, C, N) px^2 both."""
    root_weight = torch.from_numpy(np.where(seen, noise**-0.5, 0.0)).to(problem.uv)
    problem = replace(problem, root_weight=root_weight[None])
    solution = minimize(problem, state, options.estimation)
    return problem, solution, np.square(solution.equations.residual[0].numpy()).sum(-2)


def _model_error(squared: NDArray[np.floating], variance: NDArray[np.floating], taken: float) -> float:
    """Standard deviation (px, each axis) that residuals hold beyond the blobs' own sigma; 0 = insignificant.

    The median of squared distances over two axes is 1.386 for unit noise, whatever a minority of outliers does.
    Residuals are smaller than the noise by what the parameters took: each takes the share of one observation that its
    prior left.

    Args:
        squared: (M,) px^2, squared lengths of the residuals.
        variance: (M,) px^2 of each axis, the blobs' own.
        taken: degrees of freedom that the parameters took.
    """
    count = 2 * len(squared)
    free = max(count - taken, 1.0)
    squared = squared * (count / free)
    middle = (len(squared) - 1) // 2

    def excess(error: float) -> float:
        return float(np.partition(squared / (variance + error**2), middle)[middle]) / 1.386

    # Six standard deviations of a chi-squared mean: below, the residuals fit the sigmas that the blobs have.
    if excess(0.0) <= 1 + 6 * (2 / free) ** 0.5:
        return 0.0
    low, high = 0.0, float(np.sqrt(squared.max()))
    for _ in range(30):
        error = 0.5 * (low + high)
        low, high = (error, high) if excess(error) > 1 else (low, error)
    return high


def _too_narrow(offset: NDArray[np.floating], remaining: NDArray[np.float64]) -> dict[str, float]:
    """Kinds of values that have drifted more than their prior allows: factor by which the prior is too narrow.

    The whitened offsets (C, 15) of a kind should have a mean square of one, over as many values as the data determine:
    those of which they leave little (C, 15) of the prior's variance.
    """
    factors = {}
    for kind, part in KINDS.items():
        freedom = float((1 - remaining[:, part]).sum())
        if freedom > 1:
            excess = float(np.square(offset[:, part]).sum()) / freedom
            if excess > 1 + 4 * (2 / freedom) ** 0.5:
                factors[kind] = excess**0.5
    return factors


def _widen(problem: Problem, state: State, factors: Mapping[str, float]) -> tuple[Problem, State]:
    """Widen the prior; the state, counted in prior standard deviations, stays where it is."""
    scale = torch.ones_like(problem.spread[0, 0])
    for kind, factor in factors.items():
        scale[KINDS[kind]] = factor
    return replace(problem, spread=problem.spread * scale), replace(state, offset=state.offset / scale)
