"""Compiled sums for aligning a rig to unlabelled blobs: each blob should lie on its most probable epipolar lines."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from renderers.compiling import njit

FREE = 10
"""Number of a camera's free parameters: rotation, position, focal lengths, principal point."""
CUT = 9.0
"""Squared standard deviations beyond which a blob is not on a line."""
REDUNDANCY = 0.4
"""Weight of pairs of cameras: ten cameras give 45 distances from 20 coordinates, less three of the point."""


@njit(cache=True, error_model="numpy", heavy=True)
def epipolar_equations(xy, start, rotation, position, focal, scale, width, chance, information, gradient):
    """Fill in the normal equations of whitened parameters, and return the cost and the sum of weights.

    Args:
        xy: (M, 2) blobs of all moments, ordered by moment and camera, on the plane z = 1 without distortion.
        start: (S, C + 1) first blob of each camera.
        rotation: (C, 3, 3) cam_from_rig.
        position: (C, 3) mm.
        focal: (C, 2) px.
        scale: (C, FREE) standard deviation of each parameter.
        width: px, standard deviation of the distance of a blob from its marker's epipolar line.
        chance: weight of "no partner", relative to a partner exactly on the line.
        information: (C FREE, C FREE).
        gradient: (C FREE,).
    """
    cameras = len(focal)
    most = 0
    for s in range(len(start)):
        for c in range(cameras):
            most = max(most, start[s, c + 1] - start[s, c])
    weight, distance = np.empty((most, most)), np.empty((most, most))
    by_row, by_column = np.empty(most), np.empty(most)
    line, spread1, spread2 = np.empty((most, 3)), np.empty(most), np.empty(most)
    essential, jacobian, block = np.empty((3, 3)), np.empty(2 * FREE), np.empty((2 * FREE, 2 * FREE))
    cost, total = 0.0, 0.0
    information[:] = 0.0
    gradient[:] = 0.0
    for a in range(cameras):
        for b in range(a + 1, cameras):
            _essential_matrix(rotation[a], rotation[b], position[a], position[b], essential)
            block[:] = 0.0
            for s in range(len(start)):
                first, second = start[s, a], start[s, b]
                na, nb = start[s, a + 1] - first, start[s, b + 1] - second
                if na == 0 or nb == 0:
                    continue
                for i in range(na):
                    by_row[i] = 0.0
                    x, y = xy[first + i, 0], xy[first + i, 1]
                    for k in range(3):
                        line[i, k] = essential[0, k] * x + essential[1, k] * y + essential[2, k]
                    spread2[i] = (line[i, 0] / focal[b, 0]) ** 2 + (line[i, 1] / focal[b, 1]) ** 2
                for j in range(nb):
                    by_column[j] = 0.0
                    x, y = xy[second + j, 0], xy[second + j, 1]
                    across = essential[0, 0] * x + essential[0, 1] * y + essential[0, 2]
                    down = essential[1, 0] * x + essential[1, 1] * y + essential[1, 2]
                    spread1[j] = (across / focal[a, 0]) ** 2 + (down / focal[a, 1]) ** 2
                for i in range(na):
                    for j in range(nb):
                        weight[i, j] = 0.0
                        t = line[i, 0] * xy[second + j, 0] + line[i, 1] * xy[second + j, 1] + line[i, 2]
                        square, unit = t * t, width**2 * (spread1[j] + spread2[i])
                        if square < CUT * unit and _are_in_front(
                            xy[first + i], xy[second + j], rotation[a], rotation[b], position[a], position[b]
                        ):
                            weight[i, j] = math.exp(-0.5 * square / unit)
                            distance[i, j] = t / math.sqrt(spread1[j] + spread2[i])
                            by_row[i] += weight[i, j]
                            by_column[j] += weight[i, j]
                for i in range(na):
                    cost -= math.log(by_row[i] + chance)
                    for j in range(nb):
                        if weight[i, j] <= 0:
                            continue
                        r = weight[i, j] / (max(by_row[i], by_column[j]) + chance)
                        if r < 0.05:
                            continue
                        total += r
                        _distance_jacobian(
                            xy[first + i], xy[second + j], rotation[a], rotation[b], position[a], position[b],
                            focal[a], focal[b], jacobian,
                        )  # fmt: skip
                        for k in range(FREE):
                            jacobian[k] *= scale[a, k]
                            jacobian[FREE + k] *= scale[b, k]
                        r *= REDUNDANCY / width**2
                        for k in range(2 * FREE):
                            one = r * jacobian[k]
                            gradient[a * FREE + k if k < FREE else b * FREE + k - FREE] += one * distance[i, j]
                            for m in range(2 * FREE):
                                block[k, m] += one * jacobian[m]
            for k in range(2 * FREE):
                row = a * FREE + k if k < FREE else b * FREE + k - FREE
                for m in range(2 * FREE):
                    information[row, a * FREE + m if m < FREE else b * FREE + m - FREE] += block[k, m]
    return cost, total


