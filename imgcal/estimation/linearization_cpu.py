"""Residuals and normal equations on CPUs: `linearization.py` compiled to one loop per rig, without temporaries.

There are three tuples of arrays. `given` holds the object's points and their squared radii, the lenses' models, the
observations and the square roots of their weights, the factory rig, its prior, and that of the object. `state` holds
the unknowns and `blocks` the normal equations, laid out as in `levenberg_marquardt_cpu._Blocks`. Products are summed
for each camera and snapshot before they are written. The object's own parameters come last among the coupled ones, and
have their own border. With several objects, the points have a fourth column, the number of the object; each row shows
one object.

A shaking camera shifts all its observations of a snapshot by the same unknown amount. The most probable shift is
subtracted from the residuals, and the shift is eliminated from the normal equations (Schur complement).
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import NEAREST_DEPTH, kernels, lens_kernels
from renderers.compiling import njit

SHIFTS = 50
"""Most iterations of reweighting for a shift."""


@njit(cache=True, fastmath=kernels.FAST)
def given_values(given, b):
    """Select the inputs of one rig; the points and their radii are shared by all."""
    (
        points, radius_squared, lenses, uv, root_weight,
        rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    ) = given  # fmt: skip
    return (
        points, radius_squared, lenses, uv[b], root_weight[b],
        rotation0[b], position0[b], focal0[b], principal0[b], distortion0[b], prior_std[b], own_std[b],
    )  # fmt: skip


@njit(cache=True, fastmath=kernels.FAST)
def select_state(state, b):
    """Select one row of a state."""
    offset, rotation, centre, own_offset = state
    return offset[b], rotation[b], centre[b], own_offset[b]


@njit(cache=True, fastmath=kernels.FAST)
def select_blocks(blocks, b):
    """Select one row of normal equations."""
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual = blocks
    return (
        camera[b], coupling[b], pose[b], border[b], camera_gradient[b], pose_gradient[b], own_gradient[b], residual[b],
    )  # fmt: skip


@njit(cache=True, fastmath=kernels.FAST)
def linearize_rig(given, state, blocks, cameras_first, loss, threshold, shake):
    """Fill the blocks of the normal equations and return the cost.

    `shake`: (S, C) pixels, standard deviation of a shift that all points of a camera share in a snapshot; empty = no
    shake. Only for equations in which poses are eliminated first.
    """
    (
        points, radius_squared, lenses, uv, root_weight,
        rotation0, position0, focal0, principal0, distortion0, prior_std, own_std,
    ) = given  # fmt: skip
    offset, rotation, centre, own_offset = state
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual = blocks
    snapshots, cameras, fiducials = root_weight.shape
    kind, free = uv.dtype, 10 + lens_kernels.width_of(lenses, distortion0)
    wide = free + 6
    turns = np.empty((3, 3), dtype=kind)
    several = points.shape[1] > 3
    lacking = 0 if several else kernels.fill_free_turns(points, turns)
    for s in range(snapshots):
        for i in range(6):
            pose_gradient[s, i] = 0
            for j in range(6):
                pose[s, i, j] = 0
        if several:
            lacking = _fill_turns_of_row(points, root_weight[s], turns)
        if lacking:
            _fix_turns(rotation[s], turns, pose[s])
    rows = np.zeros((2, wide), dtype=kind)
    products = np.empty((wide, wide), dtype=kind)
    gradient = np.empty(wide, dtype=kind)
    turned, left, rotation_cam = (
        np.empty((3, 3), dtype=kind),
        np.empty((3, 3), dtype=kind),
        np.empty((3, 3), dtype=kind),
    )
    parameters = np.empty(free, dtype=kind)
    coefficients = np.empty(free - 10, dtype=kind)
    rotated, point = np.empty(3, dtype=kind), np.empty(3, dtype=kind)
    derivative, back = np.empty((2, 3), dtype=kind), np.empty(3, dtype=kind)
    bent, scale = len(own_std) > 0, 1.0
    rows_own = np.empty((2, 4), dtype=kind)
    shift, shared, shared_own = np.zeros(2, dtype=kind), np.empty((2, wide), dtype=kind), np.empty((2, len(own_std)))
    cost = 0.0
    if bent:
        cost = _start_object(own_offset, coupling, border, own_gradient)
        scale += own_offset[-1] * own_std[-1]
    for c in range(cameras):
        for i in range(free):
            parameters[i] = offset[c, i] * prior_std[c, i]
            cost += 0.5 * offset[c, i] ** 2
            camera_gradient[c, i] = offset[c, i]
            for j in range(free):
                camera[c, i, j] = 1.0 if i == j else 0.0
        kernels.exponential(parameters, turned, left)
        kernels.multiply(turned, rotation0[c], rotation_cam)
        fx, fy = focal0[c, 0] + parameters[6], focal0[c, 1] + parameters[7]
        cx, cy = principal0[c, 0] + parameters[8], principal0[c, 1] + parameters[9]
        for i in range(free - 10):
            coefficients[i] = distortion0[c, i] + parameters[10 + i]
        for s in range(snapshots):
            for i in range(wide):
                gradient[i] = 0
                for j in range(i + 1):
                    products[i, j] = 0
            unit = max(1.0, np.sqrt(centre[s, 0] ** 2 + centre[s, 1] ** 2 + centre[s, 2] ** 2))
            shaken, total = len(shake) > 0 and shake[s, c] > 0, 0.0
            if shaken:
                camera_at = (rotation_cam, position0[c], parameters, coefficients, (fx, fy, cx, cy))
                _project(given, state, c, s, scale, camera_at, residual[s, c])
                cost += take_shift(residual[s, c], root_weight[s, c], shake[s, c], loss, threshold, shift)
                shared[:] = 0
                shared_own[:] = 0
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

                per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy = lens_kernels.image_of(
                    lenses, c, point[0], point[1], depth, radius_squared[n], coefficients
                )
                ru, rv = fx * xd + cx - uv[s, c, 0, n], fy * yd + cy - uv[s, c, 1, n]
                residual[s, c, 0, n], residual[s, c, 1, n] = ru, rv
                if weight == 0:
                    continue
                if shaken:
                    ru, rv = ru - shift[0], rv - shift[1]
                value, slope = loss_and_slope((ru * ru + rv * rv) * weight * weight, loss, threshold)
                cost += 0.5 * value
                weight *= np.sqrt(slope)
                fx_w, fy_w = fx * weight, fy * weight
                write_derivative((per_depth, log_slope, x, y, jxx, jxy, jyy), fx_w, fy_w, derivative)

                for r in range(2):
                    d0, d1, d2 = derivative[r, 0], derivative[r, 1], derivative[r, 2]
                    t0 = point[1] * d2 - point[2] * d1
                    t1 = point[2] * d0 - point[0] * d2
                    t2 = point[0] * d1 - point[1] * d0
                    for i in range(3):
                        rows[r, i] = left[0, i] * t0 + left[1, i] * t1 + left[2, i] * t2
                        back[i] = rotation_cam[0, i] * d0 + rotation_cam[1, i] * d1 + rotation_cam[2, i] * d2
                        rows[r, 3 + i] = -back[i]
                        rows[r, free + 3 + i] = back[i] * unit
                    rows[r, free] = rotated[1] * back[2] - rotated[2] * back[1]
                    rows[r, free + 1] = rotated[2] * back[0] - rotated[0] * back[2]
                    rows[r, free + 2] = rotated[0] * back[1] - rotated[1] * back[0]
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
                lens_kernels.by_coefficients(lenses, c, x, y, rr, coefficients, fx_w, fy_w, 10, rows)
                for i in range(free):
                    rows[0, i] *= prior_std[c, i]
                    rows[1, i] *= prior_std[c, i]
                ru, rv = ru * weight, rv * weight
                if bent:
                    _add_object(rows, rows_own, ru, rv, c, s, n, coupling, border, own_gradient, cameras_first)
                if shaken:
                    total += weight * weight
                    _add_shared(rows, rows_own, weight, n, shared, shared_own)
                for i in range(wide):
                    gradient[i] += rows[0, i] * ru + rows[1, i] * rv
                    for j in range(i + 1):
                        products[i, j] += rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j]
            if shaken:
                share = 1 / (1 / shake[s, c] ** 2 + total)
                for i in range(wide):
                    for j in range(i + 1):
                        products[i, j] -= share * (shared[0, i] * shared[0, j] + shared[1, i] * shared[1, j])
                if bent:
                    _subtract_object(share, shared, shared_own, c, s, coupling, border)
            _distribute(
                products, gradient, c, s, free, camera, coupling, pose, camera_gradient, pose_gradient, cameras_first
            )
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _fill_turns_of_row(points, root_weight, turns):
    """Do the work of `fill_free_turns` for the object that a row shows according to its weights (C, N)."""
    cameras, fiducials = root_weight.shape
    shown = 0
    for n in range(fiducials - 1, -1, -1):
        for c in range(cameras):
            if root_weight[c, n] > 0:
                shown = n
    first, last = shown, shown
    while first > 0 and points[first - 1, 3] == points[shown, 3]:
        first -= 1
    while last + 1 < fiducials and points[last + 1, 3] == points[shown, 3]:
        last += 1
    return kernels.fill_free_turns(points[first : last + 1], turns)


@njit(cache=True, fastmath=kernels.FAST)
def _fix_turns(rotation, turns, pose):
    """Add unit information to `pose` (6, 6) for rotations that move no fiducial, as `linearization.linearize` does."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    pose[i, j] += rotation[i, k] * turns[k, m] * rotation[j, m]


