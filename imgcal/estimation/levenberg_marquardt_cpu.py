"""The solver's fast path on CPUs: `levenberg_marquardt.minimize` compiled to one loop per rig, without temporaries.

`linearization.py`, `schur.py` and `levenberg_marquardt.py` do the same in tensors, on any device; tests compare the
two. Names, units and layouts are the same. Rigs of a batch run in parallel. Everything is computed in double precision,
whatever the type of the tensors: one type is compiled.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, TypeVar

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor

from imgcal.estimation import levenberg_marquardt, linearization
from imgcal.estimation.levenberg_marquardt import (
    FIRST_GROWTH,
    GREATEST_RELAX,
    LEAST_DAMPING,
    MOST_DAMPING,
    RELAX,
    Solution,
    pixel_rounding,
)
from imgcal.estimation.linearization import NormalEquations, ObjectEquations, Problem, State
from imgcal.estimation.linearization_cpu import (
    given_values,
    linearize_rig,
    move,
    select_blocks,
    select_state,
    turn_all,
)
from imgcal.estimation.robust_losses import LossName, NamedLoss
from imgcal.geometry import RigidTransform, kernels, lens_codes, require_shapes
from imgcal.types import CameraRig
from renderers.compiling import njit
from renderers.interpreting import without_machine_code

Part = TypeVar("Part", bound=Problem | State | Solution | NormalEquations | ObjectEquations)

# OpenMP's threads do not survive a fork: with several, PyTorch would wait for them forever in the new process.
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))

LOSS_CODES = {"squared": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3}


def minimize(
    problem: Problem, start: State, loss: LossName, threshold: float, max_iterations: int, tolerance: float
) -> Solution:
    """Do the work of `levenberg_marquardt.minimize` for tensors on the CPU.

    Args:
        problem: the problem, batch axis B; one floating-point type throughout, which the solution has, too.
        start: first guess.
        loss: a key of `LOSS_CODES`.
        threshold: the loss's threshold in standard deviations.
        max_iterations: linearizations at most, for each rig.
        tolerance: see `levenberg_marquardt.minimize`.
    """
    if problem.uv.dtype != torch.float64:
        exact = change_precision(problem, torch.float64), change_precision(start, torch.float64)
        return change_precision(minimize(*exact, loss, threshold, max_iterations, tolerance), problem.uv.dtype)
    if missing := without_machine_code(_minimize_rig):
        arguments = (problem, start, NamedLoss(loss, threshold), max_iterations, tolerance)
        return missing.call_twin(torch.no_grad()(levenberg_marquardt.minimize), *arguments)
    count = len(problem.uv)
    if count == 1:
        return RigSolver(problem).minimize(problem, start, loss, threshold, max_iterations, tolerance)
    own_std, state = _object_spread(problem, start, rows=count)
    blocks = _Blocks.of(problem, rows=count)
    converged = np.zeros(count, dtype=np.bool_)
    iterations = np.zeros(count, dtype=np.int64)
    shared, given = shared_arrays(problem), _arrays((*_problem_arrays(problem), own_std))
    compiled = (_arrays(_parts(state)), _arrays(blocks.parts), *_arrays((blocks.cost,)), converged, iterations)
    limits = (blocks.cameras_first, LOSS_CODES[loss], threshold, max_iterations)
    tolerances = (tolerance + pixel_rounding(problem)).numpy()
    with _threads_of_torch():
        _minimize_all((*shared, *given), *compiled, limits, tolerances)  # type: ignore[call-arg]
    if not own_std.shape[1]:
        state = replace(state, object_offset=None)
    return Solution(state, blocks.equations(), torch.from_numpy(converged), int(iterations.max(initial=0)))


@dataclass(frozen=True)
class SnapshotFit:
    """A rig fitted to one snapshot: the best state, and the normal equations there as in `NormalEquations`."""

    offset: np.ndarray  # (C, K) whitened
    rotation: np.ndarray  # (3, 3) of the object
    centre: np.ndarray  # (3,) mm
    cost: float
    camera: np.ndarray  # (C, K, K)
    coupling: np.ndarray  # (C, K, 6)
    pose: np.ndarray  # (6, 6)

    @classmethod
    def of(cls, solution: Solution) -> SnapshotFit:
        """Take the values of a solution with one rig and one snapshot."""
        state, found = solution.state, solution.equations
        states = (state.offset[0], state.rotation[0, 0], state.centre[0, 0])
        offset, rotation, centre = (part.numpy() for part in states)
        parts = (found.camera[0], found.coupling[0, 0], found.pose[0, 0])
        camera, coupling, pose = (part.contiguous().numpy() for part in parts)
        return cls(offset, rotation, centre, float(found.cost[0]), camera, coupling, pose)


class RigSolver:
    """Fits of a single rig to many sets of observations: what these share is converted for compiled code once."""

    def __init__(self, problem: Problem) -> None:
        """Take everything but the observations from a problem of one rig."""
        given = _arrays(_problem_arrays(problem)[2:])
        own = problem.object_prior_std
        own_std = np.empty(0, given[0].dtype) if own is None else own.detach().contiguous().numpy()[0]
        self._problem, self._shared = problem, shared_arrays(problem)
        self._given = (*(array[0] for array in given), own_std)
        self._blocks = _sizes_of_blocks(problem)

    def minimize(
        self, problem: Problem, start: State, loss: LossName, threshold: float, max_iterations: int, tolerance: float
    ) -> Solution:
        """Do the work of `minimize` for a problem that differs from this one's in its observations."""
        if without_machine_code(_minimize_rig):
            return minimize(problem, start, loss, threshold, max_iterations, tolerance)
        uv, root_weight = (array[0] for array in _arrays((problem.uv, problem.root_weight.to(problem.uv))))
        offset = start.object_offset
        own = np.zeros_like(self._given[-1]) if offset is None else offset.detach().numpy()[0]
        first = (*(part.detach().numpy()[0] for part in (start.offset, start.rotation, start.centre)), own)
        layout, limits = _sizes_of_blocks(problem), (loss, threshold, max_iterations, tolerance)
        states, parts, converged, iterations = self._run(uv, root_weight, first, layout, limits)
        blocks = _Blocks(layout[0], *(torch.from_numpy(part) for part in parts))
        found = State(*(torch.from_numpy(state) for state in states))
        if not len(own):
            found = replace(found, object_offset=None)
        return Solution(found, blocks.equations(), torch.from_numpy(converged), int(iterations[0]))

    def fit_snapshot(
        self, uv: np.ndarray, root_weight: np.ndarray, start: tuple[np.ndarray, np.ndarray, np.ndarray],
        loss: LossName, threshold: float, max_iterations: int, tolerance: float,
    ) -> SnapshotFit:  # fmt: skip
        """Do the same for one snapshot of a rigid object in arrays, which saves the conversion to tensors and back.

        Args:
            uv: (C, 2, N) pixels.
            root_weight: (C, N) inverse standard deviations, 0 = not seen.
            start: offset (C, K), rotation (3, 3) and centre (3,).
            loss: as for `minimize`.
            threshold: as for `minimize`.
            max_iterations: as for `minimize`.
            tolerance: as for `minimize`.
        """
        if without_machine_code(_minimize_rig):
            pixels, weights, turn, place = (torch.from_numpy(a)[None, None] for a in (uv, root_weight, *start[1:]))
            problem = replace(self._problem, uv=pixels, root_weight=weights)
            state = State(torch.from_numpy(start[0])[None], turn, place)
            return SnapshotFit.of(minimize(problem, state, loss, threshold, max_iterations, tolerance))
        offset, rotation, centre = start
        first = (offset, rotation[None], centre[None], np.zeros_like(self._given[-1]))
        limits = (loss, threshold, max_iterations, tolerance)
        states, parts, _, _ = self._run(uv[None], root_weight[None], first, self._blocks, limits)
        (offset, rotation, centre, _), (camera, coupling, pose, *_, cost) = states, parts
        return SnapshotFit(offset[0], rotation[0, 0], centre[0, 0], float(cost[0]), camera[0], coupling[0], pose[0, 0])

    def _run(
        self,
        uv: np.ndarray,
        root_weight: np.ndarray,
        first: tuple[np.ndarray, ...],
        layout: tuple[bool, tuple[tuple[int, ...], ...]],
        limits: tuple[LossName, float, int, float],
    ) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
        """Run the compiled loop; return the best state, its blocks, the cost last, converged (1,), iterations (1,)."""
        states = tuple(np.empty((2, *part.shape), uv.dtype) for part in first)
        for state, part in zip(states, first, strict=True):
            state[0] = part
        cameras_first, sizes = layout
        *parts, cost = (np.empty((2, *size), uv.dtype) for size in sizes)
        converged, iterations = np.zeros(1, np.bool_), np.zeros(1, np.int64)
        loss, threshold, most, tolerance = limits
        rounding = (4 * np.finfo(uv.dtype).eps) ** 2 * np.square(uv * root_weight[..., None, :]).sum()
        best = _minimize_rig(
            (*self._shared, uv, root_weight, *self._given), states, tuple(parts), cost, converged, iterations,
            (cameras_first, LOSS_CODES[loss], threshold, most), uv.dtype.type(tolerance + rounding),
        )  # fmt: skip
        one = slice(best, best + 1)
        blocks = (*(part[one] for part in parts), cost[:1])
        return tuple(state[one] for state in states), blocks, converged, iterations


