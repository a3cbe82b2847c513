"""Candidate poses of planar objects with so many fiducials that not all triples can be tried.

Seen from a distance, a plane's image is an affine image. Whitened (shifted and stretched to zero mean and unit
covariance) blobs and fiducials therefore differ by a rotation only, so one angle is all there is to search. That
needs nearly all of the plane in view. A lattice is grown from a few neighbours, whatever hides the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from imgcal.association.ambiguities import lattice_shifts
from imgcal.association.blobs import PaddedBlobs
from imgcal.association.hypotheses import Poses
from imgcal.types import CalibrationObject, CameraRig

Floats = NDArray[np.float64]

ANGLES = 180  # angles to try; half a step moves the rim of the pattern by 1/60 of its width
GROWN = 12  # number of best angles to refine to homographies

Cells = dict[tuple[int, int], int]
"""Blob by its column and row in a lattice."""

NEIGHBOURS = 8  # of a blob, among which its steps are looked for
LEAST_ANGLE = 0.5  # sine between the two steps
REACH = 0.25  # steps that a blob may be off where its neighbours expect it
LEAST_AROUND = 5  # of the eight cells around a blob, for a lattice to be grown from there
LEAST_SHARE = 0.15  # of the fiducials, that a lattice must show
SEEDS = 12  # blobs that lattices are grown from
AROUND = np.array([cell for cell in product((-1, 0, 1), repeat=2) if cell != (0, 0)])
STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))
TURNS = [
    np.array(entries).reshape(2, 2)
    for entries in product((-1, 0, 1), repeat=4)
    if abs(entries[0] * entries[3] - entries[1] * entries[2]) == 1
]
"""Steps of the image in steps of the object: turned, mirrored, or along a diagonal that is foreshortened."""
CLOSE = 0.9  # of the best placement's fiducials, that another one must show
MOST_PLACEMENTS = 16  # of a lattice, that poses are made of


def planar_poses(blobs: PaddedBlobs, rig: CameraRig, camera: int, obj: CalibrationObject) -> Iterator[Poses]:
    """Find poses under which one camera's blobs look like a planar object: by its lattice, then by its whole shape.

    Args:
        blobs: the snapshot.
        rig: factory rig.
        camera: index of the camera.
        obj: a planar object.

    Yields:
        Poses that explain different sets of blobs, possibly none; a lattice has several, those with most blobs first.
    """
    focal = float(rig.focal_length[camera].mean())
    count = blobs.count[camera]
    ordinary = _has_usual_radius(blobs.radius[camera, :count])
    every = blobs.ideal[camera, :count][ordinary].astype(np.float64) / focal
    points = obj.points.double().cpu().numpy()
    centroid = points.mean(0)
    axes = np.linalg.svd(points - centroid)[2]
    axes[2] = np.cross(axes[0], axes[1])
    flat = (points - centroid) @ axes[:2].T
    yield _poses(rig, camera, _lattice_homographies(flat, _lattice_steps(obj, axes), every), axes, centroid)
    yield _poses(rig, camera, _whole_homographies(flat, _drop_strays(every)), axes, centroid)


def _poses(rig: CameraRig, camera: int, homographies: list[Floats], axes: Floats, centroid: Floats) -> Poses:
    """Poses of an object whose plane has axes (3, 3) and centroid (3,), from images of the plane in one camera."""
    poses = [_pose(homography) for homography in homographies]
    cam_from_rig, offset = rig.cam_from_rig.rotation[camera].numpy(), rig.cam_from_rig.translation[camera].numpy()
    rotation = np.array([cam_from_rig.T @ r @ axes for r, _ in poses]).reshape(-1, 3, 3)
    centre = np.array([cam_from_rig.T @ (t - offset) for _, t in poses]).reshape(-1, 3)
    return Poses(rotation, centre - rotation @ centroid)


def _whole_homographies(flat: Floats, seen: Floats) -> list[Floats]:
    """Find homographies (3, 3) from fiducials (N, 2) to blobs (M, 2), nearly all of which must be in view."""
    tree, homographies = cKDTree(seen), []
    for turn in (1.0, -1.0):  # the front of the plane, and its back
        for angle in _best_angles(_whiten(flat * [1, turn])[0], _whiten(seen)[0]):
            homography = _grow(flat, tree, _affinity(flat * [1, turn], seen, angle) @ np.diag([1, turn, 1]))
            if homography is not None:
                homographies.append(homography)
    return homographies


def _has_usual_radius(radius: Floats) -> NDArray[np.bool_]:
    """Mark blobs of about the usual radius, or of unknown radius."""
    if np.isnan(radius).all():
        return np.ones(len(radius), dtype=bool)
    ratio = radius / np.nanmedian(radius)
    return np.isnan(radius) | ((ratio > 0.6) & (ratio < 1.7))


def _drop_strays(points: Floats) -> Floats:
    """Repeatedly remove points far from the bulk: a whitened square extends to the square root of 6."""
    for _ in range(5):
        white = _whiten(points)[0]
        points = points[(white * white).sum(1) < 2.7**2]
    return points


def _whiten(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return whitened points (N, 2), their mean (2,) and the root of their covariance (2, 2)."""
    mean = points.mean(0)
    values, vectors = np.linalg.eigh(np.cov((points - mean).T))
    root = (vectors * np.sqrt(values)) @ vectors.T
    return (points - mean) @ np.linalg.inv(root), mean, root


