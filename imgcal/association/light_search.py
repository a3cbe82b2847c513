"""Compiled search for unknown markers: positions on which the rays of at least three cameras agree."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from renderers.compiling import njit

REACH = 4.0
"""Maximum distance, in standard deviations of a camera's error, between a blob and a position's image."""
FIRST_REACH = 6.0
"""The same for the midpoint of two rays, which predicts a third camera's view less accurately."""
HIDDEN = 0.25
"""Probability that a camera does not show a marker in its view."""
ROUNDS = 3
"""Iterations of choosing blobs near a position and triangulating it again."""
CERTAIN = 4
"""Number of cameras of a position at which its pairs of rays need no further search."""
MOST_PLACES = 60_000
"""Maximum number of positions at one moment."""
SAME = 8.0
"""Difference of squared distances, in standard deviations, that separates the right blob from another one."""
PASSES = 6
"""Number of passes that give each blob to the best position."""
NEIGHBOUR = 3
"""Index of the neighbour whose distance defines the local density of blobs."""


@njit(cache=True, error_model="numpy", heavy=True)
def find_lights(xy, start, rotation, position, gate, half, least, witnesses, chosen, point, odds, margin):
    """Fill in the markers of one moment, most probable first, and return their number.

    Args:
        xy: (M, 2) blobs ordered by camera, on the plane z = 1 without distortion.
        start: (C + 1,) first blob of each camera.
        rotation: (C, 3, 3) cam_from_rig.
        position: (C, 3) mm.
        gate: (C,) standard deviation of errors of rig and blobs, on the plane z = 1.
        half: (C, 2) half of the camera's view, on the plane z = 1.
        least: minimum log odds of a marker against false blobs.
        witnesses: minimum number of cameras that agree on a marker.
        chosen: (R, C) blob in each camera, -1 = none.
        point: (R, 3) mm.
        odds: (R,) log odds of the marker against false blobs.
        margin: (R,) log odds against the best other marker that uses one of its blobs; inf = there is none.
    """
    cameras, blobs = len(gate), len(xy)
    ray, density = np.empty((blobs, 3)), np.empty(blobs)
    volume = _prepare(xy, start, rotation, position, half, ray, density)
    used = np.zeros(blobs, dtype=np.bool_)
    best, best_odds = np.full(blobs, -1), np.full(blobs, -np.inf)
    most, count = 256, 0
    hits, places, found = np.full((most, cameras), -1), np.empty((most, 3)), np.empty(most)
    hit, place = np.full(cameras, -1), np.empty(3)
    for a in range(cameras):
        for b in range(a + 1, cameras):
            for i in range(start[a], start[a + 1]):
                for j in range(start[b], start[b + 1]):
                    if best[i] >= 0 and best[i] == best[j]:
                        continue
                    if not _meet(ray[i], ray[j], position[a], position[b], gate[a], gate[b], place):
                        continue
                    value, seen = _explore(
                        xy, start, ray, density, rotation, position, gate, half, used, volume, witnesses, place, hit
                    )
                    if seen < witnesses or value < least or count == MOST_PLACES:
                        continue
                    if count == most:
                        most *= 2
                        more_hits, more_places, more = np.full((most, cameras), -1), np.empty((most, 3)), np.empty(most)
                        for k in range(count):
                            more[k] = found[k]
                            for c in range(cameras):
                                more_hits[k, c] = hits[k, c]
                            for axis in range(3):
                                more_places[k, axis] = places[k, axis]
                        hits, places, found = more_hits, more_places, more
                    found[count] = value
                    for axis in range(3):
                        places[count, axis] = place[axis]
                    for c in range(cameras):
                        hits[count, c] = hit[c]
                        if hit[c] >= 0 and value > best_odds[hit[c]] and seen >= CERTAIN:
                            best[hit[c]], best_odds[hit[c]] = count, value
                    count += 1
    owner = np.full(blobs, -1)
    rows, left = 0, count
    order = np.arange(count)
    for turn in range(PASSES):
        order = order[:left]
        order = order[np.argsort(-found[order])]
        left = 0
        for number in range(len(order)):
            k = order[number]
            free = True
            for c in range(cameras):
                if hits[k, c] >= 0 and owner[hits[k, c]] >= 0:
                    free = False
            if free:
                if rows == len(odds):
                    return rows
                for c in range(cameras):
                    chosen[rows, c] = hits[k, c]
                    if hits[k, c] >= 0:
                        owner[hits[k, c]], used[hits[k, c]] = rows, True
                for axis in range(3):
                    point[rows, axis] = places[k, axis]
                odds[rows], margin[rows] = found[k], np.inf
                rows += 1
                continue
            if turn == 0:
                _note_rival(hits[k], found[k], owner, odds, margin, rows)
            for axis in range(3):
                place[axis] = places[k, axis]
            value, seen = _explore(
                xy, start, ray, density, rotation, position, gate, half, used, volume, witnesses, place, hit
            )
            if seen < witnesses or value < least:
                continue
            found[k] = value
            for axis in range(3):
                places[k, axis] = place[axis]
            for c in range(cameras):
                hits[k, c] = hit[c]
            order[left] = k
            left += 1
        if left == 0:
            break
    _drop_doubtful(xy, start, rotation, position, gate, chosen, point, owner, rows)
    return rows