@contextmanager
def _threads_of_torch() -> Iterator[None]:
    """Let compiled loops use as many threads as torch, and restore both settings afterwards. Both use OpenMP."""
    threads, compiled = torch.get_num_threads(), numba.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        numba.set_num_threads(compiled)
        torch.set_num_threads(threads)  # must come last: numba's setting changes OpenMP's, too


def linearize(problem: Problem, state: State, loss: LossName, threshold: float) -> NormalEquations:
    """Do the work of `linearization.linearize` for tensors on the CPU, without gradients; the loss as in `minimize`."""
    if problem.uv.dtype != torch.float64:
        exact = change_precision(problem, torch.float64), change_precision(state, torch.float64)
        return change_precision(linearize(*exact, loss, threshold), problem.uv.dtype)
    if missing := without_machine_code(linearize_rig):
        arguments = (problem, state, NamedLoss(loss, threshold))
        return missing.call_twin(torch.no_grad()(linearization.linearize), *arguments)
    own_std, state = _object_spread(problem, state, len(problem.uv))
    blocks = _Blocks.of(problem, len(problem.uv))
    shared, given = shared_arrays(problem), _arrays((*_problem_arrays(problem), own_std))
    states, parts, cost = _arrays(_parts(state)), _arrays(blocks.parts), blocks.cost.numpy()
    limits, steady = (blocks.cameras_first, LOSS_CODES[loss], threshold), np.empty((0, 0))
    for b in range(len(cost)):  # no compiled loop, which would contain all of `linearize_rig` once more
        given_here, state_here, blocks_here = (tuple(array[b] for array in arrays) for arrays in (given, states, parts))
        cost[b] = linearize_rig((*shared, *given_here), state_here, blocks_here, *limits, steady)
    return blocks.equations()


