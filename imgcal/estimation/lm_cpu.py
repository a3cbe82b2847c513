"""The solver's fast path on CPUs: `levenberg_marquardt.minimize` compiled to one loop a rig, without temporaries.

`linearization.py`, `schur.py` and `levenberg_marquardt.py` say the same in tensors, run on any device, and this is
tested against them. Names, units and layouts are theirs. Rigs of a batch run in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor

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
from imgcal.geometry import NEAREST_DEPTH, RigidTransform, kernels
from imgcal.types import CameraRig
from renderers.compiling import njit

LOSS_CODES = {"squared": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3}


def minimize(
    problem: Problem, start: State, loss: str, threshold: float, max_iterations: int, tolerance: float
) -> Solution:
    """Do the work of `solver.minimize` for tensors on the CPU.

    Args:
        problem: what is given, batch axis B; one floating-point type throughout.
        start: first guess.
        loss: a key of `LOSS_CODES`.
        threshold: the loss's threshold in standard deviations.
        max_iterations: linearizations at most, for each rig.
        tolerance: see `solver.minimize`.
    """
    own_std, state = _object_of(problem, start)
    blocks = _Blocks.of(problem)
    cost, count = blocks.cost, len(blocks.cost)
    converged = np.zeros(count, dtype=np.bool_)
    iterations = np.zeros(count, dtype=np.int64)
    arrays = _arrays((*_given(problem), own_std, *_parts(state), *blocks.parts, cost))
    limits = (blocks.cameras_first, LOSS_CODES[loss], threshold, max_iterations)
    tolerances = (tolerance + pixel_rounding(problem)).numpy()
    shared = _shared(problem)
    if count == 1:
        _minimize_rig(  # type: ignore[call-arg]
            *shared, *(array[0] for array in arrays[:-1]), arrays[-1], converged, iterations, *limits, tolerances[0]
        )
    else:
        # Both use OpenMP: the compiled loop obeys torch's number of threads, and must not leave its own behind.
        threads = torch.get_num_threads()
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
        _minimize_all(*shared, *arrays, converged, iterations, *limits, tolerances)  # type: ignore[call-arg]
        torch.set_num_threads(threads)
    if not own_std.shape[1]:
        state = replace(state, object_offset=None)
    return Solution(state, blocks.equations(), torch.from_numpy(converged), int(iterations.max()))


def linearize(problem: Problem, state: State, loss: str, threshold: float) -> NormalEquations:
    """Do the work of `linearization.linearize` for tensors on the CPU, without gradients; the loss as in `minimize`."""
    own_std, state = _object_of(problem, state)
    blocks = _Blocks.of(problem)
    arrays = _arrays((*_given(problem), own_std, *_parts(state), *blocks.parts, blocks.cost))
    _linearize_all(*_shared(problem), *arrays, blocks.cameras_first, LOSS_CODES[loss], threshold)  # type: ignore[call-arg]
    return blocks.equations()


@dataclass(frozen=True)
class _Blocks:
    """The normal equations as the compiled loops lay them out, B rigs; M columns of the object stand behind."""

    cameras_first: bool
    camera: Tensor  # (B, C, 15, 15)
    coupling: Tensor  # (B, C, 15, 6 S + M) where cameras are eliminated first, else (B, S, 6, 15 C + M)
    pose: Tensor  # (B, S, 6, 6)
    border: Tensor  # (B, M, as wide), lower triangle
    camera_gradient: Tensor  # (B, C, 15)
    pose_gradient: Tensor  # (B, S, 6)
    own_gradient: Tensor  # (B, M)
    residual: Tensor  # (B, S, C, 2, N)
    cost: Tensor  # (B,)

    @classmethod
    def of(cls, problem: Problem) -> _Blocks:
        """Make room for those of a problem."""
        batch, snapshots, cameras, _, fiducials = problem.uv.shape
        own = 0 if problem.object_prior_std is None else problem.object_prior_std.shape[1]
        cameras_first = 6 * snapshots <= 15 * cameras
        shape = (cameras, 15, 6 * snapshots + own) if cameras_first else (snapshots, 6, 15 * cameras + own)
        sizes = (
            (cameras, 15, 15), shape, (snapshots, 6, 6), (own, shape[-1]),
            (cameras, 15), (snapshots, 6), (own,), (snapshots, cameras, 2, fiducials), (),
        )  # fmt: skip
        return cls(cameras_first, *(problem.uv.new_empty(batch, *size) for size in sizes))

    @property
    def parts(self) -> tuple[Tensor, ...]:
        """All but the cost, in the order of the compiled loops."""
        gradients = (self.camera_gradient, self.pose_gradient, self.own_gradient)
        return (self.camera, self.coupling, self.pose, self.border, *gradients, self.residual)

    def equations(self) -> NormalEquations:
        """The same as `linearization.linearize` has them."""
        wide = self.coupling.shape[-1] - self.border.shape[1]
        coupling, across = self.coupling[..., :wide], self.border[..., :wide]
        if self.cameras_first:
            blocks = coupling.unflatten(-1, (-1, 6)).permute(0, 3, 1, 2, 4)
        else:
            blocks = coupling.unflatten(-1, (-1, 15)).permute(0, 1, 3, 4, 2)
        gradients = (self.camera_gradient, self.pose_gradient)
        equations = NormalEquations(self.cost, self.camera, blocks, self.pose, *gradients, self.residual)
        if not self.border.shape[1]:
            return equations
        if self.cameras_first:
            pair = (self.coupling[..., wide:], across.unflatten(-1, (-1, 6)).permute(0, 2, 3, 1))
        else:
            pair = (across.unflatten(-1, (-1, 15)).permute(0, 2, 3, 1), self.coupling[..., wide:])
        lower = self.border[..., wide:]
        square = lower.tril() + lower.tril(-1).mT
        return replace(equations, object=ObjectEquations(*pair, square, self.own_gradient))


def _object_of(problem: Problem, state: State) -> tuple[Tensor, State]:
    """Spread of the object's parameters (B, M), M = 0 where it is exact, and a copy of the state with as many."""
    prior_std = (
        problem.uv.new_empty(len(problem.uv), 0) if problem.object_prior_std is None else problem.object_prior_std
    )
    offset = torch.zeros_like(prior_std) if state.object_offset is None else state.object_offset.clone()
    return prior_std, State(state.offset.clone(), state.rotation.clone(), state.centre.clone(), offset)


