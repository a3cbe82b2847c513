"""`measurement_update.absorb` compiled for CPUs: one call a snapshot, without temporaries.

`measurement_update_in_tensors` does the same in tensors; the tests compare both. Sizes: K parameters per camera, M of
the object, D = K C + M; S snapshots, each linearized as a rig of its own (`linearization_cpu.linearize_rig`). All
states and equations have two rows: the best so far, and the trial.

A snapshot's pose has P numbers: six for an object. N lights have 3 N, a position each and no rotation
(`light_linearization_cpu.linearize_lights`); their centres are (S, N, 3). Known distances between lights
(`known_distances.py`) couple their positions.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.estimation import linearize_lights, linearize_rig, select_blocks
from imgcal.geometry import kernels
from imgcal.monitoring.rig_arrays import RigArrays
from imgcal.monitoring.rig_error_cpu import times_basis, write_basis, write_error
from renderers.compiling import njit

Array = NDArray[np.float64]

FOUND, NO_POSE, NOTHING_KNOWN, NO_MINIMUM = 0, 1, 2, 3
"""Result: a minimum was found, a snapshot does not determine its pose, a factorization failed, or no minimum."""

WHY_NOT = {
    NO_POSE: "the observations do not determine the object's pose in every snapshot",
    NOTHING_KNOWN: "these observations do not determine the rig: labels may be wrong",
    NO_MINIMUM: "no minimum was found for these observations: labels may be wrong",
}
MOST_DAMPING = 1e8
SLACK = 1e-6
"""Relative increase of the cost that a step may have, by rounding."""
DAMPED, STALLED = 1e-3, 10.0
"""Greatest damping at which a step below the tolerance proves the minimum; the second value applies after lightly
damped steps have failed: far from the belief their direction is only approximate."""

LOOSEN_AFTER, LOOSER = 12, 1.5
"""After this many iterations the tolerance grows by this factor in each: steps shrink slowly if snapshots contradict
a belief."""
LARGE = 256
"""From this size on, LAPACK factorizes a matrix faster than a compiled loop does."""


@dataclass(frozen=True)
class Minimum:
    """The result of `absorb`."""

    status: int  # FOUND, ...
    rig: RigArrays
    rotation: Array  # (S, 3, 3) rig_from_object
    centre: Array  # (S, 3) mm, the object's centroid in the rig; (S, N, 3) for lights
    own: Array  # (M,) the object's offset
    residual: Array  # (S, C, 2, N) pixels, predicted minus observed
    cost: float
    information: Array  # (D, D)
    factor: Array  # (D, D) its lower Cholesky factor
    camera: Array  # (S, C, K, K) each snapshot's information: see `SnapshotInformation`
    border: Array  # (S, M, D)
    carried: Array  # (S, P, D)
    pull: Array  # (S, D)
    from_rig: RigArrays  # the point of linearization
    from_own: Array  # (M,)


def absorb(
    shared: tuple[Any, ...],
    seen: tuple[Array, Array, Array],
    distances: tuple[NDArray[np.int64], Array, Array],
    known: tuple[RigArrays, Array, Array, Array, Array],
    poses: tuple[Array, Array],
    options: tuple[int, float, int, float, float, float, float, float],
    start: tuple[RigArrays, Array] | None = None,
) -> Minimum:
    """Find the most probable rig, object and poses after some snapshots.

    Args:
        shared: what `linearization_cpu` needs for all rigs alike: points, squared radii, and so on.
        seen: pixels (S, C, 2, N), square roots of their weights (S, C, N), and how much cameras shake (S, C): see
            `linearization_cpu.linearize_rig`.
        distances: see `KnownDistances.arrays`; without rows for an object.
        known: the rig, units (C, K) of its errors, offset (M,) of the object and its prior standard deviation (M,), and
            the information (D, D) about both.
        poses: first guess, rotation (S, 3, 3) and centre (S, 3), or (S, N, 3) for lights.
        options: code and threshold of the loss, most iterations, tolerance, allowed increase of the cost, greatest
            damping at which a small step proves the minimum, the same after a failed step, and greatest damping.
        start: first guess of the rig and of the object's offset (M,); None = the known values.
    """
    uv = seen[0]
    rig, unit, own, own_std, information = known
    (count, cameras, _, fiducials), free = uv.shape, unit.shape[1]
    size = len(own)
    wide, freedom = cameras * free + size, 6 if poses[1].ndim == 2 else 3 * fiducials
    first_rig, first_own = (rig, own) if start is None else start
    rigs = tuple(np.stack((part, part)) for part in first_rig.parts)
    states = (np.zeros((cameras, free)), *(np.stack((part, part)) for part in (*poses, first_own)))
    blocks = (
        np.empty((2, count, cameras, free, free)), np.empty((2, count, 1, freedom, wide)),
        np.empty((2, count, 1, freedom, freedom)), np.empty((2, count, size, wide)),
        np.empty((2, count, cameras, free)), np.empty((2, count, 1, freedom)),
        np.empty((2, count, size)), np.empty((2, count, 1, cameras, 2, fiducials)),
    )  # fmt: skip
    factor, gathered = np.empty((wide, wide)), np.empty((wide, wide))
    brought = (np.empty((count, freedom)), np.empty((count, wide)), np.empty((2, wide)))
    best, status, cost = _absorb(
        shared, (*seen, distances), rig.parts, (unit, own, own_std, information), rigs, states, blocks,
        (factor, gathered), brought, options,
    )  # fmt: skip
    last = 1 - best  # where the last step started
    return Minimum(
        status=status,
        rig=RigArrays(*(part[best] for part in rigs)),
        rotation=states[1][best],
        centre=states[2][best],
        own=states[3][best],
        residual=blocks[7][best, :, 0],
        cost=cost,
        information=gathered,
        factor=factor,
        camera=blocks[0][last],
        border=blocks[3][last],
        carried=blocks[1][last, :, 0],
        pull=brought[1],
        from_rig=RigArrays(*(part[last] for part in rigs)),
        from_own=states[3][last],
    )


@njit(cache=True, fastmath=kernels.FAST)
def _absorb(shared, seen, known_rig, known, rigs, states, blocks, matrices, brought, options):
    """Minimize by Newton's method, damped when a step fails; see `measurement_update_in_tensors.update_in_tensors`."""
    loss, threshold, most, tolerance, slack, light, stalled, most_damping = options
    unit, _, _, prior = known
    factor, gathered = matrices
    half, pull, distance = brought
    wide = len(prior)
    step, right, poses = np.empty(wide), np.empty(wide), np.empty(half.shape)
    # A literal 0 is a type of its own: all that is called with it would be compiled twice.
    damping, best = 0.0, np.int64(0)
    cost = _evaluate(shared, seen, known_rig, known, rigs, states, blocks, distance, best, loss, threshold)
    fresh = True
    for iteration in range(most):
        enough = tolerance * LOOSER ** max(0, iteration - LOOSEN_AFTER)
        b, t = best, 1 - best
        if fresh:
            status = _gather(unit, known, rigs, states, blocks, gathered, half, pull, b)
            if status != 0:
                return best, status, cost
            fresh = False
        for i in range(wide):
            value = 0.0
            for s in range(len(pull)):
                value += pull[s, i]
            for j in range(wide):
                value -= prior[i, j] * distance[b, j]
            right[i] = step[i] = value
        if not _factorize(gathered, damping, factor):
            return best, 2, cost
        kernels.cholesky_solve(factor, step)
        gain = 0.0
        for i in range(wide):
            gain += 0.5 * step[i] * right[i]
        for s in range(len(half)):
            gain += _half_square(states[2], half[s])
        _move(unit, rigs, states, blocks, half, step, poses, b, t)
        trial = _evaluate(shared, seen, known_rig, known, rigs, states, blocks, distance, t, loss, threshold)
        if trial <= cost + slack * max(1.0, cost):
            done = gain <= enough and damping <= light
            best, cost, fresh = t, trial, True
            if done:
                if damping > 0 and not _factorize(gathered, 0.0, factor):
                    return best, 2, cost
                kernels.mirror(gathered)
                for i in range(wide):
                    factor[i, i + 1 :] = 0.0
                return best, 0, cost
            damping = 0.0 if damping <= 1e-6 else damping / 8
        else:
            damping, light = max(8 * damping, 1e-4), stalled
            if damping > most_damping:
                break
    return best, 3, cost