def change_precision(given: Part, dtype: torch.dtype) -> Part:
    """Change the floating-point type of all tensors."""

    def changed(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value.to(dtype) if value.is_floating_point() else value
        if isinstance(value, CameraRig):
            return value.to(dtype)
        return change_precision(value, dtype) if isinstance(value, State | NormalEquations | ObjectEquations) else value

    return replace(given, **{one.name: changed(getattr(given, one.name)) for one in fields(given)})


@dataclass(frozen=True)
class _Blocks:
    """The normal equations in the layout of the compiled loops, B rigs; the object's M columns come last."""

    cameras_first: bool
    camera: Tensor  # (B, C, K, K)
    coupling: Tensor  # (B, C, K, 6 S + M) where cameras are eliminated first, else (B, S, 6, K C + M)
    pose: Tensor  # (B, S, 6, 6)
    border: Tensor  # (B, M, same width as coupling), lower triangle
    camera_gradient: Tensor  # (B, C, K)
    pose_gradient: Tensor  # (B, S, 6)
    own_gradient: Tensor  # (B, M)
    residual: Tensor  # (B, S, C, 2, N)
    cost: Tensor  # (B,)

    @classmethod
    def of(cls, problem: Problem, rows: int) -> _Blocks:
        """Allocate the blocks of a problem for `rows` rows."""
        cameras_first, sizes = _sizes_of_blocks(problem)
        return cls(cameras_first, *(problem.uv.new_empty(rows, *size) for size in sizes))

    @property
    def parts(self) -> tuple[Tensor, ...]:
        """All but the cost, in the order of the compiled loops."""
        gradients = (self.camera_gradient, self.pose_gradient, self.own_gradient)
        return (self.camera, self.coupling, self.pose, self.border, *gradients, self.residual)

    def equations(self) -> NormalEquations:
        """Convert to the layout of `linearization.linearize`."""
        wide = self.coupling.shape[-1] - self.border.shape[1]
        coupling, across = self.coupling[..., :wide], self.border[..., :wide]
        if self.cameras_first:
            blocks = coupling.unflatten(-1, (-1, 6)).permute(0, 3, 1, 2, 4)
        else:
            blocks = coupling.unflatten(-1, (self.camera.shape[1], -1)).permute(0, 1, 3, 4, 2)
        gradients = (self.camera_gradient, self.pose_gradient)
        equations = NormalEquations(self.cost, self.camera, blocks, self.pose, *gradients, self.residual)
        if not self.border.shape[1]:
            return equations
        if self.cameras_first:
            pair = (self.coupling[..., wide:], across.unflatten(-1, (-1, 6)).permute(0, 2, 3, 1))
        else:
            pair = (across.unflatten(-1, (self.camera.shape[1], -1)).permute(0, 2, 3, 1), self.coupling[..., wide:])
        lower = self.border[..., wide:]
        square = lower.tril() + lower.tril(-1).mT
        return replace(equations, object=ObjectEquations(*pair, square, self.own_gradient))


def _sizes_of_blocks(problem: Problem) -> tuple[bool, tuple[tuple[int, ...], ...]]:
    """Tell whether cameras are eliminated first, and the sizes of one rig's blocks, the cost last."""
    _, snapshots, cameras, _, fiducials = problem.uv.shape
    own = 0 if problem.object_prior_std is None else problem.object_prior_std.shape[1]
    free = problem.prior_std.shape[-1]
    cameras_first = 6 * snapshots <= free * cameras
    shape = (cameras, free, 6 * snapshots + own) if cameras_first else (snapshots, 6, free * cameras + own)
    return cameras_first, (
        (cameras, free, free), shape, (snapshots, 6, 6), (own, shape[-1]),
        (cameras, free), (snapshots, 6), (own,), (snapshots, cameras, 2, fiducials), (),
    )  # fmt: skip


def _object_spread(problem: Problem, state: State, rows: int) -> tuple[Tensor, State]:
    """Prior standard deviations of the object's parameters (B, M), M = 0 if exact, and a copy of the state with M.

    The state of a single rig is copied to all `rows`; otherwise there are as many rigs as rows.
    """
    prior_std = (
        problem.uv.new_empty(len(problem.uv), 0) if problem.object_prior_std is None else problem.object_prior_std
    )
    offset = torch.zeros_like(prior_std) if state.object_offset is None else state.object_offset
    parts = (state.offset, state.rotation, state.centre, offset)
    return prior_std, State(*(part.expand(rows, *part.shape[1:]).clone() for part in parts))


def _problem_arrays(problem: Problem) -> tuple[Tensor, ...]:
    factory = problem.factory
    pinhole = (factory.focal_length, factory.principal_point, factory.distortion)
    rig = (factory.cam_from_rig.rotation.detach(), camera_positions(factory), *pinhole)
    return (problem.uv, problem.root_weight.to(problem.uv), *rig, problem.prior_std)


def camera_positions(rig: CameraRig) -> Tensor:
    """The rig's `positions`, without gradients: faster than the dozen small tensor operations of the property."""
    rotation, translation = rig.cam_from_rig.rotation.detach().numpy(), rig.cam_from_rig.translation.detach().numpy()
    return torch.from_numpy(-(rotation.swapaxes(-1, -2) @ translation[..., None])[..., 0])


def _parts(state: State) -> tuple[Tensor, ...]:
    assert state.object_offset is not None  # see `_object_spread`
    return (state.offset, state.rotation, state.centre, state.object_offset)


def shared_arrays(problem: Problem) -> tuple[np.ndarray | None, ...]:
    """Inputs of `linearization_cpu` that all rigs of the batch share.

    Raises:
        InputError: radii of another number of fiducials.
    """
    points, squared = problem.points, problem.radius_squared
    if squared is not None:
        require_shapes("fiducials", [("radius", squared, (len(points),))])
    if problem.part_of is not None:
        points = torch.cat((points, problem.part_of[:, None].to(points)), 1)
    given = _arrays((points, points.new_zeros(len(points)) if squared is None else squared))
    return (*given, lens_codes(problem.factory.lens_model, *problem.factory.distortion.shape[-2:]))


def rig_at(problem: Problem, offset: Tensor) -> CameraRig:
    """Do the work of `linearization.rig_at` for tensors on the CPU, without gradients."""
    if missing := without_machine_code(turn_all):
        return missing.call_twin(torch.no_grad()(linearization.rig_at), problem, offset)
    factory = problem.factory
    given = (factory.cam_from_rig.rotation, factory.cam_from_rig.translation)
    rotation, translation = (torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in given)
    parameters = offset * problem.prior_std
    turn_all(*_arrays((parameters, *given, rotation, translation)))
    return replace(
        factory,
        focal_length=factory.focal_length + parameters[..., 6:8],
        principal_point=factory.principal_point + parameters[..., 8:10],
        distortion=factory.distortion + parameters[..., 10:],
        cam_from_rig=RigidTransform(rotation, translation),
    )


def _arrays(tensors: tuple[Tensor, ...]) -> tuple[np.ndarray, ...]:
    """Share the memory of contiguous tensors; copy the others."""
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


@njit(parallel=True, cache=True, fastmath=kernels.FAST, heavy=True)
def _minimize_all(given, state, blocks, cost, converged, iterations, limits, tolerances):
    """Run Levenberg-Marquardt on all rigs of a batch; the outputs receive the best states and their equations."""
    for row in prange(len(cost)):
        b = np.int64(row)  # for the unsigned number, all would be compiled once more
        own, found = select_state(state, b), select_blocks(blocks, b)
        offset, rotation, centre, own_offset = own
        camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual = found
        states = (_pair(offset), _pair(rotation), _pair(centre), _pair(own_offset))
        tried = (
            _pair(camera), _pair(coupling), _pair(pose), _pair(border),
            _pair(camera_gradient), _pair(pose_gradient), _pair(own_gradient), _pair(residual),
        )  # fmt: skip
        best = _minimize_rig(
            given_values(given, b), states, tried, cost[b : b + 1], converged[b : b + 1], iterations[b : b + 1],
            limits, tolerances[b],
        )  # fmt: skip
        _copy(offset, states[0][best])
        _copy(rotation, states[1][best])
        _copy(centre, states[2][best])
        _copy(own_offset, states[3][best])
        _copy(camera, tried[0][best])
        _copy(coupling, tried[1][best])
        _copy(pose, tried[2][best])
        _copy(border, tried[3][best])
        _copy(camera_gradient, tried[4][best])
        _copy(pose_gradient, tried[5][best])
        _copy(own_gradient, tried[6][best])
        _copy(residual, tried[7][best])


@njit(cache=True, fastmath=kernels.FAST, heavy=True)
def _minimize_rig(given, states, blocks, cost, converged, iterations, limits, tolerance):
    """Run Levenberg-Marquardt on one rig.

    Args:
        given: inputs of one rig; see `linearization_cpu`.
        states: two rows, the best so far and the current trial; the first row is the start.
        blocks: of the normal equations, two rows as well.
        cost: (1,) of the best state.
        converged: (1,) whether a minimum was found.
        iterations: (1,) number of iterations.
        limits: whether cameras are eliminated first, the loss, its threshold, and the most iterations.
        tolerance: expected decrease of the cost at which to stop.

    Returns:
        The row of the best state.
    """
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, _ = blocks
    cameras_first, loss, threshold, max_iterations = limits
    kind, (count, size, wide) = coupling.dtype, coupling.shape[1:]
    factor, whitened = np.empty((count, size, size), kind), np.empty((count, size, wide), kind)
    schur = np.empty((wide, wide), kind)
    camera_step, pose_step = np.empty(camera_gradient.shape[1:], kind), np.empty(pose_gradient.shape[1:], kind)
    own_step = np.empty(own_gradient.shape[1], kind)
    rounding, steady = 4 * np.finfo(kind).eps, np.empty((0, 0))
    # A literal 0 is a type of its own: all that is called with it would be compiled twice.
    damping, growth, relax, best = LEAST_DAMPING, FIRST_GROWTH, RELAX, np.int64(0)
    cost[0] = linearize_rig(
        given, select_state(states, best), select_blocks(blocks, best), cameras_first, loss, threshold, steady
    )
    for iteration in range(max_iterations):
        iterations[0] = iteration + 1
        b, t = best, 1 - best
        if cameras_first:
            gain = _solve(
                camera[b], coupling[b], pose[b], border[b], camera_gradient[b], pose_gradient[b], own_gradient[b],
                damping, factor, whitened, schur, camera_step, pose_step, own_step,
            )  # fmt: skip
        else:
            gain = _solve(
                pose[b], coupling[b], camera[b], border[b], pose_gradient[b], camera_gradient[b], own_gradient[b],
                damping, factor, whitened, schur, pose_step, camera_step, own_step,
            )  # fmt: skip
        better, small = False, False
        if np.isfinite(gain):
            trial = select_state(states, t)
            move(select_state(states, b), camera_step, pose_step, own_step, trial)
            trial_cost = linearize_rig(given, trial, select_blocks(blocks, t), cameras_first, loss, threshold, steady)
            small = gain <= tolerance + rounding * cost[0]
            if trial_cost < cost[0]:
                relax = min(max(1 - (2 * (cost[0] - trial_cost) / gain - 1) ** 3, RELAX), GREATEST_RELAX)
                better, best, cost[0] = True, t, trial_cost
        # See levenberg_marquardt.minimize: only a lightly damped small step shows that this is the minimum.
        if small and damping <= 1e-3 and np.isfinite(cost[0]):
            converged[0] = True
            break
        damping = min(max(damping * (relax if better else growth), LEAST_DAMPING), MOST_DAMPING)
        growth = FIRST_GROWTH if better else 2 * growth
    return best


@njit(cache=True, fastmath=kernels.FAST)
def _solve(
    blocks, coupling, kept, border, right_blocks, right_kept, right_border, damping, factor, whitened, schur,
    step_blocks, step_kept, step_border,
):  # fmt: skip
    """Solve the damped equations for minus the gradients; return the predicted decrease, nan if a factor fails."""
    count, size, wide = coupling.shape
    size_kept = kept.shape[1]
    first_border = wide - len(border)
    _copy(factor, blocks)
    _copy(whitened, coupling)
    for i in range(wide):
        for j in range(wide):
            schur[i, j] = 0
    for q in range(kept.shape[0]):
        first = q * size_kept
        for i in range(size_kept):
            for j in range(size_kept):
                schur[first + i, first + j] = kept[q, i, j]
            schur[first + i, first + i] *= 1 + damping
    for i in range(len(border)):
        for j in range(first_border + i + 1):
            schur[first_border + i, j] = border[i, j]
        schur[first_border + i, first_border + i] *= 1 + damping
    for p in range(count):
        for i in range(size):
            factor[p, i, i] *= 1 + damping
        if not kernels.cholesky(factor[p]):
            return np.nan
        for i in range(size):
            # Forward substitution of the coupling and of the right-hand side.
            value = -right_blocks[p, i]
            for k in range(i):
                value -= factor[p, i, k] * step_blocks[p, k]
                for j in range(wide):
                    whitened[p, i, j] -= factor[p, i, k] * whitened[p, k, j]
            inverse = 1 / factor[p, i, i]
            step_blocks[p, i] = value * inverse
            for j in range(wide):
                whitened[p, i, j] *= inverse
    tall = whitened.reshape(count * size, wide)
    kernels.subtract_gram(schur, tall)
    flat, right = np.empty(wide, dtype=schur.dtype), right_kept.reshape(-1)
    for j in range(wide):
        flat[j] = -right[j] if j < first_border else -right_border[j - first_border]
    for r in range(count * size):
        forward = step_blocks[r // size, r % size]
        for j in range(wide):
            flat[j] -= tall[r, j] * forward
    if not kernels.cholesky(schur):
        return np.nan
    kernels.cholesky_solve(schur, flat)
    gain = 0.0
    for p in range(count):
        for i in range(size):
            value = step_blocks[p, i]
            for j in range(wide):
                value -= whitened[p, i, j] * flat[j]
            step_blocks[p, i] = value
        for i in range(size - 1, -1, -1):
            value = step_blocks[p, i]
            for k in range(i + 1, size):
                value -= factor[p, k, i] * step_blocks[p, k]
            step_blocks[p, i] = value / factor[p, i, i]
            gain -= 0.5 * right_blocks[p, i] * step_blocks[p, i]
    flat_kept = step_kept.reshape(-1)
    for j in range(first_border):
        flat_kept[j] = flat[j]
        gain -= 0.5 * right[j] * flat[j]
    for j in range(len(border)):
        step_border[j] = flat[first_border + j]
        gain -= 0.5 * right_border[j] * step_border[j]
    return gain


@njit(cache=True, fastmath=kernels.FAST)
def _pair(first):
    """Allocate two arrays like the given one, and copy it to the first."""
    both = np.empty((2,) + first.shape, first.dtype)  # noqa: RUF005 (numba does not support unpacking here)
    _copy(both[0], first)
    return both


@njit(cache=True, fastmath=kernels.FAST)
def _copy(destination, source):
    """Copy an array by a loop, which compiles several times faster than a slice assignment."""
    to, of = destination.reshape(-1), source.reshape(-1)
    for i in range(len(to)):
        to[i] = of[i]