def _given(problem: Problem) -> tuple[Tensor, ...]:
    factory = problem.factory
    pinhole = (factory.focal_length, factory.principal_point, factory.distortion)
    # The rig's own `positions` are those of tensors, and wait for a dozen of small operations.
    rotation, translation = factory.cam_from_rig.rotation.detach(), factory.cam_from_rig.translation.detach()
    positions = -(rotation.numpy().swapaxes(-1, -2) @ translation.numpy()[..., None])[..., 0]
    rig = (rotation, torch.from_numpy(positions), *pinhole)
    return (problem.uv, problem.root_weight, *rig, problem.prior_std)


def _parts(state: State) -> tuple[Tensor, ...]:
    assert state.object_offset is not None  # see `_object_of`
    return (state.offset, state.rotation, state.centre, state.object_offset)


def _shared(problem: Problem) -> list[np.ndarray]:
    points, squared = problem.points, problem.radius_squared
    return _arrays((points, points.new_zeros(len(points)) if squared is None else squared))


def rig_at(problem: Problem, offset: Tensor) -> CameraRig:
    """Do the work of `linearize.rig_at` for tensors on the CPU, without gradients."""
    factory = problem.factory
    given = (factory.cam_from_rig.rotation, factory.cam_from_rig.translation)
    rotation, translation = (torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in given)
    parameters = offset * problem.prior_std
    _turn_all(*_arrays((parameters, *given, rotation, translation)))
    return replace(
        factory,
        focal_length=factory.focal_length + parameters[..., 6:8],
        principal_point=factory.principal_point + parameters[..., 8:10],
        distortion=factory.distortion + parameters[..., 10:15],
        cam_from_rig=RigidTransform(rotation, translation),
    )