@njit(cache=True, fastmath=kernels.FAST)
def _half_square(centre, half):
    """Half of the squared norm of a pose's numbers (P,)."""
    gain = 0.0
    if centre.ndim == 3:
        for i in range(6):
            gain += 0.5 * half[i] ** 2
    else:
        for i in range(len(half)):
            gain += 0.5 * half[i] ** 2
    return gain


@njit(cache=True, fastmath=kernels.FAST)
def _factorize(matrix, damping, factor):
    """Write the lower Cholesky factor of a matrix (D, D) whose diagonal is scaled up; return False if there is none."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            factor[i, j] = matrix[i, j]
        factor[i, i] *= 1 + damping
    if len(matrix) < LARGE:
        return kernels.cholesky(factor)
    try:
        factor[:] = np.linalg.cholesky(factor)
    except Exception:  # numba supports no narrower one
        return False
    return True


@njit(cache=True, fastmath=kernels.FAST)
def _evaluate(shared, seen, known_rig, known, rigs, states, blocks, distance, b, loss, threshold):
    """Linearize all snapshots at row b, write the distance from the known values, and return the cost."""
    uv, root_weight, shake, distances = seen
    unit, own0, own_std, prior = known
    rotation, position, focal, principal, distortion = rigs
    offset, turned, centre, own = states
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual = blocks
    row = (
        camera[b], coupling[b], pose[b], border[b], camera_gradient[b], pose_gradient[b], own_gradient[b], residual[b],
    )  # fmt: skip
    cost = 0.0
    for s in range(len(uv)):
        given = shared + (  # noqa: RUF005 (numba supports no other way)
            uv[s : s + 1], root_weight[s : s + 1], rotation[b], position[b], focal[b], principal[b], distortion[b],
            unit, own_std,
        )  # fmt: skip
        state = (offset, turned[b, s : s + 1], centre[b, s : s + 1], own[b])
        cost += _linearize(given, state, state[2], select_blocks(row, s), loss, threshold, shake[s : s + 1])
        cost += _add_distances(state[2], select_blocks(row, s), distances, s)
        for i in range(len(own0)):
            cost -= 0.5 * own[b, i] ** 2
    write_error(rotation[b], position[b], focal[b], principal[b], distortion[b], known_rig, unit, distance[b])
    first = unit.size
    for i in range(len(own0)):
        distance[b, first + i] = own[b, i] - own0[i]
    for i in range(len(prior)):
        value = 0.0
        for j in range(len(prior)):
            value += prior[i, j] * distance[b, j]
        cost += 0.5 * value * distance[b, i]
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _linearize(given, state, centre, blocks, loss, threshold, shake):
    """Linearize one snapshot of an object or of lights; the number of axes of `centre` decides at compile time."""
    if centre.ndim == 2:
        return linearize_rig(given, state, blocks, np.bool_(False), loss, threshold, shake)
    (_, radius_squared, lenses, uv, root_weight, rotation, position, focal, principal, distortion, unit, _) = given
    camera, coupling, pose, _, camera_gradient, pose_gradient, _, residual = blocks
    lights = (
        radius_squared, lenses, uv[0], root_weight[0], rotation, position, focal, principal, distortion, unit,
    )  # fmt: skip
    return linearize_lights(
        lights, centre[0], (camera, coupling[0], pose[0], camera_gradient, pose_gradient[0], residual[0]),
        loss, threshold, shake.ravel(),
    )  # fmt: skip


@njit(cache=True, fastmath=kernels.FAST)
def _add_distances(centre, blocks, distances, s):
    """Add the known distances between the lights (1, N, 3) of snapshot s to its equations; return their cost."""
    if centre.ndim == 2:
        return 0.0
    return _add_distances_of(centre[0], blocks[2][0], blocks[5][0], distances, s)


@njit(cache=True, fastmath=kernels.FAST)
def _add_distances_of(places, pose, gradient, distances, s):
    """Add them to the information (3 N, 3 N) of the positions (N, 3) and to its gradient (3 N,)."""
    if places.ndim != 2:
        return 0.0
    columns, coefficients, lengths = distances
    total, cost = np.empty(3), 0.0
    for row in range(lengths.shape[1]):
        column, coefficient, length = columns[s, row], coefficients[s, row], lengths[s, row]
        total[:] = 0.0
        for term in range(len(column)):
            for i in range(3):
                total[i] += coefficient[term] * places[column[term], i]
        size = max(np.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2), 1e-9)
        excess = 1 - length / size  # residual relative to the sum
        cost += 0.5 * (excess * size) ** 2
        for first in range(len(column)):
            m = column[first]
            by_m = coefficient[first] * _step_unit(places[m])
            if by_m == 0.0:
                continue
            for i in range(3):
                gradient[3 * m + i] += by_m * excess * total[i]
            for second in range(len(column)):
                n = column[second]
                if n > m:
                    continue
                by = by_m * coefficient[second] * _step_unit(places[n])
                for i in range(3):
                    for j in range(3):
                        if length > 0:
                            pose[3 * m + i, 3 * n + j] += by * total[i] * total[j] / (size * size)
                        elif i == j:
                            pose[3 * m + i, 3 * n + j] += by
    return cost


@njit(cache=True, fastmath=kernels.FAST)
def _step_unit(place):
    """Unit of a step of a light's position (3,), see `light_linearization_cpu`."""
    return max(1.0, np.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2))


