"""Small compiled functions shared by the compiled loops of several subpackages: rotations, Cholesky factors, ranks.

Tests compare them with the tensor versions in `rotations.py`; lenses are in `lens_kernels.py`. Arrays are filled in
place; the floating-point type is that of the arguments.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from renderers.compiling import njit

FAST = {"contract", "reassoc", "nsz"}
"""Permitted floating-point optimizations; nan and inf keep their meaning, so that a bad step is noticed."""
LINE = 1e-3
"""Points count as collinear up to this distance from a line, relative to their largest distance from the origin."""


@njit(cache=True, fastmath=FAST)
def fill_free_turns(points, turns):
    """Fill the projector (3, 3) onto rotations about the origin that leave points (N, 3) in place.

    Returns:
        Number of such rotation axes: 0 for a solid or a plane, 1 for a line through the origin, 3 for the origin alone.
    """
    far, greatest = 0, 0.0
    for n in range(len(points)):
        squared = points[n, 0] ** 2 + points[n, 1] ** 2 + points[n, 2] ** 2
        if squared > greatest:
            far, greatest = n, squared
    turns[:] = 0
    if greatest == 0:
        for i in range(3):
            turns[i, i] = 1
        return 3
    a = points[far]
    for n in range(len(points)):
        b = points[n]
        x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        if x * x + y * y + z * z > (LINE * greatest) ** 2:
            return 0
    for i in range(3):
        for j in range(3):
            turns[i, j] = a[i] * a[j] / greatest
    return 1


@njit(fastmath=FAST)
def exponential(vector, rotation, left):
    """Rotation (3, 3) of a rotation vector (3,), and the left Jacobian (3, 3) there.

    Like `rotations.rotation_from_vector` and `rotations.left_jacobian`.
    """
    squared = vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2
    if squared < 1e-8:
        a, b, c = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    else:
        angle = np.sqrt(squared)
        a, b = np.sin(angle) / angle, 2 * np.sin(0.5 * angle) ** 2 / squared
        c = (angle - np.sin(angle)) / (squared * angle)
    for i in range(3):
        for j in range(3):
            outer = vector[i] * vector[j] - (squared if i == j else 0.0)
            unit = 1.0 if i == j else 0.0
            rotation[i, j] = unit + b * outer
            left[i, j] = unit + c * outer
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rotation[k, j] += a * vector[i]
        rotation[j, k] -= a * vector[i]
        left[k, j] += b * vector[i]
        left[j, k] -= b * vector[i]


@njit(fastmath=FAST)
def multiply(first, second, result):
    """Write the product of two matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            result[i, j] = first[i, 0] * second[0, j] + first[i, 1] * second[1, j] + first[i, 2] * second[2, j]


@njit(fastmath=FAST)
def cholesky(matrix):
    """Factorize a symmetric matrix (its lower triangle) in place; false if it is not positive definite."""
    for j in range(matrix.shape[0]):
        diagonal = matrix[j, j]
        for k in range(j):
            diagonal -= matrix[j, k] * matrix[j, k]
        if not diagonal > 0:
            return False
        diagonal = np.sqrt(diagonal)
        matrix[j, j] = diagonal
        inverse = 1 / diagonal
        for i in range(j + 1, matrix.shape[0]):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value * inverse
    return True


@njit(fastmath=FAST)
def cholesky_solve(lower, right):
    """Solve lower @ lower.T @ x = right in place, for a factor of `cholesky`."""
    size = len(right)
    for i in range(size):
        value = right[i]
        for k in range(i):
            value -= lower[i, k] * right[k]
        right[i] = value / lower[i, i]
    for i in range(size - 1, -1, -1):
        right[i] /= lower[i, i]
        for k in range(i):
            right[k] -= lower[i, k] * right[i]


@njit(fastmath=FAST)
def mirror(matrix):
    """Copy the lower triangle to the upper one, tile by tile: whole columns of a large matrix do not fit the cache."""
    size, tile = len(matrix), 32
    for first in range(0, size, tile):
        for i in range(first, size):
            for j in range(first, min(first + tile, i)):
                matrix[j, i] = matrix[i, j]


@njit(fastmath=FAST)
def subtract_gram(matrix, tall):
    """Subtract tall.T @ tall from the lower triangle; the number of rows must be divisible by three (6, 15, 18)."""
    # Three rows at once: the matrix is read and written a third as often. Cameras that see nothing, and rotations of a
    # single light, have only zeros.
    for r in range(0, tall.shape[0], 3):
        for i in range(tall.shape[1]):
            first, second, third = tall[r, i], tall[r + 1, i], tall[r + 2, i]
            if first == 0 and second == 0 and third == 0:
                continue
            for j in range(i + 1):
                matrix[i, j] -= first * tall[r, j] + second * tall[r + 1, j] + third * tall[r + 2, j]


@njit(nogil=True)
def select_rank(values, count, rank):
    """Select a rank among the first `count` values, which are reordered so that none before it is larger (Hoare)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]
