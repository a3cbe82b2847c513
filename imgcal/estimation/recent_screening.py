"""Compiled loops of `RecentSnapshots`, which run with every snapshot."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from imgcal.geometry import kernels
from renderers.compiling import njit

RIDGE = 1e-6


@njit(fastmath=kernels.FAST)
def screen(camera, own, carried, border, weighted, order, at, change, parts, ages, scores):
    """Score cameras for changes before each of some numbers of latest snapshots, all else taken to be known.

    The pull of the later snapshots is that at what is believed now; its covariance is taken to be their information,
    which it does not reach. Where more is known than they brought, the score is at least half of the true one.

    Args:
        camera: (K, C, P, P) information of each camera, were the poses known; with the next two: see `Brought`.
        own: (K, C, P, P) each camera's block of the information, the poses let free.
        carried: (K, 6, D) by which the unknown poses take information away.
        border: (K, M, D) information of the object.
        weighted: (K, D) pull at the chart's origin.
        order: (n,) rows, the latest first.
        at: (D,) error of what is believed now.
        change: (C, P, P) error by a change of a camera's own parameters.
        parts: (kinds, 2) first and last of the parameters of each kind.
        ages: numbers of snapshots, ascending.
        scores: (ages, C), filled with the largest score of any kind; zero where there are not as many snapshots.
    """
    cameras, size = own.shape[1], own.shape[2]
    wide = cameras * size
    pull, block = np.zeros((cameras, size)), np.zeros((cameras, size, size))
    free, row = np.zeros(6), 0
    for n in range(len(order)):
        k = order[n]
        for q in range(6):
            free[q] = 0.0
            for i in range(len(at)):
                free[q] += carried[k, q, i] * at[i]
        for c in range(cameras):
            for i in range(size):
                left = weighted[k, c * size + i]
                for q in range(6):
                    left += carried[k, q, c * size + i] * free[q]
                for j in range(size):
                    left -= camera[k, c, i, j] * at[c * size + j]
                    block[c, i, j] += own[k, c, i, j]
                for m in range(border.shape[1]):
                    left -= border[k, m, c * size + i] * at[wide + m]
                pull[c, i] += left
        if row < len(ages) and ages[row] == n + 1:
            for c in range(cameras):
                scores[row, c] = 0.0
                for kind in range(len(parts)):
                    score = _score(pull[c], block[c], change[c], parts[kind, 0], parts[kind, 1])
                    scores[row, c] = max(scores[row, c], score)
            row += 1
    for rest in range(row, len(ages)):
        for c in range(cameras):
            scores[rest, c] = 0.0


@njit(fastmath=kernels.FAST)
def _score(pull, block, change, first, last):
    """Square of the pull on some of a camera's own parameters in units of their information."""
    count, size = last - first, len(pull)
    matrix, right, across = np.zeros((count, count)), np.zeros((count, 1)), np.zeros(size)
    for a in range(count):
        for i in range(size):
            right[a, 0] += change[i, first + a] * pull[i]
            across[i] = 0.0
            for j in range(size):
                across[i] += block[i, j] * change[j, first + a]
        for b in range(count):
            for i in range(size):
                matrix[b, a] += change[i, first + b] * across[i]
    for a in range(count):
        if matrix[a, a] <= 0.0:
            return 0.0
        right[a, 0] /= np.sqrt(matrix[a, a])
    for a in range(count):
        for b in range(count):
            if a != b:
                matrix[a, b] /= np.sqrt(matrix[a, a] * matrix[b, b])
    for a in range(count):
        matrix[a, a] = 1.0 + RIDGE
    score = 0.0
    for a in range(count):  # Cholesky's factor, and the whitened pull along with it
        value = right[a, 0]
        for b in range(a):
            entry = matrix[a, b]
            for c in range(b):
                entry -= matrix[a, c] * matrix[b, c]
            matrix[a, b] = entry / matrix[b, b]
            value -= matrix[a, b] * right[b, 0]
        pivot = matrix[a, a]
        for c in range(a):
            pivot -= matrix[a, c] ** 2
        if pivot <= 0.0:
            return score
        matrix[a, a] = np.sqrt(pivot)
        right[a, 0] = value / matrix[a, a]
        score += right[a, 0] ** 2
    return score


@njit(fastmath=kernels.FAST)
def add_error(rotation, translation, lens, rotation0, translation0, lens0, unit, error):
    """Add the error in units that takes a rig to another one, like `rig_error.error_between`.

    Args:
        rotation: (C, 3, 3) cam_from_rig of the other rig.
        translation: (C, 3) mm.
        lens: (C, 9) focal length, principal point and distortion.
        rotation0: of the rig.
        translation0: of the rig.
        lens0: of the rig.
        unit: (C, P).
        error: (C, P), added to.
    """
    turn, vector, place, place0 = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3)
    for c in range(len(rotation)):
        for i in range(3):
            place[i] = place0[i] = 0.0
            for j in range(3):
                place[i] -= rotation[c, j, i] * translation[c, j]
                place0[i] -= rotation0[c, j, i] * translation0[c, j]
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
            shift = place[i]
            for j in range(3):
                shift -= turn[i, j] * place0[j]
            error[c, 3 + i] += shift / unit[c, 3 + i]
        for i in range(lens.shape[1]):
            error[c, 6 + i] += (lens[c, i] - lens0[c, i]) / unit[c, 6 + i]