def _rotation(angle: float) -> Floats:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _best_angles(pattern: Floats, seen: Floats) -> Floats:
    """Angles that best align the whitened pattern with the whitened blobs."""
    angles: Floats = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False, dtype=np.float64)
    turned = np.concatenate([pattern @ _rotation(angle).T for angle in angles])
    distance = cKDTree(seen).query(turned)[0].reshape(ANGLES, -1)
    misfit = np.minimum(distance, 0.3).mean(1)
    return angles[np.argsort(misfit)[:GROWN]]


def _affinity(pattern: Floats, seen: Floats, angle: float) -> Floats:
    """The affine map (3, 3) from pattern to blobs, for a rotation of the whitened pattern."""
    _, mean, root = _whiten(pattern)
    _, seen_mean, seen_root = _whiten(seen)
    result = np.eye(3)
    result[:2, :2] = seen_root @ _rotation(angle) @ np.linalg.inv(root)
    result[:2, 2] = seen_mean - result[:2, :2] @ mean
    return result


def _grow(flat: Floats, tree: cKDTree, homography: Floats) -> Floats | None:
    """Pair each fiducial with the nearest blob and fit again; None if most have no blob of their own."""
    spacing = float(np.median(tree.query(tree.data, k=2)[0][:, 1]))
    for reach in (1.0, 0.8, 0.6, 0.5, 0.4, 0.3, 0.3, 0.3):
        image = np.c_[flat, np.ones(len(flat))] @ homography.T
        distance, blob = tree.query(image[:, :2] / image[:, 2:])
        paired = distance < reach * spacing
        if paired.sum() < 0.5 * len(flat) or len(np.unique(blob[paired])) < 0.5 * len(flat):
            return None
        homography = _fit_homography(flat[paired], np.asarray(tree.data)[blob[paired]])
    return homography


def _fit_homography(source: Floats, target: Floats) -> Floats:
    """Direct linear transform (N >= 4 points), in whitened coordinates."""
    a, mean_a, root_a = _whiten(source)
    b, mean_b, root_b = _whiten(target)
    one, zero = np.c_[a, np.ones(len(a))], np.zeros((len(a), 3))
    rows = np.concatenate((np.c_[one, zero, -b[:, :1] * one], np.c_[zero, one, -b[:, 1:] * one]))
    inner = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    left, right = np.eye(3), np.eye(3)
    left[:2, :2], left[:2, 2] = root_b, mean_b
    right[:2, :2] = np.linalg.inv(root_a)
    right[:2, 2] = -right[:2, :2] @ mean_a
    result = left @ inner @ right
    return result / result[2, 2]