def _arrays(tensors: tuple[Tensor, ...]) -> list[np.ndarray]:
    """Share the memory of contiguous tensors; copy the others."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


@njit(parallel=True, cache=True, fastmath=kernels.FAST)
def _minimize_all(
    points, radius_squared, uv, root_weight, rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    offset, rotation, centre, own_offset,
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual,
    cost, converged, iterations, cameras_first, loss, threshold, max_iterations, tolerances,
):  # fmt: skip
    for b in prange(uv.shape[0]):
        _minimize_rig(
            points, radius_squared, uv[b], root_weight[b],
            rotation0[b], position0[b], focal0[b], principal0[b], distortion0[b], prior_std[b], own_std[b],
            offset[b], rotation[b], centre[b], own_offset[b], camera[b], coupling[b], pose[b], border[b],
            camera_gradient[b], pose_gradient[b], own_gradient[b], residual[b],
            cost[b : b + 1], converged[b : b + 1], iterations[b : b + 1],
            cameras_first, loss, threshold, max_iterations, tolerances[b],
        )  # fmt: skip


@njit(cache=True, fastmath=kernels.FAST)
def _minimize_rig(
    points, radius_squared, uv, root_weight, rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    offset, rotation, centre, own_offset,
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual,
    cost, converged, iterations, cameras_first, loss, threshold, max_iterations, tolerance,
):  # fmt: skip
    """Levenberg-Marquardt on one rig; the outputs hold the best state and its normal equations."""
    given = (
        points, radius_squared, uv, root_weight,
        rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    )  # fmt: skip
    state = (offset, rotation, centre, own_offset)
    blocks = (camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual)
    best, best_blocks = state, blocks
    trial = (np.empty_like(offset), np.empty_like(rotation), np.empty_like(centre), np.empty_like(own_offset))
    trial_blocks = (
        np.empty_like(camera), np.empty_like(coupling), np.empty_like(pose), np.empty_like(border),
        np.empty_like(camera_gradient), np.empty_like(pose_gradient), np.empty_like(own_gradient),
        np.empty_like(residual),
    )  # fmt: skip
    camera_step, pose_step = np.empty_like(camera_gradient), np.empty_like(pose_gradient)
    own_step = np.empty_like(own_gradient)
    factor = np.empty_like(camera) if cameras_first else np.empty_like(pose)
    whitened, size = np.empty_like(coupling), coupling.shape[2]
    schur = np.empty((size, size), dtype=uv.dtype)
    rounding = 4 * np.finfo(uv.dtype).eps
    damping, growth = LEAST_DAMPING, FIRST_GROWTH
    cost[0] = _linearize(given, best, best_blocks, cameras_first, loss, threshold)
    swapped, relax = False, RELAX
    for iteration in range(max_iterations):
        iterations[0] = iteration + 1
        a, w, d, e, ga, gd, ge, _ = best_blocks
        if cameras_first:
            gain = _solve(a, w, d, e, ga, gd, ge, damping, factor, whitened, schur, camera_step, pose_step, own_step)
        else:
            gain = _solve(d, w, a, e, gd, ga, ge, damping, factor, whitened, schur, pose_step, camera_step, own_step)
        better, small = False, False
        if np.isfinite(gain):
            _move(best, camera_step, pose_step, own_step, trial)
            trial_cost = _linearize(given, trial, trial_blocks, cameras_first, loss, threshold)
            small = gain <= tolerance + rounding * cost[0]
            if trial_cost < cost[0]:
                relax = min(max(1 - (2 * (cost[0] - trial_cost) / gain - 1) ** 3, RELAX), GREATEST_RELAX)
                better, swapped, cost[0] = True, not swapped, trial_cost
                best, trial = trial, best
                best_blocks, trial_blocks = trial_blocks, best_blocks
        # See solver.minimize: only a lightly damped small step shows that this is the minimum.
        if small and damping <= 1e-3 and np.isfinite(cost[0]):
            converged[0] = True
            break
        damping = min(max(damping * (relax if better else growth), LEAST_DAMPING), MOST_DAMPING)
        growth = FIRST_GROWTH if better else 2 * growth
    if swapped:
        _copy(offset, best[0])
        _copy(rotation, best[1])
        _copy(centre, best[2])
        _copy(own_offset, best[3])
        _copy(camera, best_blocks[0])
        _copy(coupling, best_blocks[1])
        _copy(pose, best_blocks[2])
        _copy(border, best_blocks[3])
        _copy(camera_gradient, best_blocks[4])
        _copy(pose_gradient, best_blocks[5])
        _copy(own_gradient, best_blocks[6])
        _copy(residual, best_blocks[7])


@njit(cache=True, fastmath=kernels.FAST)
def _linearize_all(
    points, radius_squared, uv, root_weight, rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    offset, rotation, centre, own_offset,
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual,
    cost, cameras_first, loss, threshold,
):  # fmt: skip
    for b in range(len(cost)):
        given = (
            points, radius_squared, uv[b], root_weight[b],
            rotation0[b], position0[b], focal0[b], principal0[b], distortion0[b], prior_std[b], own_std[b],
        )  # fmt: skip
        state = (offset[b], rotation[b], centre[b], own_offset[b])
        blocks = (
            camera[b], coupling[b], pose[b], border[b], camera_gradient[b], pose_gradient[b], own_gradient[b],
            residual[b],
        )  # fmt: skip
        cost[b] = _linearize(given, state, blocks, cameras_first, loss, threshold)


@njit(cache=True, fastmath=kernels.FAST)
def _linearize(given, state, blocks, cameras_first, loss, threshold):
    """Fill the blocks of the normal equations and return the cost."""
    (
        points, radius_squared, uv, root_weight,
        rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    ) = given  # fmt: skip
    offset, rotation, centre, own_offset = state
    camera, _, pose, _, camera_gradient, pose_gradient, _, residual = blocks
    snapshots, cameras, fiducials = root_weight.shape
    kind = uv.dtype
    pose[:] = 0
    pose_gradient[:] = 0
    rows = np.zeros((2, 21), dtype=kind)
    products = np.empty((21, 21), dtype=kind)
    gradient = np.empty(21, dtype=kind)
    turned, left, rotation_cam = (
        np.empty((3, 3), dtype=kind),
        np.empty((3, 3), dtype=kind),
        np.empty((3, 3), dtype=kind),
    )
    parameters = np.empty(15, dtype=kind)
    rotated, point = np.empty(3, dtype=kind), np.empty(3, dtype=kind)
    derivative, back = np.empty((2, 3), dtype=kind), np.empty(3, dtype=kind)
    bent, scale = len(own_std) > 0, 1.0
    rows_own = np.empty((2, 4), dtype=kind)
    cost = 0.0
    if bent:
        cost = _start_object(own_offset, blocks)
        scale += own_offset[-1] * own_std[-1]
    for c in range(cameras):
        for i in range(15):
            parameters[i] = offset[c, i] * prior_std[c, i]
            cost += 0.5 * offset[c, i] ** 2
            camera_gradient[c, i] = offset[c, i]
            for j in range(15):
                camera[c, i, j] = 1.0 if i == j else 0.0
        kernels.exponential(parameters[:3], turned, left)
        kernels.multiply(turned, rotation0[c], rotation_cam)
        fx, fy = focal0[c, 0] + parameters[6], focal0[c, 1] + parameters[7]
        cx, cy = principal0[c, 0] + parameters[8], principal0[c, 1] + parameters[9]
        k1, k2, p1 = (
            distortion0[c, 0] + parameters[10],
            distortion0[c, 1] + parameters[11],
            distortion0[c, 2] + parameters[12],
        )
        p2, k3 = distortion0[c, 3] + parameters[13], distortion0[c, 4] + parameters[14]
        for s in range(snapshots):
            products[:] = 0
            gradient[:] = 0
            unit = max(1.0, np.sqrt(centre[s, 0] ** 2 + centre[s, 1] ** 2 + centre[s, 2] ** 2))
            for n in range(fiducials):
                at_x, at_y, at_z = points[n, 0], points[n, 1], points[n, 2]
                if bent:
                    at_x = scale * at_x + own_offset[3 * n] * own_std[3 * n]
                    at_y = scale * at_y + own_offset[3 * n + 1] * own_std[3 * n + 1]
                    at_z = scale * at_z + own_offset[3 * n + 2] * own_std[3 * n + 2]
                for i in range(3):
                    rotated[i] = rotation[s, i, 0] * at_x + rotation[s, i, 1] * at_y + rotation[s, i, 2] * at_z
                rx = rotated[0] + centre[s, 0] - position0[c, 0] - parameters[3]
                ry = rotated[1] + centre[s, 1] - position0[c, 1] - parameters[4]
                rz = rotated[2] + centre[s, 2] - position0[c, 2] - parameters[5]
                for i in range(3):
                    point[i] = rotation_cam[i, 0] * rx + rotation_cam[i, 1] * ry + rotation_cam[i, 2] * rz
                weight = root_weight[s, c, n]
                if weight > 0 and point[2] <= NEAREST_DEPTH:
                    cost = np.inf
                depth = max(point[2], NEAREST_DEPTH)

                per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy = kernels.lens(
                    point[0], point[1], depth, radius_squared[n], k1, k2, p1, p2, k3
                )
                ru, rv = fx * xd + cx - uv[s, c, 0, n], fy * yd + cy - uv[s, c, 1, n]
                residual[s, c, 0, n], residual[s, c, 1, n] = ru, rv
                if weight == 0:
                    continue
                value, slope = _loss((ru * ru + rv * rv) * weight * weight, loss, threshold)
                cost += 0.5 * value
                weight *= np.sqrt(slope)
                fx_w, fy_w = fx * weight, fy * weight
                derivative[0, 0], derivative[0, 1] = fx_w * per_depth * jxx, fx_w * per_depth * jxy
                derivative[0, 2] = fx_w * log_slope * (jxx * x + jxy * y)
                derivative[1, 0], derivative[1, 1] = fy_w * per_depth * jxy, fy_w * per_depth * jyy
                derivative[1, 2] = fy_w * log_slope * (jxy * x + jyy * y)

                for r in range(2):
                    d0, d1, d2 = derivative[r, 0], derivative[r, 1], derivative[r, 2]
                    t0 = point[1] * d2 - point[2] * d1
                    t1 = point[2] * d0 - point[0] * d2
                    t2 = point[0] * d1 - point[1] * d0
                    for i in range(3):
                        rows[r, i] = left[0, i] * t0 + left[1, i] * t1 + left[2, i] * t2
                        back[i] = rotation_cam[0, i] * d0 + rotation_cam[1, i] * d1 + rotation_cam[2, i] * d2
                        rows[r, 3 + i] = -back[i]
                        rows[r, 18 + i] = back[i] * unit
                    rows[r, 15] = rotated[1] * back[2] - rotated[2] * back[1]
                    rows[r, 16] = rotated[2] * back[0] - rotated[0] * back[2]
                    rows[r, 17] = rotated[0] * back[1] - rotated[1] * back[0]
                    if bent:
                        for i in range(3):
                            rows_own[r, i] = (
                                rotation[s, 0, i] * back[0] + rotation[s, 1, i] * back[1] + rotation[s, 2, i] * back[2]
                            )
                        rows_own[r, 3] = own_std[-1] * (
                            rows_own[r, 0] * points[n, 0]
                            + rows_own[r, 1] * points[n, 1]
                            + rows_own[r, 2] * points[n, 2]
                        )
                        for i in range(3):
                            rows_own[r, i] *= own_std[3 * n + i]
                rows[0, 6], rows[1, 7] = xd * weight, yd * weight
                rows[0, 8], rows[1, 9] = weight, weight
                rows[0, 10], rows[1, 10] = fx_w * x * rr, fy_w * y * rr
                rows[0, 11], rows[1, 11] = rows[0, 10] * rr, rows[1, 10] * rr
                rows[0, 12], rows[1, 12] = fx_w * 2 * x * y, fy_w * (rr + 2 * y * y)
                rows[0, 13], rows[1, 13] = fx_w * (rr + 2 * x * x), fy_w * 2 * x * y
                rows[0, 14], rows[1, 14] = rows[0, 11] * rr, rows[1, 11] * rr
                for i in range(15):
                    rows[0, i] *= prior_std[c, i]
                    rows[1, i] *= prior_std[c, i]
                ru, rv = ru * weight, rv * weight
                if bent:
                    _add_object(rows, rows_own, ru, rv, c, s, n, blocks, cameras_first)
                for i in range(21):
                    gradient[i] += rows[0, i] * ru + rows[1, i] * rv
                    for j in range(i + 1):
                        products[i, j] += rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j]
            _distribute(products, gradient, c, s, blocks, cameras_first)
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _start_object(own_offset, blocks):
    """Clear the object's part of the blocks, put its prior there, and return the prior's cost."""
    _, coupling, _, border, _, _, own_gradient, _ = blocks
    size, wide = border.shape
    first, cost = wide - size, 0.0
    for p in range(coupling.shape[0]):
        for i in range(coupling.shape[1]):
            for j in range(first, wide):
                coupling[p, i, j] = 0
    for i in range(size):
        for j in range(wide):
            border[i, j] = 1.0 if j == first + i else 0.0
        own_gradient[i] = own_offset[i]
        cost += 0.5 * own_offset[i] ** 2
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _add_object(rows, rows_own, ru, rv, c, s, n, blocks, cameras_first):
    """Add what one observation says of its fiducial's coordinates and of the object's scale."""
    _, coupling, _, border, _, _, own_gradient, _ = blocks
    size, wide = border.shape
    first, last = wide - size, size - 1
    for k in range(4):
        own = 3 * n + k if k < 3 else last
        mine_u, mine_v = rows_own[0, k], rows_own[1, k]
        own_gradient[own] += mine_u * ru + mine_v * rv
        for i in range(15):
            product = rows[0, i] * mine_u + rows[1, i] * mine_v
            if cameras_first:
                coupling[c, i, first + own] += product
            else:
                border[own, 15 * c + i] += product
        for i in range(6):
            product = rows[0, 15 + i] * mine_u + rows[1, 15 + i] * mine_v
            if cameras_first:
                border[own, 6 * s + i] += product
            else:
                coupling[s, i, first + own] += product
        for j in range(k + 1):
            other = 3 * n + j if j < 3 else last
            border[own, first + other] += rows_own[0, j] * mine_u + rows_own[1, j] * mine_v


@njit(cache=True, fastmath=kernels.FAST)
def _distribute(products, gradient, c, s, blocks, cameras_first):
    """Add the lower triangle of one camera's products with one snapshot to the blocks."""
    camera, coupling, pose, _, camera_gradient, pose_gradient, _, _ = blocks
    for i in range(15):
        camera_gradient[c, i] += gradient[i]
        for j in range(i + 1):
            camera[c, i, j] += products[i, j]
            camera[c, j, i] = camera[c, i, j]
    for i in range(6):
        pose_gradient[s, i] += gradient[15 + i]
        for j in range(i + 1):
            pose[s, i, j] += products[15 + i, 15 + j]
            pose[s, j, i] = pose[s, i, j]
        for j in range(15):
            if cameras_first:
                coupling[c, j, 6 * s + i] = products[15 + i, j]
            else:
                coupling[s, i, 15 * c + j] = products[15 + i, j]