@njit(cache=True, error_model="numpy", heavy=True)
def _essential_matrix(rotation1, rotation2, position1, position2, essential):
    """Fill in E: x1 E x2 = 0 for images x1, x2 (homogeneous, on the planes z = 1) of one point."""
    px, py, pz = position2[0] - position1[0], position2[1] - position1[1], position2[2] - position1[2]
    for k in range(3):
        dx, dy, dz = rotation2[k, 0], rotation2[k, 1], rotation2[k, 2]
        nx, ny, nz = dy * pz - dz * py, dz * px - dx * pz, dx * py - dy * px
        for m in range(3):
            essential[m, k] = rotation1[m, 0] * nx + rotation1[m, 1] * ny + rotation1[m, 2] * nz


@njit(cache=True, error_model="numpy", heavy=True)
def _ray(rotation, blob):
    """Direction of a blob in the rig's frame."""
    return (
        rotation[0, 0] * blob[0] + rotation[1, 0] * blob[1] + rotation[2, 0],
        rotation[0, 1] * blob[0] + rotation[1, 1] * blob[1] + rotation[2, 1],
        rotation[0, 2] * blob[0] + rotation[1, 2] * blob[1] + rotation[2, 2],
    )


@njit(cache=True, error_model="numpy", heavy=True)
def _are_in_front(one, two, rotation1, rotation2, position1, position2):
    """Tell whether two rays are nearest to each other in front of both cameras."""
    ax, ay, az = _ray(rotation1, one)
    bx, by, bz = _ray(rotation2, two)
    px, py, pz = position2[0] - position1[0], position2[1] - position1[1], position2[2] - position1[2]
    aa, bb, ab = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz, ax * bx + ay * by + az * bz
    pa, pb = px * ax + py * ay + pz * az, px * bx + py * by + pz * bz
    return pa * bb - pb * ab > 0 and pa * ab - pb * aa > 0


@njit(cache=True, error_model="numpy", heavy=True)
def _distance_jacobian(one, two, rotation1, rotation2, position1, position2, focal1, focal2, jacobian):
    """Fill in the derivatives of the distance (px) of two blobs from showing one point (Sampson's)."""
    x1, y1, x2, y2 = one[0], one[1], two[0], two[1]
    ax, ay, az = _ray(rotation1, one)
    bx, by, bz = _ray(rotation2, two)
    px, py, pz = position2[0] - position1[0], position2[1] - position1[1], position2[2] - position1[2]
    # normals: n1 = d2 x b, n2 = b x d1
    n1x, n1y, n1z = by * pz - bz * py, bz * px - bx * pz, bx * py - by * px
    n2x, n2y, n2z = py * az - pz * ay, pz * ax - px * az, px * ay - py * ax
    q10 = rotation1[0, 0] * n1x + rotation1[0, 1] * n1y + rotation1[0, 2] * n1z
    q11 = rotation1[1, 0] * n1x + rotation1[1, 1] * n1y + rotation1[1, 2] * n1z
    q12 = rotation1[2, 0] * n1x + rotation1[2, 1] * n1y + rotation1[2, 2] * n1z
    q20 = rotation2[0, 0] * n2x + rotation2[0, 1] * n2y + rotation2[0, 2] * n2z
    q21 = rotation2[1, 0] * n2x + rotation2[1, 1] * n2y + rotation2[1, 2] * n2z
    q22 = rotation2[2, 0] * n2x + rotation2[2, 1] * n2y + rotation2[2, 2] * n2z
    own = (q10 / focal1[0]) ** 2 + (q11 / focal1[1]) ** 2
    spread = math.sqrt(own + (q20 / focal2[0]) ** 2 + (q21 / focal2[1]) ** 2)
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx  # d1 x d2
    # rotations: -(m x q)
    jacobian[0], jacobian[1], jacobian[2] = q11 - y1 * q12, x1 * q12 - q10, y1 * q10 - x1 * q11
    jacobian[3], jacobian[4], jacobian[5] = -cx, -cy, -cz
    jacobian[6], jacobian[7] = -q10 * x1 / focal1[0], -q11 * y1 / focal1[1]
    jacobian[8], jacobian[9] = -q10 / focal1[0], -q11 / focal1[1]
    jacobian[10], jacobian[11], jacobian[12] = q21 - y2 * q22, x2 * q22 - q20, y2 * q20 - x2 * q21
    jacobian[13], jacobian[14], jacobian[15] = cx, cy, cz
    jacobian[16], jacobian[17] = -q20 * x2 / focal2[0], -q21 * y2 / focal2[1]
    jacobian[18], jacobian[19] = -q20 / focal2[0], -q21 / focal2[1]
    for k in range(2 * FREE):
        jacobian[k] /= spread