def _pose(homography: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) of a plane z = 0 from its image on the z = 1 plane.

    Source: Zhang 2000, "A Flexible New Technique for Camera Calibration", section 3.1.
    """
    scale = np.sqrt(np.linalg.norm(homography[:, 0]) * np.linalg.norm(homography[:, 1]))
    x, y, translation = (homography / scale).T
    u, _, vh = np.linalg.svd(np.stack((x, y, np.cross(x, y)), axis=1))
    return u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh, translation


def _lattice_steps(obj: CalibrationObject, axes: Floats) -> Floats | None:
    """Two steps (2, 2) of the object's lattice in its plane; None = it is no lattice."""
    shifts = [shift.translation @ axes[:2].T for shift in lattice_shifts(obj)]
    for other in shifts[1:]:
        first = shifts[0]
        if abs(first[0] * other[1] - first[1] * other[0]) > LEAST_ANGLE * np.linalg.norm(first) * np.linalg.norm(other):
            return np.stack((first, other))
    return None


def _lattice_homographies(flat: Floats, steps: Floats | None, seen: Floats) -> list[Floats]:
    """Find homographies under which blobs are fiducials of a planar lattice, most fiducials first.

    Args:
        flat: (N, 2) fiducials in their plane.
        steps: (2, 2) two steps of the lattice, one a row; None = it is no lattice.
        seen: (M, 2) blobs of one camera, on the plane z = 1.

    Returns:
        Maps (3, 3) from `flat` to blobs, of different placements; none where no lattice shows.
    """
    if steps is None or len(seen) < NEIGHBOURS + 1:
        return []
    numbers = np.rint((flat - flat[0]) @ np.linalg.inv(steps)).astype(np.int64)
    tree, taken, found = cKDTree(seen), np.zeros(len(seen), dtype=bool), []
    for blob, frame in _seeds(seen, tree):
        if taken[blob]:
            continue
        cells = _spread(_follow(seen, tree, blob, frame), seen, tree)
        taken[list(cells.values())] = True
        if len(cells) >= max(NEIGHBOURS, LEAST_SHARE * len(flat)):
            found.append(cells)
    placed = [each for cells in found for each in _place(cells, numbers)]
    placed.sort(key=lambda each: -len(each[0]))
    return [
        _fit_homography(flat[fiducial], seen[blob])
        for fiducial, blob in placed[:MOST_PLACEMENTS]
        if len(fiducial) >= CLOSE * len(placed[0][0])
    ]