@njit(cache=True, fastmath=kernels.FAST)
def _start_object(own_offset, coupling, border, own_gradient):
    """Reset the object's part of the blocks to its prior, and return the prior's cost."""
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
def _add_object(rows, rows_own, ru, rv, c, s, n, coupling, border, own_gradient, cameras_first):
    """Add the information of one observation about its fiducial's coordinates and the object's scale."""
    size, wide = border.shape
    first, last, free = wide - size, size - 1, rows.shape[1] - 6
    for k in range(4):
        own = 3 * n + k if k < 3 else last
        mine_u, mine_v = rows_own[0, k], rows_own[1, k]
        own_gradient[own] += mine_u * ru + mine_v * rv
        for i in range(free):
            product = rows[0, i] * mine_u + rows[1, i] * mine_v
            if cameras_first:
                coupling[c, i, first + own] += product
            else:
                border[own, free * c + i] += product
        for i in range(6):
            product = rows[0, free + i] * mine_u + rows[1, free + i] * mine_v
            if cameras_first:
                border[own, 6 * s + i] += product
            else:
                coupling[s, i, first + own] += product
        for j in range(k + 1):
            other = 3 * n + j if j < 3 else last
            border[own, first + other] += rows_own[0, j] * mine_u + rows_own[1, j] * mine_v