@njit(cache=True, error_model="numpy", heavy=True)
def find_all_lights(xy, start, rotation, position, gate, half, least, witnesses, chosen, point, odds, margin, moment):
    """Do the work of `find_lights` for successive moments: `start` (S, C + 1); return the number of rows.

    `moment` (R,) is filled with the moment of each row; blobs are counted over all moments.
    """
    rows = 0
    for s in range(len(start)):
        first, last = start[s, 0], start[s, -1]
        count = find_lights(
            xy[first:last], start[s] - first, rotation, position, gate, half, least, witnesses,
            chosen[rows:], point[rows:], odds[rows:], margin[rows:],
        )  # fmt: skip
        for row in range(rows, rows + count):
            moment[row] = s
            for c in range(chosen.shape[1]):
                if chosen[row, c] >= 0:
                    chosen[row, c] += first
        rows += count
    return rows


@njit(cache=True, error_model="numpy", heavy=True)
def _prepare(xy, start, rotation, position, half, ray, density):
    """Fill in unit rays in the rig's frame and the local densities of blobs; return the volume of positions, mm^3."""
    cameras = len(position)
    mean = np.zeros(3)
    for c in range(cameras):
        for axis in range(3):
            mean[axis] += position[c, axis] / cameras
    apart = 0.0
    for c in range(cameras):
        apart = max(apart, _length(position[c, 0] - mean[0], position[c, 1] - mean[1], position[c, 2] - mean[2]))
        count = start[c + 1] - start[c]
        least = max(count, 1) / (4 * half[c, 0] * half[c, 1])
        for i in range(start[c], start[c + 1]):
            x, y = xy[i, 0], xy[i, 1]
            length = math.sqrt(x * x + y * y + 1)
            for axis in range(3):
                ray[i, axis] = (rotation[c, 0, axis] * x + rotation[c, 1, axis] * y + rotation[c, 2, axis]) / length
            first, second, third = np.inf, np.inf, np.inf
            for j in range(start[c], start[c + 1]):
                if j != i:
                    away = (xy[j, 0] - x) ** 2 + (xy[j, 1] - y) ** 2
                    if away < first:
                        first, second, third = away, first, second
                    elif away < second:
                        second, third = away, second
                    elif away < third:
                        third = away
            density[i] = max(least, NEIGHBOUR / (math.pi * third) if third > 0 and third < np.inf else least)
    return max(apart, 1.0) ** 3


@njit(cache=True, error_model="numpy", heavy=True)
def _length(x, y, z):
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, error_model="numpy", heavy=True)
def _meet(d1, d2, p1, p2, gate1, gate2, place):
    """Tell whether two rays nearly meet in front of both cameras, and fill in the midpoint."""
    bx, by, bz = p2[0] - p1[0], p2[1] - p1[1], p2[2] - p1[2]
    cosine = d1[0] * d2[0] + d1[1] * d2[1] + d1[2] * d2[2]
    sine = 1 - cosine * cosine
    if sine < 1e-3:
        return False
    one, two = bx * d1[0] + by * d1[1] + bz * d1[2], bx * d2[0] + by * d2[1] + bz * d2[2]
    along1, along2 = (one - two * cosine) / sine, (one * cosine - two) / sine
    if along1 <= 0 or along2 <= 0:
        return False
    x1, y1, z1 = p1[0] + along1 * d1[0], p1[1] + along1 * d1[1], p1[2] + along1 * d1[2]
    x2, y2, z2 = p2[0] + along2 * d2[0], p2[1] + along2 * d2[1], p2[2] + along2 * d2[2]
    gap = (x1 - x2) ** 2 + (y1 - y2) ** 2 + (z1 - z2) ** 2
    if gap > REACH**2 * ((along1 * gate1) ** 2 + (along2 * gate2) ** 2):
        return False
    place[0], place[1], place[2] = (x1 + x2) / 2, (y1 + y2) / 2, (z1 + z2) / 2
    return True