def _seeds(seen: Floats, tree: cKDTree) -> list[tuple[int, Floats]]:
    """Blobs with their two steps (2, 2), those with the fullest neighbourhood first."""
    near = tree.query(seen, k=NEIGHBOURS + 1)[1][:, 1:]
    steps = seen[near] - seen[:, None]  # (M, 8, 2)
    length = np.linalg.norm(steps, axis=2)
    i, j = np.triu_indices(NEIGHBOURS, 1)
    across = np.abs(steps[:, i, 0] * steps[:, j, 1] - steps[:, i, 1] * steps[:, j, 0])
    blob, pair = np.nonzero(across >= LEAST_ANGLE * length[:, i] * length[:, j])
    i, j = i[pair], j[pair]
    frames = np.stack((steps[blob, i], steps[blob, j]), axis=1)  # (P, 2, 2)
    around = AROUND @ frames + seen[blob, None]
    reach = REACH * np.minimum(length[blob, i], length[blob, j])
    there = (tree.query(around)[0] < reach[:, None]).sum(1)
    # The fullest neighbourhood of each blob, the shortest steps of equals.
    order = np.lexsort((length[blob, i] + length[blob, j], -there, blob))
    order = order[there[order] >= LEAST_AROUND]
    order = order[np.unique(blob[order], return_index=True)[1]]
    order = order[np.argsort(-there[order], kind="stable")]
    ranked = [(int(blob[k]), frames[k]) for k in order]
    # Spread over the image, so that clutter around one of them does not decide.
    return ranked[:: max(len(ranked) // SEEDS, 1)]


def _follow(seen: Floats, tree: cKDTree, blob: int, frame: Floats) -> Cells:
    """Follow steps from blob to blob; each carries its own two steps (2, 2), which change slowly."""
    cells: Cells = {(0, 0): blob}
    frames = {(0, 0): frame}
    open_cells, used = [(0, 0)], {blob}
    while open_cells:
        cell = open_cells.pop(0)
        here, steps = seen[cells[cell]], frames[cell]
        for direction in STEPS:
            there = (cell[0] + direction[0], cell[1] + direction[1])
            if there in cells:
                continue
            step = direction @ steps
            distance, other = tree.query(here + step)
            if distance > REACH * np.linalg.norm(step) or other in used:
                continue
            cells[there], own = int(other), steps.copy()
            used.add(int(other))
            axis = 0 if direction[0] else 1
            own[axis] = 0.5 * (own[axis] + sum(direction) * (seen[other] - here))
            frames[there] = own
            open_cells.append(there)
    return cells


def _spread(cells: Cells, seen: Floats, tree: cKDTree) -> Cells:
    """Fit a homography to the cells and look where it puts all others, also beyond what hides some."""
    for _ in range(3):
        if len(cells) < NEIGHBOURS:
            return cells
        numbers, blobs = np.array(list(cells)), np.array(list(cells.values()))
        homography = _fit_homography(numbers.astype(np.float64), seen[blobs])
        low, high = numbers.min(0) - 2, numbers.max(0) + 3
        every = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
        place = _apply(homography, every)
        size = np.linalg.norm(_apply(homography, every + np.array(STEPS[0])) - place, axis=1)
        size = np.minimum(size, np.linalg.norm(_apply(homography, every + np.array(STEPS[1])) - place, axis=1))
        distance, other = tree.query(place)
        good = distance < REACH * size
        # A blob that two cells claim is of the nearer one.
        order = np.argsort(distance, kind="stable")
        order = order[good[order]]
        order = order[np.sort(np.unique(other[order], return_index=True)[1])]
        cells = {(int(every[k, 0]), int(every[k, 1])): int(other[k]) for k in order}
    return cells


def _place(cells: Cells, numbers: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Lay the object's lattice on the grown one every way that shows most fiducials: fiducials and their blobs."""
    seen, blobs = np.array(list(cells)), np.array(list(cells.values()))
    index = {(int(i), int(j)): fiducial for fiducial, (i, j) in enumerate(numbers)}
    placements: list[tuple[int, NDArray[np.int64], NDArray[np.int64]]] = []
    for turn in TURNS:
        turned = seen @ turn
        counts, low = _count_shifts(turned, numbers)
        for shift in np.argwhere(counts >= CLOSE * counts.max()):
            placements.append((int(counts[tuple(shift)]), turn, low + shift))
    most, covers, result = max(count for count, _, _ in placements), set(), []
    for count, turn, shift in placements:
        if count < CLOSE * most:
            continue
        cells_covered = (numbers - shift) @ np.rint(np.linalg.inv(turn)).astype(np.int64)
        covered = cells_covered[np.lexsort(cells_covered.T)].tobytes()
        if covered in covers:
            continue  # turns of a symmetric object onto itself are one
        covers.add(covered)
        where = seen @ turn + shift
        fiducial = np.array([index.get((int(i), int(j)), -1) for i, j in where])
        result.append((fiducial[fiducial >= 0], blobs[fiducial >= 0]))
    return result


def _count_shifts(source: NDArray[np.int64], target: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Count the pairs of cells (N, 2), (M, 2) that each shift takes onto each other, and give the least shift (2,)."""
    first, low = source.max(0), target.min(0)
    shape = tuple((np.ptp(source, axis=0) + np.ptp(target, axis=0) + 1).tolist())
    images = np.zeros((2, *shape))
    images[0][tuple((first - source).T)] = 1
    images[1][tuple((target - low).T)] = 1
    return np.rint(np.fft.irfft2(np.fft.rfft2(images).prod(0), shape)).astype(np.int64), low - first


def _apply(homography: Floats, points: Floats) -> Floats:
    image = np.c_[points, np.ones(len(points))] @ homography.T
    return np.asarray(image[:, :2] / image[:, 2:])
