"""Residuals and normal equations on CPUs: `linearization.py` compiled to one loop per rig, without temporaries.

There are three tuples of arrays. `given` holds the object's points and their squared radii, the lenses' models, the
observations and the square roots of their weights, the factory rig, its prior, and that of the object. `state` holds
the unknowns and `blocks` the normal equations, laid out as in `levenberg_marquardt_cpu._Blocks`. The object's own
parameters come last among the coupled ones, and have their own border. With several objects, the points have a fourth
column, the number of the object; each row shows one object.

A step of a camera's pose, or of the object's, moves the object in the camera's frame, for all its points alike: it
turns about its centre and shifts. So derivatives are taken with respect to these six motions and the lens, and their
products are summed over the points; only the sums of a camera and a snapshot are expressed by the poses' steps.

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
TILE = 16
"""Products are summed in rows of a multiple of this many columns, of which the compiler makes vector instructions."""
AT_ONCE = 4
"""Points whose products are summed at a time; `_add_products` is written for four."""


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
    free = 10 + lens_kernels.width_of(lenses, distortion0)
    turns = np.empty((3, 3))
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
    width = TILE * ((10 + distortion0.shape[1]) // TILE + 1)
    batch, products, information = np.zeros((AT_ONCE, 2, width)), np.empty((width, width)), np.empty((free, free))
    motions, mixed, posed = np.zeros((6, TILE)), np.empty((width, TILE)), np.empty((12, TILE))  # 12 columns are used
    turned, left = np.empty((3, 3)), np.empty((3, 3))
    rotation_cam, rotation_object = np.empty((3, 3)), np.empty((3, 3))  # of the rig and of the object, to the camera
    parameters, coefficients = np.empty(free), np.empty(free - 10)
    at, centre_cam, arm, point = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    derivative = np.empty((2, 3))
    bent, scale = len(own_std) > 0, 1.0
    full, rows_own = np.empty((2, free + 6)), np.empty((2, 4))
    shift, shared, shared_own = np.zeros(2), np.empty((2, width)), np.empty((2, len(own_std)))
    cost = 0.0
    if bent:
        cost = _start_object(own_offset, coupling, border, own_gradient)
        scale += own_offset[-1] * own_std[-1]
    for c in range(cameras):
        for i in range(free):
            parameters[i] = offset[c, i] * prior_std[c, i]
            cost += 0.5 * offset[c, i] ** 2
            camera_gradient[c, i] = 0
            for j in range(i + 1):
                information[i, j] = 0
        kernels.exponential(parameters, turned, left)
        kernels.multiply(turned, rotation0[c], rotation_cam)
        fx, fy = focal0[c, 0] + parameters[6], focal0[c, 1] + parameters[7]
        cx, cy = principal0[c, 0] + parameters[8], principal0[c, 1] + parameters[9]
        for i in range(free - 10):
            coefficients[i] = distortion0[c, i] + parameters[10 + i]
        for s in range(snapshots):
            for i in range(free + 1):
                for j in range(width):
                    products[i, j] = 0
            kernels.multiply(rotation_cam, rotation[s], rotation_object)
            for i in range(3):
                at[i] = centre[s, i] - position0[c, i] - parameters[3 + i]
            for i in range(3):
                centre_cam[i] = rotation_cam[i, 0] * at[0] + rotation_cam[i, 1] * at[1] + rotation_cam[i, 2] * at[2]
            unit = max(1.0, np.sqrt(centre[s, 0] ** 2 + centre[s, 1] ** 2 + centre[s, 2] ** 2))
            _write_motions(rotation_cam, left, centre_cam, unit, motions)
            shaken, total, count = len(shake) > 0 and shake[s, c] > 0, 0.0, 0
            if shaken:
                camera_at = (rotation_object, centre_cam, coefficients, (fx, fy, cx, cy))
                _project(given, own_offset, c, s, scale, camera_at, residual[s, c])
                cost += take_shift(residual[s, c], root_weight[s, c], shake[s, c], loss, threshold, shift)
                shared[:] = 0
                shared_own[:] = 0
            for n in range(fiducials):
                for i in range(3):
                    at[i] = points[n, i]
                    if bent:
                        at[i] = scale * at[i] + own_offset[3 * n + i] * own_std[3 * n + i]
                for i in range(3):
                    turn = rotation_object[i]
                    arm[i] = turn[0] * at[0] + turn[1] * at[1] + turn[2] * at[2]
                    point[i] = arm[i] + centre_cam[i]
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
                rows = batch[count % AT_ONCE]
                count += 1
                if shaken:
                    ru, rv = ru - shift[0], rv - shift[1]
                value, slope = loss_and_slope((ru * ru + rv * rv) * weight * weight, loss, threshold)
                cost += 0.5 * value
                if slope != 1.0:
                    weight *= np.sqrt(slope)
                fx_w, fy_w = fx * weight, fy * weight
                write_derivative((per_depth, log_slope, x, y, jxx, jxy, jyy), fx_w, fy_w, derivative)
                for r in range(2):
                    d0, d1, d2 = derivative[r, 0], derivative[r, 1], derivative[r, 2]
                    rows[r, 0] = arm[1] * d2 - arm[2] * d1
                    rows[r, 1] = arm[2] * d0 - arm[0] * d2
                    rows[r, 2] = arm[0] * d1 - arm[1] * d0
                    rows[r, 3], rows[r, 4], rows[r, 5] = d0, d1, d2
                rows[0, 6], rows[1, 7] = xd * weight, yd * weight
                rows[0, 8], rows[1, 9] = weight, weight
                lens_kernels.by_coefficients(lenses, c, x, y, rr, coefficients, fx_w, fy_w, 10, rows)
                rows[0, free], rows[1, free] = ru * weight, rv * weight
                if bent:
                    _write_own(points[n], rotation_object, derivative, own_std, n, rows_own)
                    _express_rows(rows, motions, prior_std[c], full)
                    residuals = (rows[0, free], rows[1, free])
                    _add_object(full, rows_own, residuals, c, s, n, coupling, border, own_gradient, cameras_first)
                if shaken:
                    total += weight * weight
                    _add_shared(rows, rows_own, weight, n, shared, shared_own)
                if count % AT_ONCE == 0:
                    _add_products(batch, free + 1, products)
            if count == 0:
                _clear_coupling(c, s, free, coupling, cameras_first)
                continue
            if count % AT_ONCE:
                for k in range(count % AT_ONCE, AT_ONCE):
                    for i in range(free + 1):
                        batch[k, 0, i], batch[k, 1, i] = 0.0, 0.0
                _add_products(batch, free + 1, products)
            if shaken:
                share = 1 / (1 / shake[s, c] ** 2 + total)
                shared[0, free], shared[1, free] = 0.0, 0.0
                _subtract_products(shared, free, share, products)
                if bent:
                    _express_rows(shared, motions, prior_std[c], full)
                    _subtract_object(share, full, shared_own, c, s, coupling, border)
            _express_products(products, motions, free + 1, mixed, posed)
            for i in range(6):
                camera_gradient[c, i] += mixed[free, i]
                pose_gradient[s, i] += mixed[free, 6 + i]
                for j in range(i + 1):
                    information[i, j] += posed[i, j]
                    pose[s, i, j] += posed[6 + i, 6 + j]
            for i in range(6, free):
                camera_gradient[c, i] += products[free, i]
                for j in range(6):
                    information[i, j] += mixed[i, j]
                for j in range(6, i + 1):
                    information[i, j] += products[i, j]
            for i in range(6):
                for j in range(free):
                    value = (posed[6 + i, j] if j < 6 else mixed[j, 6 + i]) * prior_std[c, j]
                    if cameras_first:
                        coupling[c, j, 6 * s + i] = value
                    else:
                        coupling[s, i, free * c + j] = value
        for i in range(free):
            camera_gradient[c, i] = offset[c, i] + camera_gradient[c, i] * prior_std[c, i]
            for j in range(i + 1):
                camera[c, i, j] = camera[c, j, i] = information[i, j] * prior_std[c, i] * prior_std[c, j]
            camera[c, i, i] += 1.0
    for s in range(snapshots):
        for i in range(6):
            for j in range(i):
                pose[s, j, i] = pose[s, i, j]
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _write_motions(rotation_cam, left, centre_cam, unit, motions):
    """Write how an object moves in a camera's frame by steps of the camera's and of its own pose: (6, 12).

    Rows: a rotation about the object's centre, `centre_cam` (3,), and a shift. Columns: rotation and position of the
    camera, rotation and position of the object. What is zero is left as it is.
    """
    for i in range(3):
        for k in range(3):
            motions[k, i] = left[k, i]
            motions[3 + k, 3 + i] = -rotation_cam[k, i]
            motions[k, 6 + i] = rotation_cam[k, i]
            motions[3 + k, 9 + i] = unit * rotation_cam[k, i]
        motions[3, i] = left[1, i] * centre_cam[2] - left[2, i] * centre_cam[1]
        motions[4, i] = left[2, i] * centre_cam[0] - left[0, i] * centre_cam[2]
        motions[5, i] = left[0, i] * centre_cam[1] - left[1, i] * centre_cam[0]


@njit(cache=True, fastmath=kernels.FAST)
def _add_products(rows, count, products):
    """Add the products of the first columns of the rows of four points (4, 2, W) with all columns to a matrix."""
    a, b, c, d = rows[0], rows[1], rows[2], rows[3]
    for i in range(count):
        a0, a1, b0, b1, c0, c1, d0, d1 = a[0, i], a[1, i], b[0, i], b[1, i], c[0, i], c[1, i], d[0, i], d[1, i]
        for j in range(rows.shape[2]):
            products[i, j] += (a0 * a[0, j] + a1 * a[1, j] + b0 * b[0, j] + b1 * b[1, j]) + (
                c0 * c[0, j] + c1 * c[1, j] + d0 * d[0, j] + d1 * d[1, j]
            )


@njit(cache=True, fastmath=kernels.FAST)
def _subtract_products(rows, count, factor, products):
    """Subtract the scaled products of the first columns of rows (2, W) with all columns from a matrix."""
    for i in range(count):
        first, second = factor * rows[0, i], factor * rows[1, i]
        for j in range(rows.shape[1]):
            products[i, j] -= first * rows[0, j] + second * rows[1, j]


@njit(cache=True, fastmath=kernels.FAST)
def _express_products(products, motions, count, mixed, posed):
    """Express products (W, W) by the steps of `motions` (6, TILE) instead of the motions.

    Fills `mixed` (W, 16), products of all columns with the steps, and `posed` (12, 16), those of the steps.
    """
    for i in range(count):
        p, m = products[i], motions
        for j in range(m.shape[1]):
            mixed[i, j] = (p[0] * m[0, j] + p[1] * m[1, j] + p[2] * m[2, j]) + (
                p[3] * m[3, j] + p[4] * m[4, j] + p[5] * m[5, j]
            )
    for i in range(12):
        m, x = motions, mixed
        for j in range(m.shape[1]):
            posed[i, j] = (m[0, i] * x[0, j] + m[1, i] * x[1, j] + m[2, i] * x[2, j]) + (
                m[3, i] * x[3, j] + m[4, i] * x[4, j] + m[5, i] * x[5, j]
            )


@njit(cache=True, fastmath=kernels.FAST)
def _express_rows(rows, motions, prior_std, full):
    """Write derivatives with respect to the camera and the pose (2, K + 6) from those in the camera's frame (2, W)."""
    free = len(prior_std)
    for r in range(2):
        for i in range(6):
            by_camera, by_pose = 0.0, 0.0
            for k in range(6):
                by_camera += motions[k, i] * rows[r, k]
                by_pose += motions[k, 6 + i] * rows[r, k]
            full[r, i], full[r, free + i] = by_camera * prior_std[i], by_pose
        for i in range(6, free):
            full[r, i] = rows[r, i] * prior_std[i]


