"""Residuals and normal equations of one snapshot of independent lights, compiled.

Like `linearization_cpu.linearize_rig` for a rigid object, but with a position (3) per light instead of one pose (6).
Cameras are linearized at their current values (zero offset). A shaking camera shifts all its lights by the same unknown
amount. This shift is marginalized, which couples the lights' positions.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.estimation.linearization_cpu import loss_and_slope, take_shift, write_derivative
from imgcal.geometry import NEAREST_DEPTH, kernels, lens_kernels
from renderers.compiling import njit


@njit(cache=True, fastmath=kernels.FAST)
def linearize_lights(given, places, blocks, loss, threshold, shake):
    """Fill the blocks of the normal equations and return the cost.

    Args:
        given: squared radii (N,) of the lights, the lenses' models, pixels (C, 2, N) and the square roots of their
            weights (C, N), rotation, position, focal length, principal point and distortion of the cameras, and the
            units (C, K) of their errors.
        places: (N, 3) mm.
        blocks: outputs for this snapshot: information of each camera (C, K, K) with one added to its diagonal, coupling
            (3 N, D), information of the positions (3 N, 3 N), one on the diagonal for a hidden light; gradients
            (C, K) and (3 N,), residuals (C, 2, N).
        loss: code of the robust loss.
        threshold: threshold of the robust loss.
        shake: (C,) pixels, standard deviation of each camera's shake; empty = no camera shakes.
    """
    radius_squared, lenses, uv, root_weight, rotation, position, focal, principal, distortion, unit = given
    camera, coupling, pose, camera_gradient, pose_gradient, residual = blocks
    cameras, lights = root_weight.shape
    free, size = unit.shape[1], 3 * lights
    pose_gradient[:size] = 0.0
    pose[:size, :size] = 0.0
    coupling[:size] = 0.0
    camera_gradient[:] = 0.0
    for n in range(lights):
        total = 0.0
        for c in range(cameras):
            total += root_weight[c, n]
        if total == 0:
            for i in range(3):
                pose[3 * n + i, 3 * n + i] = 1.0
    rows = np.zeros((2, free))
    by_place, point = np.empty((2, 3)), np.empty(3)
    derivative, coefficients = np.empty((2, 3)), np.empty(free - 10)
    shift, shared, shared_place = np.zeros(2), np.empty((2, free)), np.empty((2, size))
    cost = 0.0
    for c in range(cameras):
        for i in range(free):
            for j in range(free):
                camera[c, i, j] = 1.0 if i == j else 0.0
        some = 0.0
        for n in range(lights):
            some += root_weight[c, n]
        if some == 0:
            residual[c] = 0.0
            continue
        for i in range(free - 10):
            coefficients[i] = distortion[c, i]
        fx, fy, cx, cy = focal[c, 0], focal[c, 1], principal[c, 0], principal[c, 1]
        shaken, total = len(shake) > 0 and shake[c] > 0, 0.0
        if shaken:
            for n in range(lights):
                _to_camera(rotation[c], position[c], places[n], point)
                image = lens_kernels.image_of(
                    lenses, c, point[0], point[1], max(point[2], NEAREST_DEPTH), radius_squared[n], coefficients
                )
                residual[c, 0, n], residual[c, 1, n] = (
                    fx * image[5] + cx - uv[c, 0, n],
                    fy * image[6] + cy - uv[c, 1, n],
                )
            cost += take_shift(residual[c], root_weight[c], shake[c], loss, threshold, shift)
            shared[:] = 0.0
            shared_place[:] = 0.0
        for n in range(lights):
            weight = root_weight[c, n]
            if weight == 0:
                residual[c, 0, n], residual[c, 1, n] = 0.0, 0.0
                continue
            _to_camera(rotation[c], position[c], places[n], point)
            if point[2] <= NEAREST_DEPTH:
                cost = np.inf
            depth = max(point[2], NEAREST_DEPTH)
            per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy = lens_kernels.image_of(
                lenses, c, point[0], point[1], depth, radius_squared[n], coefficients
            )
            ru, rv = fx * xd + cx - uv[c, 0, n], fy * yd + cy - uv[c, 1, n]
            residual[c, 0, n], residual[c, 1, n] = ru, rv
            if shaken:
                ru, rv = ru - shift[0], rv - shift[1]
            value, slope = loss_and_slope((ru * ru + rv * rv) * weight * weight, loss, threshold)
            cost += 0.5 * value
            weight *= np.sqrt(slope)
            fx_w, fy_w = fx * weight, fy * weight
            write_derivative((per_depth, log_slope, x, y, jxx, jxy, jyy), fx_w, fy_w, derivative)
            away = max(1.0, np.sqrt(places[n, 0] ** 2 + places[n, 1] ** 2 + places[n, 2] ** 2))
            for r in range(2):
                d0, d1, d2 = derivative[r, 0], derivative[r, 1], derivative[r, 2]
                rows[r, 0] = point[1] * d2 - point[2] * d1
                rows[r, 1] = point[2] * d0 - point[0] * d2
                rows[r, 2] = point[0] * d1 - point[1] * d0
                for i in range(3):
                    back = rotation[c, 0, i] * d0 + rotation[c, 1, i] * d1 + rotation[c, 2, i] * d2
                    rows[r, 3 + i] = -back
                    by_place[r, i] = back * away
                for i in range(4):
                    rows[r, 6 + i] = 0.0
            rows[0, 6], rows[1, 7] = xd * weight, yd * weight
            rows[0, 8], rows[1, 9] = weight, weight
            lens_kernels.by_coefficients(lenses, c, x, y, rr, coefficients, fx_w, fy_w, 10, rows)
            for i in range(free):
                rows[0, i] *= unit[c, i]
                rows[1, i] *= unit[c, i]
            ru, rv = ru * weight, rv * weight
            for i in range(free):
                camera_gradient[c, i] += rows[0, i] * ru + rows[1, i] * rv
                for j in range(i + 1):
                    camera[c, i, j] += rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j]
            for i in range(3):
                at = 3 * n + i
                pose_gradient[at] += by_place[0, i] * ru + by_place[1, i] * rv
                for j in range(i + 1):
                    pose[at, 3 * n + j] += by_place[0, i] * by_place[0, j] + by_place[1, i] * by_place[1, j]
                for j in range(free):
                    coupling[at, free * c + j] = by_place[0, i] * rows[0, j] + by_place[1, i] * rows[1, j]
            if shaken:
                total += weight * weight
                for r in range(2):
                    for i in range(free):
                        shared[r, i] += weight * rows[r, i]
                    for i in range(3):
                        shared_place[r, 3 * n + i] = weight * by_place[r, i]
        if shaken:
            share = 1 / (1 / shake[c] ** 2 + total)
            for i in range(free):
                for j in range(i + 1):
                    camera[c, i, j] -= share * (shared[0, i] * shared[0, j] + shared[1, i] * shared[1, j])
            for i in range(size):
                along, down = share * shared_place[0, i], share * shared_place[1, i]
                for j in range(i + 1):
                    pose[i, j] -= along * shared_place[0, j] + down * shared_place[1, j]
                for j in range(free):
                    coupling[i, free * c + j] -= along * shared[0, j] + down * shared[1, j]
        for i in range(free):
            for j in range(i):
                camera[c, j, i] = camera[c, i, j]
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _to_camera(rotation, position, place, point):
    """Transform a point (3,) from the rig's frame to a camera's frame."""
    for i in range(3):
        point[i] = 0.0
        for j in range(3):
            point[i] += rotation[i, j] * (place[j] - position[j])