@njit(cache=True, fastmath=kernels.FAST)
def _project(given, state, c, s, scale, camera_at, residual):
    """Write the residuals of a camera in a snapshot, predicted minus observed: (2, N) pixels."""
    points, radius_squared, lenses, uv, _, _, _, _, _, _, _, own_std = given
    _, rotation, centre, own_offset = state
    rotation_cam, position, parameters, coefficients, (fx, fy, cx, cy) = camera_at
    at, point = np.empty(3), np.empty(3)
    for n in range(residual.shape[1]):
        for i in range(3):
            at[i] = points[n, i]
            if len(own_std):
                at[i] = scale * at[i] + own_offset[3 * n + i] * own_std[3 * n + i]
        for i in range(3):
            point[i] = rotation[s, i, 0] * at[0] + rotation[s, i, 1] * at[1] + rotation[s, i, 2] * at[2]
            point[i] += centre[s, i] - position[i] - parameters[3 + i]
        x, y, z = point[0], point[1], point[2]
        for i in range(3):
            point[i] = rotation_cam[i, 0] * x + rotation_cam[i, 1] * y + rotation_cam[i, 2] * z
        image = lens_kernels.image_of(
            lenses, c, point[0], point[1], max(point[2], NEAREST_DEPTH), radius_squared[n], coefficients
        )
        residual[0, n], residual[1, n] = fx * image[5] + cx - uv[s, c, 0, n], fy * image[6] + cy - uv[s, c, 1, n]


@njit(cache=True, fastmath=kernels.FAST)
def take_shift(residual, root_weight, shake, loss, threshold, shift):
    """Write the most probable shift of a camera's image (2,), and return its prior cost."""
    shift[:] = 0
    for _ in range(SHIFTS):
        total, u, v = 1 / shake**2, 0.0, 0.0
        for n in range(len(root_weight)):
            weight = root_weight[n] ** 2
            if weight == 0:
                continue
            du, dv = residual[0, n] - shift[0], residual[1, n] - shift[1]
            _, slope = loss_and_slope((du * du + dv * dv) * weight, loss, threshold)
            total += weight * slope
            u += weight * slope * residual[0, n]
            v += weight * slope * residual[1, n]
        u, v = u / total, v / total
        near = abs(u - shift[0]) + abs(v - shift[1]) < 1e-9
        shift[0], shift[1] = u, v
        if near:
            break
    return 0.5 * (shift[0] ** 2 + shift[1] ** 2) / shake**2


@njit(cache=True, fastmath=kernels.FAST)
def _add_shared(rows, rows_own, weight, n, shared, shared_own):
    """Add the derivatives of one observation to those of the common shift."""
    size = shared_own.shape[1]
    for r in range(2):
        for i in range(shared.shape[1]):
            shared[r, i] += weight * rows[r, i]
        if size:
            for k in range(3):
                shared_own[r, 3 * n + k] += weight * rows_own[r, k]
            shared_own[r, size - 1] += weight * rows_own[r, 3]


