"""Variances of an estimate's parameters by the noise alone, without the covariances, in compiled loops."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation.covariance import UNDETERMINED, whitened_covariance
from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.levenberg_marquardt_cpu import change_precision
from imgcal.estimation.linearization import NormalEquations
from imgcal.estimation.map_estimate import Estimate
from imgcal.geometry import kernels
from renderers.compiling import njit
from renderers.interpreting import without_machine_code

FEW_POSES = 10
"""Up to this many, the cameras are eliminated (exact object only) instead of the poses."""


def flat_std(estimate: Estimate) -> Tensor:
    """Standard deviation of every parameter by the noise alone, a hundred times faster than `camera_std`: (*B, C, K).

    Without inflation, the uncertainty of the object's modes and the second order.
    """
    left = torch.from_numpy(remaining_variance(estimate.solution)).to(estimate.problem.prior_std)
    std = left.clamp_min(0).sqrt() * estimate.problem.prior_std
    return std.reshape(*estimate.chi2.shape, *std.shape[1:])


def remaining_variance(solution: Solution) -> NDArray[np.float64]:
    """Share of each factory value's prior variance that remains: (B, C, K); 1 = the observations add nothing.

    Equals `flat_std` over the prior's, squared.

    Raises:
        RefusedError: the information is singular.
    """
    equations = solution.equations
    snapshots = equations.coupling.shape[1]
    few = snapshots <= FEW_POSES and equations.object is None
    if equations.cost.device.type != "cpu":
        variance = _in_tensors(solution)
    elif missing := without_machine_code(_diagonal if few else _diagonal_without_poses):
        exact = change_precision(solution, torch.float64)  # the compiled functions convert, too
        variance = missing.call_twin(_in_tensors, exact)
    else:
        variance = _by_poses(equations) if few else _by_cameras(equations)
    if not np.isfinite(variance).all():
        raise RefusedError(UNDETERMINED)
    return variance


def _in_tensors(solution: Solution) -> NDArray[np.float64]:
    """Diagonals (B, C, K) on any device."""
    diagonal = whitened_covariance(solution).diagonal(dim1=-2, dim2=-1)
    variance: NDArray[np.float64] = diagonal.unflatten(-1, (solution.state.offset.shape[1], -1)).cpu().numpy()
    return variance


def _by_poses(equations: NormalEquations) -> NDArray[np.float64]:
    """Diagonals (B, C, K) from the poses' dense information."""
    camera, coupling, pose = _doubles(equations.camera, equations.coupling, equations.pose)
    variance = np.empty(camera.shape[:3])
    for b in range(len(variance)):
        wide = coupling[b].transpose(1, 2, 0, 3).reshape(*camera.shape[1:3], -1)
        _diagonal(camera[b].copy(), wide.copy(), pose[b], variance[b])
    return variance


def _by_cameras(equations: NormalEquations) -> NDArray[np.float64]:
    """Diagonals (B, C, K) from the dense information of the cameras and, after them, of the object."""
    camera, coupling, pose = _doubles(equations.camera, equations.coupling, equations.pose)
    batch, cameras = camera.shape[:2]
    coupling = coupling.transpose(0, 1, 4, 2, 3).reshape(*pose.shape[:3], -1)  # (B, S, 6, K C)
    wide = coupling.shape[-1]
    kept = np.zeros((batch, wide, wide))
    blocks = kept.reshape(*camera.shape[:3], *camera.shape[1:3])
    blocks[:, range(cameras), :, range(cameras)] = camera.swapaxes(0, 1)
    if equations.object is not None:
        own = equations.object
        across, with_pose, square = _doubles(own.camera.flatten(1, 2), own.pose, own.own)
        kept = np.concatenate(
            (np.concatenate((kept, across), 2), np.concatenate((across.swapaxes(1, 2), square), 2)), 1
        )
        coupling = np.concatenate((coupling, with_pose), 3)
    variance = np.empty(camera.shape[:3])
    for b in range(batch):
        _diagonal_without_poses(kept[b], np.ascontiguousarray(coupling[b]), pose[b], variance[b].reshape(-1))
    return variance