@njit(cache=True, error_model="numpy", heavy=True)
def image_equations(
    uv, start, point, point_start, rotation, position, focal, scale, width, chance, information, gradient
):
    """Fill in the normal equations of one camera's whitened parameters; return the sum of weights.

    Args:
        uv: (M, 2) px, its blobs ordered by moment, from the principal point and without distortion.
        start: (S + 1,) first blob of each moment.
        point: (P, 3) mm, markers that other cameras see, ordered by moment.
        point_start: (S + 1,) first marker of each moment.
        rotation: (3, 3) cam_from_rig.
        position: (3,) mm.
        focal: (2,) px.
        scale: (FREE,) standard deviation of each parameter.
        width: px, standard deviation of the distance of a blob from its marker's image.
        chance: weight of "no partner", relative to a partner exactly in place.
        information: (FREE, FREE).
        gradient: (FREE,).
    """
    information[:] = 0.0
    gradient[:] = 0.0
    total, most, most_points = 0.0, 0, 0
    for s in range(len(start) - 1):
        most = max(most, start[s + 1] - start[s])
        most_points = max(most_points, point_start[s + 1] - point_start[s])
    weight = np.empty((most_points, most))
    by_row, by_column = np.empty(most_points), np.empty(most)
    across, down = np.empty(FREE), np.empty(FREE)
    for s in range(len(start) - 1):
        for j in range(start[s + 1] - start[s]):
            by_column[j] = 0.0
        for i in range(point_start[s + 1] - point_start[s]):
            by_row[i] = 0.0
            x, y, _ = _camera_point(rotation, position, point[point_start[s] + i])
            for j in range(start[s + 1] - start[s]):
                blob = start[s] + j
                square = ((x * focal[0] - uv[blob, 0]) ** 2 + (y * focal[1] - uv[blob, 1]) ** 2) / width**2
                weight[i, j] = math.exp(-0.5 * square) if square < CUT else 0.0
                by_row[i] += weight[i, j]
                by_column[j] += weight[i, j]
        for i in range(point_start[s + 1] - point_start[s]):
            x, y, z = _camera_point(rotation, position, point[point_start[s] + i])
            for j in range(start[s + 1] - start[s]):
                r = weight[i, j] / (max(by_row[i], by_column[j]) + chance)
                if r < 0.02:
                    continue
                total += r
                blob = start[s] + j
                eu, ev = x * focal[0] - uv[blob, 0], y * focal[1] - uv[blob, 1]
                fx, fy = focal[0], focal[1]
                across[0], across[1], across[2] = -fx * x * y, fx * (1 + x * x), -fx * y
                down[0], down[1], down[2] = -fy * (1 + y * y), fy * x * y, fy * x
                for k in range(3):
                    across[3 + k] = -fx / z * (rotation[0, k] - x * rotation[2, k])
                    down[3 + k] = -fy / z * (rotation[1, k] - y * rotation[2, k])
                across[6], across[7], across[8], across[9] = x, 0.0, 1.0, 0.0
                down[6], down[7], down[8], down[9] = 0.0, y, 0.0, 1.0
                for k in range(FREE):
                    across[k] *= scale[k]
                    down[k] *= scale[k]
                r /= width**2
                for k in range(FREE):
                    gradient[k] += r * (across[k] * eu + down[k] * ev)
                    for m in range(FREE):
                        information[k, m] += r * (across[k] * across[m] + down[k] * down[m])
    return total


@njit(cache=True, error_model="numpy", heavy=True)
def _camera_point(rotation, position, point):
    """A point on the plane z = 1 of a camera, and its depth, at least 1 mm."""
    x, y, z = point[0] - position[0], point[1] - position[1], point[2] - position[2]
    depth = max(rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z, 1.0)
    across = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    return across / depth, down / depth, depth
