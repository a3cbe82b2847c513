"""Poses from three points in one camera, thousands at once."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from renderers.compiling import njit

FAST = {"contract", "reassoc", "nsz", "arcp"}


@njit(cache=True, fastmath=FAST)
def three_point_pose(rays, sides, mirror, rotation_frame, depths):
    """Find the pose of a triangle of known sides seen along three rays.

    Scaled orthography has exactly two solutions, mirror images of each other, in closed form; the image is then
    corrected for the depths found, once. Where perspective P3P has no real solution because the camera is not quite
    what it is thought to be, this still gives the nearest sensible one. The correction leaves about a degree where the
    object's depth is a fifth of its distance.

    Args:
        rays: (3, 2) coordinates on the z = 1 plane.
        sides: (3,) mm^2, squared distances of the points 0-1, 0-2 and 1-2.
        mirror: +1 or -1: which of the two solutions.
        rotation_frame: (3, 3) filled with the triangle's frame in the camera: columns along the first side, in the
            plane, normal to it.
        depths: (3,) mm, filled with the depths of the points.

    Returns:
        False where the points of the triangle lie in line, or all rays are one.

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
    return depths[1] > 0 and depths[2] > 0 and _frame(rays, depths, rotation_frame)


@njit(cache=True, fastmath=FAST)
def _frame(rays, depths, frame):
    """Fill the frame of the triangle rays * depths."""
    ax, ay = rays[1, 0] * depths[1] - rays[0, 0] * depths[0], rays[1, 1] * depths[1] - rays[0, 1] * depths[0]
    bx, by = rays[2, 0] * depths[2] - rays[0, 0] * depths[0], rays[2, 1] * depths[2] - rays[0, 1] * depths[0]
    az, bz = depths[1] - depths[0], depths[2] - depths[0]
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