@njit(cache=True, error_model="numpy", heavy=True)
def _explore(xy, start, ray, density, rotation, position, gate, half, used, volume, witnesses, place, hit):
    """Alternate between choosing blobs near a position and triangulating it from them; return log odds and cameras."""
    seen, value, information = 0, -np.inf, np.empty((3, 3))
    for turn in range(ROUNDS + 1):
        reach = FIRST_REACH if turn == 0 else REACH
        value, before = 0.0, seen
        seen = 0
        for c in range(len(gate)):
            hit[c] = -1
            x, y, depth = _image(rotation[c], position[c], place)
            if depth <= 1.0:
                continue
            nearest, least = -1, (reach * gate[c]) ** 2
            for i in range(start[c], start[c + 1]):
                if not used[i]:
                    away = (xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2
                    if away < least:
                        nearest, least = i, away
            if nearest >= 0:
                hit[c] = nearest
                seen += 1
                variance = gate[c] ** 2
                value += math.log((1 - HIDDEN) / (2 * math.pi * variance * density[nearest])) - 0.5 * least / variance
            elif abs(x) < half[c, 0] and abs(y) < half[c, 1]:
                value += math.log(HIDDEN)
        if seen < 2 or (turn == 1 and seen < witnesses and before < witnesses):
            return -np.inf, seen
        if turn == ROUNDS:
            break
        if not _solve(ray, position, gate, hit, place, information):
            return -np.inf, 0
    determinant = _determinant(information)
    if determinant <= 0:
        return -np.inf, 0
    return value + 1.5 * math.log(2 * math.pi) - 0.5 * math.log(determinant) - math.log(volume), seen


@njit(cache=True, error_model="numpy", heavy=True)
def _image(rotation, position, place):
    """A position on the plane z = 1 of a camera, and its depth."""
    x, y, z = place[0] - position[0], place[1] - position[1], place[2] - position[2]
    depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
    across = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    return across / depth, down / depth, depth


@njit(cache=True, error_model="numpy", heavy=True)
def _solve(ray, position, gate, hit, place, information):
    """Move a position to where its rays pass nearest, and fill in its information (3, 3), 1 / mm^2."""
    target = np.zeros(3)
    information[:] = 0.0
    for c in range(len(gate)):
        if hit[c] < 0:
            continue
        d = ray[hit[c]]
        away = (place[0] - position[c, 0]) ** 2 + (place[1] - position[c, 1]) ** 2 + (place[2] - position[c, 2]) ** 2
        weight = 1 / (max(away, 1.0) * gate[c] ** 2)
        for i in range(3):
            for j in range(3):
                part = weight * ((1.0 if i == j else 0.0) - d[i] * d[j])
                information[i, j] += part
                target[i] += part * position[c, j]
    determinant = _determinant(information)
    trace = information[0, 0] + information[1, 1] + information[2, 2]
    if not determinant > 1e-12 * trace**3:
        return False
    a, b, c_ = information[0], information[1], information[2]
    t0, t1, t2 = target
    x = t0 * (b[1] * c_[2] - b[2] * c_[1]) - a[1] * (t1 * c_[2] - b[2] * t2) + a[2] * (t1 * c_[1] - b[1] * t2)
    y = a[0] * (t1 * c_[2] - b[2] * t2) - t0 * (b[0] * c_[2] - b[2] * c_[0]) + a[2] * (b[0] * t2 - t1 * c_[0])
    z = a[0] * (b[1] * t2 - t1 * c_[1]) - a[1] * (b[0] * t2 - t1 * c_[0]) + t0 * (b[0] * c_[1] - b[1] * c_[0])
    place[0], place[1], place[2] = x / determinant, y / determinant, z / determinant
    return True


@njit(cache=True, error_model="numpy", heavy=True)
def _determinant(m):
    return (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )


@njit(cache=True, error_model="numpy", heavy=True)
def _note_rival(hits, value, owner, odds, margin, rows):
    """Lower the margin of markers whose blobs another one would combine with at least two others."""
    total = 0
    for c in range(len(hits)):
        total += hits[c] >= 0
    for row in range(rows):
        shared = 0
        for c in range(len(hits)):
            shared += hits[c] >= 0 and owner[hits[c]] == row
        if shared > 0 and total - shared >= 2:
            margin[row] = min(margin[row], odds[row] - value)


@njit(cache=True, error_model="numpy", heavy=True)
def _drop_doubtful(xy, start, rotation, position, gate, chosen, point, owner, rows):
    """Remove blobs if a blob nearby may equally be the marker, alone or in exchange."""
    doubtful = np.zeros((rows, len(gate)), dtype=np.bool_)
    for row in range(rows):
        for c in range(len(gate)):
            mine = chosen[row, c]
            if mine < 0:
                continue
            x, y, _ = _image(rotation[c], position[c], point[row])
            variance = gate[c] ** 2
            own = ((xy[mine, 0] - x) ** 2 + (xy[mine, 1] - y) ** 2) / variance
            for i in range(start[c], start[c + 1]):
                if i == mine:
                    continue
                other = ((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) / variance
                if owner[i] < 0:
                    if other < own + SAME:
                        doubtful[row, c] = True
                elif other < own + SAME + REACH**2:
                    theirs = owner[i]
                    x2, y2, _ = _image(rotation[c], position[c], point[theirs])
                    kept = ((xy[i, 0] - x2) ** 2 + (xy[i, 1] - y2) ** 2) / variance
                    exchanged = ((xy[mine, 0] - x2) ** 2 + (xy[mine, 1] - y2) ** 2) / variance
                    if other + exchanged < own + kept + SAME:
                        doubtful[row, c] = True
    for row in range(rows):
        for c in range(len(gate)):
            if doubtful[row, c]:
                chosen[row, c] = -1