def _doubles(*tensors: Tensor) -> tuple[NDArray[np.float64], ...]:
    return tuple(tensor.detach().double().numpy() for tensor in tensors)


@njit(cache=True, fastmath=kernels.FAST)
def _diagonal_without_poses(kept, coupling, poses, result):
    """First diagonal entries (D,) of the inverse of `kept` (K, K) after eliminating poses (S, 6, 6) with coupling
    (S, 6, K). Overwrites `kept`; nan where a factorization fails.
    """
    count, size, wide = coupling.shape
    lower, half, row = np.empty((size, size)), np.empty((size, wide)), np.empty(wide)
    determined = True
    for s in range(count):
        for i in range(size):
            for j in range(size):
                lower[i, j] = poses[s, i, j]
        determined = kernels.cholesky(lower) and determined
        for i in range(size):
            inverse = 1 / lower[i, i]
            for j in range(wide):
                half[i, j] = coupling[s, i, j]
            for k in range(i):
                for j in range(wide):
                    half[i, j] -= lower[i, k] * half[k, j]
            for j in range(wide):
                half[i, j] *= inverse
        kernels.subtract_gram(kept, half)
    determined = kernels.cholesky(kept) and determined
    for j in range(len(result)):
        row[j] = 1 / kept[j, j]
        total = row[j] ** 2
        for i in range(j + 1, wide):
            value = 0.0
            for k in range(j, i):
                value -= kept[i, k] * row[k]
            row[i] = value / kept[i, i]
            total += row[i] ** 2
        result[j] = total if determined else np.nan


@njit(cache=True)
def _diagonal(blocks, coupling, poses, result):
    """Diagonal (C, K) of the inverse of an arrow matrix: blocks (C, K, K), coupling (C, K, 6 S), poses (S, 6, 6).

    Overwrites the first two arrays; nan where a factorization fails.
    """
    wide, size = coupling.shape[2], blocks.shape[1]
    kept, row = np.zeros((wide, wide)), np.empty(wide)
    for s in range(len(poses)):
        for i in range(6):
            for j in range(6):
                kept[6 * s + i, 6 * s + j] = poses[s, i, j]
    for c in range(len(blocks)):
        lower, half = blocks[c], coupling[c]
        _invert_factor(lower)
        # half = lower @ coupling, then lower.T @ half = blocks^-1 @ coupling, both in place.
        for i in range(size - 1, -1, -1):
            for j in range(wide):
                value = 0.0
                for k in range(i + 1):
                    value += lower[i, k] * half[k, j]
                half[i, j] = value
        for i in range(wide):
            for j in range(i + 1):
                for k in range(size):
                    kept[i, j] -= half[k, i] * half[k, j]
        for i in range(size):
            result[c, i] = 0.0
            for k in range(i, size):
                result[c, i] += lower[k, i] ** 2
            for j in range(wide):
                value = 0.0
                for k in range(i, size):
                    value += lower[k, i] * half[k, j]
                half[i, j] = value
    _invert_factor(kept)
    for c in range(len(blocks)):
        for i in range(size):
            for j in range(wide):
                row[j] = coupling[c, i, j]
            for j in range(wide):
                value = 0.0
                for k in range(j + 1):
                    value += kept[j, k] * row[k]
                result[c, i] += value * value


@njit(cache=True)
def _invert_factor(matrix):
    """Replace the lower triangle of a symmetric matrix by the inverse of its Cholesky factor; nan where that fails."""
    if not kernels.cholesky(matrix):
        for j in range(len(matrix)):
            matrix[j, j] = np.nan
    for j in range(len(matrix)):
        matrix[j, j] = 1 / matrix[j, j]
        for i in range(j + 1, len(matrix)):
            value = 0.0
            for k in range(j, i):
                value -= matrix[i, k] * matrix[k, j]
            matrix[i, j] = value / matrix[i, i]
