"""Compiled loops of `RecentSnapshots`, run for every snapshot."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import kernels
from renderers.compiling import njit

RIDGE = 1e-6


@njit(fastmath=kernels.FAST)
def screen(ring, totals, number, count, at, change, parts, ages, scores):
    """Score cameras for changes before several numbers of latest snapshots, treating everything else as known.

    The later snapshots' gradient is taken at the current belief. Their information stands in for its covariance and is
    an upper bound. If more is known than they add, the score is at least half of the exact one.

    Args:
        ring: of the K latest snapshots, number k in row k % K, see `SnapshotInformation`: carried (K, P, D), P >= 6,
            the information lost to the unknown poses; border (K, M, D), information about the object; weighted (K, D),
            gradient at the chart's origin.
        totals: sums over the snapshots before number k, in row k % (K + 1): information about each camera with known
            poses, and with free poses; both (K + 1, C, P, P).
        number: of the next snapshot.
        count: number of snapshots.
        at: (D,) error of the current belief.
        change: (C, P, P) error by a change of a camera's own parameters.
        parts: (kinds, 2) first and last parameter of each kind.
        ages: numbers of snapshots, ascending.
        scores: (ages, C), filled with the largest score of any kind; zero if there are too few snapshots.
    """
    carried, border, weighted = ring
    camera_total, own_total = totals
    cameras, size, rows = camera_total.shape[1], camera_total.shape[2], camera_total.shape[0]
    wide, last = cameras * size, number % camera_total.shape[0]
    sums, pull, block = np.zeros(len(at)), np.zeros(size), np.zeros((size, size))
    free, work, row = np.zeros(carried.shape[1]), np.zeros((3, size, size)), 0
    for n in range(count):
        k = (number - 1 - n) % len(carried)
        for q in range(len(free)):
            free[q] = 0.0
            for i in range(len(at)):
                free[q] += carried[k, q, i] * at[i]
        for i in range(wide):
            sums[i] += weighted[k, i] + (
                carried[k, 0, i] * free[0] + carried[k, 1, i] * free[1] + carried[k, 2, i] * free[2]
                + carried[k, 3, i] * free[3] + carried[k, 4, i] * free[4] + carried[k, 5, i] * free[5]
            )  # fmt: skip
        for q in range(6, len(free)):  # lights only
            if free[q] != 0.0:
                for i in range(wide):
                    sums[i] += carried[k, q, i] * free[q]
        for m in range(border.shape[1]):
            for i in range(wide):
                sums[i] -= border[k, m, i] * at[wide + m]
        if row < len(ages) and ages[row] == n + 1:
            before = (number - ages[row]) % rows
            for c in range(cameras):
                scores[row, c] = 0.0
                for i in range(size):
                    left = sums[c * size + i]
                    for j in range(size):
                        left -= (camera_total[last, c, i, j] - camera_total[before, c, i, j]) * at[c * size + j]
                        block[i, j] = own_total[last, c, i, j] - own_total[before, c, i, j]
                    pull[i] = left
                for kind in range(len(parts)):
                    score = _score(pull, block, change[c], parts[kind, 0], parts[kind, 1], work)
                    scores[row, c] = max(scores[row, c], score)
            row += 1
    for rest in range(row, len(ages)):
        for c in range(cameras):
            scores[rest, c] = 0.0


@njit(fastmath=kernels.FAST)
def _score(pull, block, change, first, last, work):
    """Squared gradient by some of a camera's parameters, whitened by their information.

    Most changes of a parameter are a change of one error, so zeros are skipped. `work` (3, P, P) is overwritten.
    """
    count, size = last - first, len(pull)
    matrix, across, right = work[0], work[1], work[2, 0]
    for a in range(count):
        right[a] = 0.0
        for i in range(size):
            across[a, i] = 0.0
        for j in range(size):
            by = change[j, first + a]
            if by != 0.0:
                right[a] += by * pull[j]
                for i in range(size):
                    across[a, i] += by * block[j, i]
        for b in range(a + 1):
            matrix[a, b] = 0.0
        for j in range(size):
            for b in range(a + 1):
                by = change[j, first + b]
                if by != 0.0:
                    matrix[a, b] += by * across[a, j]
    for a in range(count):
        if matrix[a, a] <= 0.0:
            return 0.0
        right[a] /= np.sqrt(matrix[a, a])
        for b in range(a):
            matrix[a, b] /= np.sqrt(matrix[a, a] * matrix[b, b])
    for a in range(count):
        matrix[a, a] = 1.0 + RIDGE
    score = 0.0
    for a in range(count):  # Cholesky factor, and the whitened gradient along with it
        value = right[a]
        for b in range(a):
            entry = matrix[a, b]
            for c in range(b):
                entry -= matrix[a, c] * matrix[b, c]
            matrix[a, b] = entry / matrix[b, b]
            value -= matrix[a, b] * right[b]
        pivot = matrix[a, a]
        for c in range(a):
            pivot -= matrix[a, c] ** 2
        if pivot <= 0.0:
            return score
        matrix[a, a] = np.sqrt(pivot)
        right[a] = value / matrix[a, a]
        score += right[a] ** 2
    return score


@njit(fastmath=kernels.FAST)
def add_error(rig, reference, unit, error):
    """Add the error in units that takes a rig to another, like `rig_error.error_between`.

    Args:
        rig: rotation (C, 3, 3) of cam_from_rig, position (C, 3) mm, focal length, principal point and distortion of the
            other rig.
        reference: the same of the first rig.
        unit: (C, P).
        error: (C, P), to which the result is added.
    """
    rotation, position, focal, principal, distortion = rig
    rotation0, position0, focal0, principal0, distortion0 = reference
    turn, vector = np.zeros((3, 3)), np.zeros(3)
    for c in range(len(rotation)):
        for i in range(3):
            for j in range(3):
                turn[i, j] = 0.0
                for k in range(3):
                    turn[i, j] += rotation[c, k, i] * rotation0[c, k, j]
        sine = 0.0
        for i in range(3):
            vector[i] = 0.5 * (turn[(i + 2) % 3, (i + 1) % 3] - turn[(i + 1) % 3, (i + 2) % 3])
            sine += vector[i] ** 2
        sine = np.sqrt(sine)
        angle = np.arctan2(sine, 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1))
        scale = angle / sine if sine > 1e-12 else 1.0
        for i in range(3):
            error[c, i] += scale * vector[i] / unit[c, i]
            shift = position[c, i]
            for j in range(3):
                shift -= turn[i, j] * position0[c, j]
            error[c, 3 + i] += shift / unit[c, 3 + i]
        for i in range(2):
            error[c, 6 + i] += (focal[c, i] - focal0[c, i]) / unit[c, 6 + i]
            error[c, 8 + i] += (principal[c, i] - principal0[c, i]) / unit[c, 8 + i]
        for i in range(distortion.shape[1]):
            error[c, 10 + i] += (distortion[c, i] - distortion0[c, i]) / unit[c, 10 + i]


@njit(fastmath=kernels.FAST)
def put(ring, totals, number, brought, at):
    """Write a snapshot's information, linearized at an error, into the ring, and add it to the totals.

    Args:
        ring: see `screen`.
        totals: see `screen`.
        number: of the snapshot.
        brought: camera (C, P, P), carried (P, D) with at least six rows, border (M, D) and gradient (D,).
        at: (D,) error.
    """
    row = number % len(ring[0])
    carried, border, weighted = ring[0][row], ring[1][row], ring[2][row]
    camera, new_carried, new_border, pull = brought
    before, after = number % len(totals[0]), (number + 1) % len(totals[0])
    camera_before, camera_total = totals[0][before], totals[0][after]
    own_before, own_total = totals[1][before], totals[1][after]
    cameras, size = camera.shape[0], camera.shape[1]
    wide = cameras * size
    for i in range(len(at)):
        weighted[i] = pull[i]
    for q in range(len(new_carried), len(carried)):
        for i in range(len(at)):
            carried[q, i] = 0.0
    for q in range(len(new_carried)):
        value = 0.0
        for i in range(len(at)):
            carried[q, i] = new_carried[q, i]
            value += carried[q, i] * at[i]
        for i in range(len(at)):
            weighted[i] -= carried[q, i] * value
    for c in range(cameras):
        first = c * size
        for i in range(size):
            value = 0.0
            for j in range(size):
                entry = camera[c, i, j]
                value += entry * at[first + j]
                camera_total[c, i, j] = camera_before[c, i, j] + entry
                if len(new_carried) == 6:
                    for q in range(6):
                        entry -= new_carried[q, first + i] * new_carried[q, first + j]
                else:  # lights
                    for q in range(len(new_carried)):
                        entry -= new_carried[q, first + i] * new_carried[q, first + j]
                own_total[c, i, j] = own_before[c, i, j] + entry
            weighted[first + i] += value
    for m in range(len(border)):
        value = 0.0
        for i in range(len(at)):
            border[m, i] = new_border[m, i]
            value += border[m, i] * at[i]
        weighted[wide + m] += value
        for i in range(wide):
            weighted[i] += border[m, i] * at[wide + m]


@njit(fastmath=kernels.FAST)
def add_row(ring, totals, number, information, weighted):
    """Add a snapshot's information (D, D) and weighted error (D,) from the ring to sums; see `screen`."""
    row, rows = number % len(ring[0]), len(totals[0])
    carried, border = ring[0][row], ring[1][row]
    after, before = totals[0][(number + 1) % rows], totals[0][number % rows]
    cameras, size = after.shape[0], after.shape[1]
    wide = cameras * size
    for i in range(len(weighted)):
        weighted[i] += ring[2][row, i]
        a, b, c = carried[0, i], carried[1, i], carried[2, i]
        d, e, f = carried[3, i], carried[4, i], carried[5, i]
        for j in range(len(weighted)):
            information[i, j] -= (
                a * carried[0, j] + b * carried[1, j] + c * carried[2, j]
                + d * carried[3, j] + e * carried[4, j] + f * carried[5, j]
            )  # fmt: skip
    for q in range(6, len(carried)):  # lights only
        for i in range(len(weighted)):
            if carried[q, i] != 0.0:
                for j in range(len(weighted)):
                    information[i, j] -= carried[q, i] * carried[q, j]
    for k in range(cameras):
        first = k * size
        for i in range(size):
            for j in range(size):
                information[first + i, first + j] += after[k, i, j] - before[k, i, j]
    for m in range(len(border)):
        for i in range(len(weighted)):
            information[wide + m, i] += border[m, i]
        for i in range(wide):
            information[i, wide + m] += border[m, i]