@njit(cache=True, fastmath=kernels.FAST)
def _gather(unit, known, rigs, states, blocks, gathered, half, pull, b):
    """Eliminate the poses of row b, and sum the information; return 1 if a pose is not determined.

    The result for each snapshot overwrites its blocks: `camera`, `border`, and `coupling` (carried).
    """
    _, _, _, prior = known
    rotation, position, _, _, _ = rigs
    _, _, _, own = states
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, _ = blocks
    cameras, free = unit.shape
    wide, size = len(prior), own.shape[1]
    first_own = cameras * free
    for i in range(wide):
        for j in range(i + 1):
            gathered[i, j] = prior[i, j]
    basis = np.empty((cameras, 6, 3))
    for c in range(cameras):
        write_basis(rotation[b, c], position[b, c], unit[c], basis[c])
    for s in range(len(pull)):
        for c in range(cameras):
            block = camera[b, s, c]
            for i in range(free):
                block[i, i] -= 1.0
            for i in range(free):
                times_basis(block[i], basis[c])
            for j in range(free):
                x, y, z = 0.0, 0.0, 0.0
                for i in range(6):
                    x += block[i, j] * basis[c, i, 0]
                    y += block[i, j] * basis[c, i, 1]
                    z += block[i, j] * basis[c, i, 2]
                block[0, j], block[1, j], block[2, j] = x, y, z
            times_basis(camera_gradient[b, s, c], basis[c])
            at = c * free
            for i in range(free):
                pull[s, at + i] = -camera_gradient[b, s, c, i]
                for j in range(i + 1):
                    gathered[at + i, at + j] += block[i, j]
            _take_steps(coupling[b, s, 0], at, free, basis[c])
            for i in range(size):
                times_basis(border[b, s, i, at : at + free], basis[c])
        for i in range(size):
            border[b, s, i, first_own + i] -= 1.0
            pull[s, first_own + i] = own[b, i] - own_gradient[b, s, i]
            for j in range(first_own + i + 1):
                gathered[first_own + i, j] += border[b, s, i, j]
            for j in range(i):
                border[b, s, j, first_own + i] = border[b, s, i, first_own + j]
        if not kernels.cholesky(pose[b, s, 0]):
            return 1
        _take_out(pose[b, s, 0], pose_gradient[b, s, 0], coupling[b, s, 0], half[s], pull[s])
        kernels.subtract_gram(gathered, coupling[b, s, 0])
    return 0