@njit(cache=True, fastmath=kernels.FAST)
def _write_own(at, rotation_object, derivative, own_std, n, rows_own):
    """Write derivatives (2, 4) with respect to the coordinates of fiducial n and to the object's scale."""
    for r in range(2):
        rows_own[r, 3] = 0.0
        for i in range(3):
            value = 0.0
            for k in range(3):
                value += rotation_object[k, i] * derivative[r, k]
            rows_own[r, i] = value * own_std[3 * n + i]
            rows_own[r, 3] += value * at[i] * own_std[-1]


@njit(cache=True, fastmath=kernels.FAST)
def _clear_coupling(c, s, free, coupling, cameras_first):
    """Clear the coupling of a camera with a snapshot in which it sees nothing."""
    for i in range(6):
        for j in range(free):
            if cameras_first:
                coupling[c, j, 6 * s + i] = 0.0
            else:
                coupling[s, i, free * c + j] = 0.0


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
def _add_object(rows, rows_own, residuals, c, s, n, coupling, border, own_gradient, cameras_first):
    """Add the information of one observation about its fiducial's coordinates and the object's scale."""
    size, wide = border.shape
    ru, rv = residuals
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
def _project(given, own_offset, c, s, scale, camera_at, residual):
    """Write the residuals of a camera in a snapshot, predicted minus observed: (2, N) pixels."""
    points, radius_squared, lenses, uv, own_std = given[0], given[1], given[2], given[3], given[11]
    rotation_object, centre_cam, coefficients, (fx, fy, cx, cy) = camera_at
    at, point = np.empty(3), np.empty(3)
    for n in range(residual.shape[1]):
        for i in range(3):
            at[i] = points[n, i]
            if len(own_std):
                at[i] = scale * at[i] + own_offset[3 * n + i] * own_std[3 * n + i]
        for i in range(3):
            turn = rotation_object[i]
            point[i] = turn[0] * at[0] + turn[1] * at[1] + turn[2] * at[2] + centre_cam[i]
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
