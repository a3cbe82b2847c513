"""Poses from three points in one camera, thousands at once."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from renderers.compiling import njit

FAST = {"contract", "reassoc", "nsz", "arcp"}


def rotation_towards(rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn cameras towards their points, as scaled orthography requires.

    Args:
        rays: (*B, 3, 2) coordinates on the z = 1 plane.

    Returns:
        The same rays on the plane z = 1 of a camera that looks at their mean (*B, 3, 2), and those points in the
        original camera's axes (*B, 3, 3).
    """
    points = np.concatenate((rays, np.ones((*rays.shape[:-1], 1))), axis=-1)
    view = points.mean(-2)
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    points /= (points * view[..., None, :]).sum(-1, keepdims=True)
    right = np.stack((view[..., 2], np.zeros(view.shape[:-1]), -view[..., 0]), axis=-1)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    axes = np.stack((right, np.cross(view, right)), axis=-1)  # (*B, 3, 2)
    return points @ axes, points


@njit(cache=True, fastmath=FAST)
def three_point_pose(rays, directions, sides, mirror, rotation_frame, depths):
    """Find the pose of a triangle with known sides along three rays.

    Scaled orthography has exactly two solutions, mirror images of each other, in closed form; the image is then
    corrected once for the depths found. If perspective P3P has no real solution because the camera's parameters are
    inexact, this still gives the nearest sensible one. The correction leaves a quarter of a degree if the object's
    depth is a fifth of its distance and the camera looks at it: see `rotation_towards`.

    Args:
        rays: (3, 2) coordinates on the z = 1 plane of a camera that looks at the triangle.
        directions: (3, 3) points of that plane, in the axes of the desired pose.
        sides: (3,) mm^2, squared distances of the points 0-1, 0-2 and 1-2.
        mirror: +1 or -1: which of the two solutions.
        rotation_frame: (3, 3) filled with the triangle's frame: columns along the first side, in the plane, normal to
            it.
        depths: (3,) mm, filled with the depths of the points: they lie at `directions * depths`.

    Returns:
        False if the points of the triangle are collinear, or all rays are equal.

    Source: Alter 1994, "3-D Pose from 3 Points Using Weak-Perspective"; the correction is that of POSIT (DeMenthon and
    Davis 1995).
    """
    r01, r02, r12 = sides[0], sides[1], sides[2]
    a = 2 * (r01 * r02 + r01 * r12 + r02 * r12) - r01 * r01 - r02 * r02 - r12 * r12
    if a <= 1e-6 * r01 * r02:
        return False
    z1, z2, scale2 = 1.0, 1.0, 1.0
    for _ in range(2):
        x1, y1 = rays[1, 0] * z1 - rays[0, 0], rays[1, 1] * z1 - rays[0, 1]
        x2, y2 = rays[2, 0] * z2 - rays[0, 0], rays[2, 1] * z2 - rays[0, 1]
        d01, d02 = x1 * x1 + y1 * y1, x2 * x2 + y2 * y2
        d12 = (x1 - x2) ** 2 + (y1 - y2) ** 2
        b = d01 * (r02 + r12 - r01) + d02 * (r01 + r12 - r02) + d12 * (r01 + r02 - r12)
        c = 2 * (d01 * (d02 + d12) + d02 * d12) - d01 * d01 - d02 * d02 - d12 * d12
        scale2 = (b + np.sqrt(max(b * b - a * c, 0.0))) / a
        if not scale2 > 0:
            return False
        h1, h2 = np.sqrt(max(scale2 * r01 - d01, 0.0)), np.sqrt(max(scale2 * r02 - d02, 0.0))
        same_side = d01 + d02 - d12 <= scale2 * (r01 + r02 - r12)
        z1, z2 = 1 + mirror * h1, 1 + mirror * (h2 if same_side else -h2)
    depths[0] = 1 / np.sqrt(scale2)
    depths[1], depths[2] = z1 * depths[0], z2 * depths[0]
    return depths[1] > 0 and depths[2] > 0 and _frame(directions, depths, rotation_frame)


@njit(cache=True, fastmath=FAST)
def _frame(directions, depths, frame):
    """Fill in the frame of the triangle directions * depths."""
    d = directions
    x0, y0, z0 = d[0, 0] * depths[0], d[0, 1] * depths[0], d[0, 2] * depths[0]
    ax, ay, az = d[1, 0] * depths[1] - x0, d[1, 1] * depths[1] - y0, d[1, 2] * depths[1] - z0
    bx, by, bz = d[2, 0] * depths[2] - x0, d[2, 1] * depths[2] - y0, d[2, 2] * depths[2] - z0
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    along, normal = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(nx * nx + ny * ny + nz * nz)
    if not (along > 0 and normal > 0):
        return False
    frame[0, 0], frame[1, 0], frame[2, 0] = ax / along, ay / along, az / along
    frame[0, 2], frame[1, 2], frame[2, 2] = nx / normal, ny / normal, nz / normal
    frame[0, 1] = frame[1, 2] * frame[2, 0] - frame[2, 2] * frame[1, 0]
    frame[1, 1] = frame[2, 2] * frame[0, 0] - frame[0, 2] * frame[2, 0]
    frame[2, 1] = frame[0, 2] * frame[1, 0] - frame[1, 2] * frame[0, 0]
    return True