@njit(cache=True, fastmath=kernels.FAST)
def _take_steps(coupling, at, free, basis):
    """Multiply a camera's part of the coupling (P, D) of a pose, or of positions, by the steps by its errors."""
    for i in range(len(coupling)):
        times_basis(coupling[i, at : at + free], basis)


@njit(cache=True, fastmath=kernels.FAST)
def _take_out(lower, gradient, carried, half, pull):
    """Solve by the factor (P, P) of a pose for its gradient (P,) and its coupling (P, D); add the effect on `pull`
    (D,).

    Most of the factor of light positions is zero.
    """
    for i in range(len(lower)):
        value, inverse = gradient[i], 1 / lower[i, i]
        for k in range(i):
            if lower[i, k] != 0.0:
                value -= lower[i, k] * half[k]
                for j in range(len(pull)):
                    carried[i, j] -= lower[i, k] * carried[k, j]
        half[i] = value * inverse
        for j in range(len(pull)):
            carried[i, j] *= inverse
            pull[j] += carried[i, j] * half[i]


@njit(cache=True, fastmath=kernels.FAST)
def _move(unit, rigs, states, blocks, half, step, poses, b, t):
    """Write row b plus a step to row t, and update the poses to match."""
    rotation, position, focal, principal, distortion = rigs
    _, turned, centre, own = states
    _, coupling, pose, _, _, _, _, _ = blocks
    cameras, free = unit.shape
    turn, left, vector = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for c in range(cameras):
        at = c * free
        for i in range(3):
            vector[i] = step[at + i] * unit[c, i]
        kernels.exponential(vector, turn, left)
        for i in range(3):
            for j in range(3):
                rotation[t, c, i, j] = (
                    rotation[b, c, i, 0] * turn[j, 0]
                    + rotation[b, c, i, 1] * turn[j, 1]
                    + rotation[b, c, i, 2] * turn[j, 2]
                )
            position[t, c, i] = (
                turn[i, 0] * position[b, c, 0] + turn[i, 1] * position[b, c, 1] + turn[i, 2] * position[b, c, 2]
            ) + step[at + 3 + i] * unit[c, 3 + i]
        for i in range(2):
            focal[t, c, i] = focal[b, c, i] + step[at + 6 + i] * unit[c, 6 + i]
            principal[t, c, i] = principal[b, c, i] + step[at + 8 + i] * unit[c, 8 + i]
        for i in range(free - 10):
            distortion[t, c, i] = distortion[b, c, i] + step[at + 10 + i] * unit[c, 10 + i]
    for i in range(own.shape[1]):
        own[t, i] = own[b, i] + step[cameras * free + i]
    _move_poses(centre, turned, coupling, pose, half, step, poses, b, t)


