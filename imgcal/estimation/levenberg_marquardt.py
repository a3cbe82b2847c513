"""Batched Levenberg-Marquardt on the arrow-shaped normal equations of `linearize`."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from imgcal.estimation import schur
from imgcal.estimation.linearization import (
    POSE_PARAMETERS,
    NormalEquations,
    ObjectEquations,
    Problem,
    State,
    Step,
    linearize,
    retract,
)
from imgcal.estimation.robust_losses import RobustKernel

LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e12
RELAX = 0.2
"""Factor on the damping after a step that lowered the cost as expected; grows to `GREATEST_RELAX` for worse steps."""
GREATEST_RELAX = 2.0
FIRST_GROWTH = 4.0
"""Factor on the damping after the first of a series of rejected steps; doubled with each further one."""

Record = TypeVar("Record", State, NormalEquations, ObjectEquations)


@dataclass(frozen=True)
class Solution:
    """Final state of the iteration, for each rig."""

    state: State
    equations: NormalEquations
    converged: Tensor  # (B,) bool: the last accepted step was below the tolerance
    iterations: int

    @cached_property
    def factorization(self) -> Factorization:
        """Factorization of the undamped equations, for covariances."""
        return factorize(self.equations)


def minimize(problem: Problem, start: State, loss: RobustKernel, max_iterations: int, tolerance: float) -> Solution:
    """Minimize the MAP cost of every rig of a batch.

    A step that does not lower the cost, or whose factorization fails, is rejected and retried with more damping; the
    factor doubles each time. After an accepted step, the damping follows from the ratio of the actual to the expected
    decrease (Nielsen 1999).

    Args:
        problem: the problem, with one batch axis B.
        start: first guess.
        loss: robust loss.
        max_iterations: linearizations at most, for each rig.
        tolerance: a rig has converged when the expected decrease of its cost is below this absolute value (the cost is
            in units of squared standard deviations) or below the rounding errors of cost and pixels.

    Returns:
        The best state found for each rig, with its normal equations.
    """
    state, equations = start, linearize(problem, start, loss)
    batch, device = equations.cost.shape, equations.cost.device
    damping, growth = equations.cost.new_full(batch, LEAST_DAMPING), equations.cost.new_full(batch, FIRST_GROWTH)
    converged = torch.zeros(batch, dtype=torch.bool, device=device)
    rounding, tolerances = 4 * torch.finfo(equations.cost.dtype).eps, tolerance + pixel_rounding(problem)
    iteration = 0
    while iteration < max_iterations and not bool(converged.all()):
        iteration += 1
        step, gain, failed = damped_step(equations, damping)
        small = (gain <= tolerances + rounding * equations.cost) & ~failed
        trial_state = retract(problem, state, *step)
        trial = linearize(problem, trial_state, loss)
        before = equations.cost
        better = (trial.cost < before) & ~failed & ~converged
        if bool(better.all()):
            state, equations = trial_state, trial
        else:
            state, equations = _where(better, trial_state, state), _where(better, trial, equations)
        # A tiny step that does not help has reached the rounding error: this is the minimum. Strong damping also makes
        # steps tiny, so only a lightly damped one counts.
        converged = converged | (small & (damping <= 1e-3) & ~torch.isinf(equations.cost))
        relax = 1 - (2 * (before - trial.cost) / gain - 1) ** 3
        damping = torch.where(better, damping * relax.clamp(RELAX, GREATEST_RELAX), damping * growth)
        damping = damping.clamp(LEAST_DAMPING, MOST_DAMPING)
        growth = torch.where(better, FIRST_GROWTH, 2 * growth)
    return Solution(state, equations, converged, iteration)


def pixel_rounding(problem: Problem) -> Tensor:
    """Decrease of the cost that pixel rounding can mimic: (B,); matters only in single precision."""
    whitened = problem.uv * problem.root_weight.unsqueeze(-2)
    return (4 * torch.finfo(whitened.dtype).eps) ** 2 * whitened.square().flatten(1).sum(1)


def damped_step(equations: NormalEquations, damping: Tensor) -> tuple[Step, Tensor, Tensor]:
    """Solve the damped normal equations.

    Args:
        equations: blocks and gradients.
        damping: (B,) added to the diagonals, relative to them.

    Returns:
        The step, the predicted decrease of the cost (B,), and whether the factorization failed (B,).
    """
    right = Step(-equations.camera_gradient, -equations.pose_gradient, None)
    if equations.object is not None:
        right = right._replace(object=-equations.object.gradient)
    factorization = factorize(equations, damping)
    step = factorization.solve(right)
    gain = 0.5 * ((right.camera * step.camera).sum((1, 2)) + (right.pose * step.pose).sum((1, 2)))
    if right.object is not None and step.object is not None:
        gain = gain + 0.5 * (right.object * step.object).sum(1)
    return step, gain, factorization.reduced.failed | ~torch.isfinite(gain)


@dataclass(frozen=True)
class Factorization:
    """Factorization of the arrow-shaped normal equations."""

    reduced: schur.Reduced
    cameras_first: bool  # the cameras were eliminated, otherwise the snapshots

    def solve(self, right: Step) -> Step:
        """Solve for a right-hand side."""
        if self.cameras_first:
            camera, pose, border = schur.solve(self.reduced, right.camera, right.pose, right.object)
        else:
            pose, camera, border = schur.solve(self.reduced, right.pose, right.camera, right.object)
        return Step(camera, pose, border)

    def solve_many(self, right: Step) -> Step:
        """Solve for K right-hand sides at once: (B, K, ...) to (B, K, ...)."""
        camera, pose = right.camera.movedim(1, -1), right.pose.movedim(1, -1)
        border = None if right.object is None else right.object.movedim(1, -1)
        if self.cameras_first:
            camera, pose, border = schur.solve_columns(self.reduced, camera, pose, border)
        else:
            pose, camera, border = schur.solve_columns(self.reduced, pose, camera, border)
        return Step(camera.movedim(-1, 1), pose.movedim(-1, 1), None if border is None else border.movedim(-1, 1))


def factorize(
    equations: NormalEquations, damping: Tensor | None = None, cameras_first: bool | None = None
) -> Factorization:
    """Factorize the arrow-shaped equations.

    Args:
        equations: the blocks.
        damping: (B,) added to the diagonals, relative to them.
        cameras_first: eliminate the cameras first; None = choose the smaller dense system.
    """
    camera, pose, own = equations.camera, equations.pose, equations.object
    if damping is not None:
        camera, pose = _damp(camera, damping), _damp(pose, damping)
    coupling = equations.coupling  # (B, S, C, K, 6)
    if cameras_first is None:
        cameras_first = POSE_PARAMETERS * pose.shape[1] <= camera.shape[-1] * camera.shape[1]
    border = None
    if own is not None:
        square = own.own if damping is None else _damp(own.own.unsqueeze(1), damping).squeeze(1)
        pair = (own.camera, own.pose) if cameras_first else (own.pose, own.camera)
        border = schur.Border(*pair, square)
    if cameras_first:
        return Factorization(schur.reduce(camera, coupling.transpose(1, 2), pose, border), True)
    return Factorization(schur.reduce(pose, coupling.mT, camera, border), False)


def _damp(blocks: Tensor, damping: Tensor) -> Tensor:
    """Scale the diagonals of blocks (B, P, p, p) by 1 + damping (B,)."""
    blocks = blocks.clone()
    blocks.diagonal(dim1=-2, dim2=-1).mul_(1 + damping[:, None, None])
    return blocks


def choose_better(first: Solution, second: Solution) -> Solution:
    """Choose for each rig the solution with the lower cost."""
    choose = first.equations.cost <= second.equations.cost
    return Solution(
        _where(choose, first.state, second.state),
        _where(choose, first.equations, second.equations),
        torch.where(choose, first.converged, second.converged),
        max(first.iterations, second.iterations),
    )


def replace_rows(solution: Solution, rows: Tensor, by: Solution, iterations: int) -> Solution:
    """Replace some rows (R,) of a batch by other solutions (R,)."""
    index = torch.zeros(len(solution.converged), dtype=torch.long, device=rows.device)
    chosen = torch.ones_like(index, dtype=torch.bool)
    index[rows], chosen[rows] = torch.arange(len(rows), device=rows.device), False
    return Solution(
        _where(chosen, solution.state, select_rows(by.state, index)),
        _where(chosen, solution.equations, select_rows(by.equations, index)),
        torch.where(chosen, solution.converged, by.converged[index]),
        iterations,
    )


def select_rows(record: Record, index: Tensor) -> Record:
    """Index axis B of a record of tensors; None, as for an exact object, stays None."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    chosen: dict[str, object] = {
        name: select_rows(value, index) if isinstance(value, ObjectEquations) else value[index]
        for name, value in values.items()
        if value is not None
    }
    return replace(record, **chosen)  # type: ignore[arg-type]


def _where(choose: Tensor, first: Record, second: Record) -> Record:
    """Choose for each rig between two records of tensors with leading axis B."""
    chosen: dict[str, object] = {}
    for field in fields(first):
        a, b = getattr(first, field.name), getattr(second, field.name)
        if isinstance(a, ObjectEquations):
            chosen[field.name] = _where(choose, a, b)
        elif a is not None:
            chosen[field.name] = torch.where(choose.view(-1, *[1] * (a.ndim - 1)), a, b)
    return replace(first, **chosen)  # type: ignore[arg-type]
