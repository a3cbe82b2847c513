"""`rig_error` compiled for CPUs: `error_between` and `step_by_error`, camera by camera, in units."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import kernels
from renderers.compiling import njit


@njit(cache=True, fastmath=kernels.FAST)
def write_error(rotation, position, focal, principal, distortion, known_rig, unit, distance):
    """Write the error in units that takes the known rig to this one, like `rig_error.error_between`."""
    rotation0, position0, focal0, principal0, distortion0 = known_rig
    turn, vector = np.empty((3, 3)), np.empty(3)
    cameras, free = unit.shape
    for c in range(cameras):
        first = c * free
        for i in range(3):
            for j in range(3):
                turn[i, j] = (
                    rotation[c, 0, i] * rotation0[c, 0, j]
                    + rotation[c, 1, i] * rotation0[c, 1, j]
                    + rotation[c, 2, i] * rotation0[c, 2, j]
                )
        _logarithm(turn, vector)
        for i in range(3):
            there = turn[i, 0] * position0[c, 0] + turn[i, 1] * position0[c, 1] + turn[i, 2] * position0[c, 2]
            distance[first + i] = vector[i] / unit[c, i]
            distance[first + 3 + i] = (position[c, i] - there) / unit[c, 3 + i]
        for i in range(2):
            distance[first + 6 + i] = (focal[c, i] - focal0[c, i]) / unit[c, 6 + i]
            distance[first + 8 + i] = (principal[c, i] - principal0[c, i]) / unit[c, 8 + i]
        for i in range(free - 10):
            distance[first + 10 + i] = (distortion[c, i] - distortion0[c, i]) / unit[c, 10 + i]


@njit(cache=True, fastmath=kernels.FAST)
def _logarithm(rotation, vector):  # noqa: ANN202
    """Write the rotation vector (3,) of a rotation (3, 3), like `rotations.vector_from_rotation`."""
    # Start with the quaternion's largest part: it is exact near no rotation and near half a turn.
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    if trace >= 0:
        w = 1 + trace
        x, y, z = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    else:
        i = 0
        if rotation[1, 1] > rotation[0, 0]:
            i = 1
        if rotation[2, 2] > rotation[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        parts = np.empty(3)
        parts[i] = 1 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        parts[j] = rotation[j, i] + rotation[i, j]
        parts[k] = rotation[k, i] + rotation[i, k]
        w = rotation[k, j] - rotation[j, k]
        x, y, z = parts[0], parts[1], parts[2]
        if w < 0:
            w, x, y, z = -w, -x, -y, -z
    length = np.sqrt(x * x + y * y + z * z)
    scale = 2 / w if length < 1e-9 * w else 2 * np.arctan2(length, w) / length
    vector[0], vector[1], vector[2] = scale * x, scale * y, scale * z


@njit(cache=True, fastmath=kernels.FAST)
def write_basis(rotation, position, unit, basis):
    """Write the first three columns of a camera's steps by its errors, whitened, like `rig_error.step_by_error`."""
    for j in range(3):
        for i in range(3):
            basis[i, j] = -rotation[i, j] * unit[j] / unit[i]
            basis[3 + i, j] = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        basis[3 + j, k] = position[i] * unit[k] / unit[3 + j]
        basis[3 + k, j] = -position[i] * unit[j] / unit[3 + k]


@njit(cache=True, fastmath=kernels.FAST)
def times_basis(row, basis):
    """Multiply a row (K,) by the steps by errors, whose columns from the fourth on are those of the identity."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(6):
        x += row[i] * basis[i, 0]
        y += row[i] * basis[i, 1]
        z += row[i] * basis[i, 2]
    row[0], row[1], row[2] = x, y, z