@njit(cache=True, fastmath=kernels.FAST)
def _move_poses(centre, turned, coupling, pose, half, step, poses, b, t):
    """Write the poses of row b, of an object or of lights, to row t, updated for a step (D,)."""
    if centre.ndim == 3:
        turn, left = np.empty((3, 3)), np.empty((3, 3))
        for s in range(len(half)):
            carried, lower = coupling[b, s, 0], pose[b, s, 0]
            for i in range(6):
                value = half[s, i]
                for j in range(len(step)):
                    value += carried[i, j] * step[j]
                poses[s, i] = -value
            for i in range(5, -1, -1):
                for k in range(i + 1, 6):
                    poses[s, i] -= lower[k, i] * poses[s, k]
                poses[s, i] /= lower[i, i]
            away = max(1.0, np.sqrt(centre[b, s, 0] ** 2 + centre[b, s, 1] ** 2 + centre[b, s, 2] ** 2))
            for i in range(3):
                centre[t, s, i] = centre[b, s, i] + poses[s, 3 + i] * away
            kernels.exponential(poses[s], turn, left)
            kernels.multiply(turn, turned[b, s], turned[t, s])
    else:
        for s in range(len(half)):
            _move_places(centre, coupling[b, s, 0], pose[b, s, 0], half[s], step, poses[s], s, b, t)


@njit(cache=True, fastmath=kernels.FAST)
def _move_places(centre, carried, lower, half, step, places, s, b, t):
    """Write the positions of a snapshot's lights to row t, updated for a step (D,)."""
    if centre.ndim == 4:
        for i in range(len(lower)):
            value = half[i]
            for j in range(len(step)):
                value += carried[i, j] * step[j]
            places[i] = -value
        for i in range(len(lower) - 1, -1, -1):
            for k in range(i + 1, len(lower)):
                places[i] -= lower[k, i] * places[k]
            places[i] /= lower[i, i]
        for n in range(centre.shape[2]):
            away = max(1.0, np.sqrt(centre[b, s, n, 0] ** 2 + centre[b, s, n, 1] ** 2 + centre[b, s, n, 2] ** 2))
            for i in range(3):
                centre[t, s, n, i] = centre[b, s, n, i] + places[3 * n + i] * away