@njit(cache=True, fastmath=kernels.FAST)
def _solve(
    blocks, coupling, kept, border, right_blocks, right_kept, right_border, damping, factor, whitened, schur,
    step_blocks, step_kept, step_border,
):  # fmt: skip
    """Solve the damped arrow for minus the gradients; return the predicted decrease, nan if a factorization fails."""
    count, size, wide = coupling.shape
    size_kept = kept.shape[1]
    first_border = wide - len(border)
    _copy(factor, blocks)
    _copy(whitened, coupling)
    schur[:] = 0
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
def _move(state, camera_step, pose_step, own_step, new):
    """Write the state plus a step to `new`, like linearize.moved."""
    offset, rotation, centre, own_offset = state
    new_offset, new_rotation, new_centre, new_own_offset = new
    for i in range(len(own_offset)):
        new_own_offset[i] = own_offset[i] + own_step[i]
    for c in range(len(offset)):
        for i in range(15):
            new_offset[c, i] = offset[c, i] + camera_step[c, i]
    turned, left = np.empty((3, 3), dtype=offset.dtype), np.empty((3, 3), dtype=offset.dtype)
    for s in range(len(centre)):
        unit = max(1.0, np.sqrt(centre[s, 0] ** 2 + centre[s, 1] ** 2 + centre[s, 2] ** 2))
        for i in range(3):
            new_centre[s, i] = centre[s, i] + pose_step[s, 3 + i] * unit
        kernels.exponential(pose_step[s, :3], turned, left)
        kernels.multiply(turned, rotation[s], new_rotation[s])