@njit(cache=True, fastmath=kernels.FAST)
def _subtract_object(share, shared, shared_own, c, s, coupling, border):
    """Eliminate a common shift from the object's part of the blocks; for poses that are eliminated first."""
    size, wide = border.shape
    first, free = wide - size, shared.shape[1] - 6
    for own in range(size):
        mine_u, mine_v = share * shared_own[0, own], share * shared_own[1, own]
        for i in range(free):
            border[own, free * c + i] -= shared[0, i] * mine_u + shared[1, i] * mine_v
        for i in range(6):
            coupling[s, i, first + own] -= shared[0, free + i] * mine_u + shared[1, free + i] * mine_v
        for other in range(own + 1):
            border[own, first + other] -= shared_own[0, other] * mine_u + shared_own[1, other] * mine_v


@njit(cache=True, fastmath=kernels.FAST)
def _distribute(products, gradient, c, s, free, camera, coupling, pose, camera_gradient, pose_gradient, cameras_first):
    """Add the lower triangle of one camera's products with one snapshot to the blocks."""
    for i in range(free):
        camera_gradient[c, i] += gradient[i]
        for j in range(i + 1):
            camera[c, i, j] += products[i, j]
            camera[c, j, i] = camera[c, i, j]
    for i in range(6):
        pose_gradient[s, i] += gradient[free + i]
        for j in range(i + 1):
            pose[s, i, j] += products[free + i, free + j]
            pose[s, j, i] = pose[s, i, j]
        for j in range(free):
            if cameras_first:
                coupling[c, j, 6 * s + i] = products[free + i, j]
            else:
                coupling[s, i, free * c + j] = products[free + i, j]


@njit(cache=True, fastmath=kernels.FAST)
def write_derivative(image, fx, fy, derivative):
    """Write the derivative (2, 3) of a pixel by its point in the camera, from parts of `lens_kernels.image_of`."""
    per_depth, log_slope, x, y, jxx, jxy, jyy = image
    derivative[0, 0], derivative[0, 1] = fx * per_depth * jxx, fx * per_depth * jxy
    derivative[0, 2] = fx * log_slope * (jxx * x + jxy * y)
    derivative[1, 0], derivative[1, 1] = fy * per_depth * jxy, fy * per_depth * jyy
    derivative[1, 2] = fy * log_slope * (jxy * x + jyy * y)


@njit(cache=True, fastmath=kernels.FAST)
def loss_and_slope(squared, loss, threshold):
    """Robust loss and its slope, like `robust_losses.LOSSES`."""
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


@njit(cache=True, fastmath=kernels.FAST)
def move(state, camera_step, pose_step, own_step, new):
    """Write the state plus a step to `new`, like `linearization.retract`."""
    offset, rotation, centre, own_offset = state
    new_offset, new_rotation, new_centre, new_own_offset = new
    for i in range(len(own_offset)):
        new_own_offset[i] = own_offset[i] + own_step[i]
    for c in range(len(offset)):
        for i in range(offset.shape[1]):
            new_offset[c, i] = offset[c, i] + camera_step[c, i]
    turned, left = np.empty((3, 3), dtype=offset.dtype), np.empty((3, 3), dtype=offset.dtype)
    for s in range(len(centre)):
        unit = max(1.0, np.sqrt(centre[s, 0] ** 2 + centre[s, 1] ** 2 + centre[s, 2] ** 2))
        for i in range(3):
            new_centre[s, i] = centre[s, i] + pose_step[s, 3 + i] * unit
        kernels.exponential(pose_step[s], turned, left)
        kernels.multiply(turned, rotation[s], new_rotation[s])


@njit(cache=True, fastmath=kernels.FAST)
def turn_all(parameters, rotation0, translation0, rotation, translation):
    """Write cam_from_rig after steps of its rotation and position: with c = -R0' t0 + dc, t = -R c = E (t0 - R0 dc)."""
    turned, left = np.empty((3, 3), dtype=parameters.dtype), np.empty((3, 3), dtype=parameters.dtype)
    for b in range(parameters.shape[0]):
        for c in range(parameters.shape[1]):
            step = parameters[b, c]
            kernels.exponential(step, turned, left)
            kernels.multiply(turned, rotation0[b, c], rotation[b, c])
            for i in range(3):
                value = 0.0
                for j in range(3):
                    value += turned[i, j] * translation0[b, c, j] - rotation[b, c, i, j] * step[3 + j]
                translation[b, c, i] = value
