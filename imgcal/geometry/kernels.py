"""Small compiled functions that the compiled loops of several rooms share: the lens, rotations, Cholesky factors.

`projection.py` and `rotations.py` say the same in tensors, and are what these are tested against. Arrays are filled in
place; the floating-point type is that of the arguments.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from renderers.compiling import njit

FAST = {"contract", "reassoc", "nsz"}
"""Of floating-point arithmetic; nan and inf keep their meaning: a bad step must show."""
LEAST_RADIAL = 0.2  # of `undistort`: beyond the fold of the image there is nothing to find


@njit(fastmath=FAST, inline="always")
def distort(one, x, y, k1, k2, p1, p2, k3):
    """Distort a point (x, y) of the z = 1 plane, like `projection.distort_with_jacobian`.

    `one` is 1 in the type of the arithmetic: a literal would make double precision of single.

    Returns:
        Distorted x and y, the symmetric Jacobian xx, xy, yy, and the squared radius x^2 + y^2.

    Source: Brown 1966, "Decentering Distortion of Lenses"; coefficients and their order as in OpenCV.
    """
    two = one + one
    xx, yy, xy2 = x * x, y * y, two * x * y
    rr = xx + yy
    radial = one + rr * (k1 + rr * (k2 + rr * k3))
    growth = two * (k1 + rr * (two * k2 + (two + one) * rr * k3))
    xd = x * radial + p1 * xy2 + p2 * (rr + two * xx)
    yd = y * radial + p1 * (rr + two * yy) + p2 * xy2
    six = two * (two + one)
    jxx = radial + growth * xx + two * p1 * y + six * p2 * x
    jxy = growth * (x * y) + two * (p1 * x + p2 * y)
    jyy = radial + growth * yy + six * p1 * y + two * p2 * x
    return xd, yd, jxx, jxy, jyy, rr


@njit(fastmath=FAST)
def lens(px, py, depth, radius_squared, k1, k2, p1, p2, k3):
    """Image of a point (mm, in the camera) or of a sphere around it, and its derivatives, like `linearization._lens`.

    Returns:
        x / px; the derivative of log x by depth; x, y, x^2 + y^2, the distorted x and y, and the symmetric
        Jacobian of the distortion: xx, xy, yy.
    """
    squared = depth * depth
    per_depth = depth / (squared - radius_squared)
    log_slope = -(squared + radius_squared) / (depth * (squared - radius_squared))
    x, y = px * per_depth, py * per_depth
    xd, yd, jxx, jxy, jyy, rr = distort(1.0, x, y, k1, k2, p1, p2, k3)
    return per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy


@njit(inline="always")
def undistort(xd, yd, k1, k2, p1, p2, k3):
    """Remove the distortion by fixed-point iteration: good to far less than a pixel; `projection.undistort` is exact.

    Returns:
        x and y on the z = 1 plane.
    """
    x, y = xd, yd
    for _ in range(10):
        rr = x * x + y * y
        radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
        if radial < LEAST_RADIAL:
            radial = LEAST_RADIAL
        x, y = (
            (xd - 2 * p1 * x * y - p2 * (rr + 2 * x * x)) / radial,
            (yd - p1 * (rr + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    return x, y


@njit(inline="always", error_model="numpy")
def blind_from(a, b, c):
    """Squared radius at which 1 + a s + b s^2 + c s^3 has dipped to zero or below, like `projection.is_before_fold`."""
    root = np.sqrt(b * b - 3 * a * c)
    lowest = -a / (b + root) if b > 0 else (root - b) / (3 * c)
    if lowest > 0 and 1 + lowest * (a + lowest * (b + lowest * c)) <= 0:
        return lowest
    return np.inf


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
def subtract_gram(matrix, tall):
    """Subtract tall.T @ tall from the lower triangle; the number of rows is divisible by three, as 6 and 15 are."""
    # Three rows at once: the matrix is read and written a third as often.
    for r in range(0, tall.shape[0], 3):
        for i in range(tall.shape[1]):
            first, second, third = tall[r, i], tall[r + 1, i], tall[r + 2, i]
            for j in range(i + 1):
                matrix[i, j] -= first * tall[r, j] + second * tall[r + 1, j] + third * tall[r + 2, j]