@njit(cache=True, fastmath=kernels.FAST)
def _turn_all(parameters, rotation0, translation0, rotation, translation):
    """Write cam_from_rig after steps of its rotation and position: with c = -R0' t0 + dc, t = -R c = E (t0 - R0 dc)."""
    turned, left = np.empty((3, 3), dtype=parameters.dtype), np.empty((3, 3), dtype=parameters.dtype)
    for b in range(parameters.shape[0]):
        for c in range(parameters.shape[1]):
            step = parameters[b, c]
            kernels.exponential(step[:3], turned, left)
            kernels.multiply(turned, rotation0[b, c], rotation[b, c])
            for i in range(3):
                value = 0.0
                for j in range(3):
                    value += turned[i, j] * translation0[b, c, j] - rotation[b, c, i, j] * step[3 + j]
                translation[b, c, i] = value


@njit(cache=True, fastmath=kernels.FAST)
def _copy(destination, source):
    """Copy an array; a loop of its own, because that compiles several times faster than a slice assignment."""
    to, of = destination.reshape(-1), source.reshape(-1)
    for i in range(len(to)):
        to[i] = of[i]


@njit(cache=True, fastmath=kernels.FAST)
def _loss(squared, loss, threshold):
    """Robust loss and its slope, like robust.LOSSES."""
    if loss == 1:
        if squared <= threshold**2:
            return squared, 1.0
        distance = np.sqrt(squared)
        return 2 * threshold * distance - threshold**2, threshold / distance
    if loss == 2:
        ratio = squared / threshold**2
        return threshold**2 * np.log1p(ratio), 1 / (1 + ratio)
    if loss == 3:
        share = threshold**2 / (threshold**2 + squared)
        return squared * share, share * share
    return squared, 1.0
