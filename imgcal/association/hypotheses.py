"""Candidate poses: blob triples of one camera matched to all fiducial triples, tested on the camera's other blobs."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from imgcal.association.blobs import PaddedBlobs
from imgcal.association.p3p import FAST, rotation_towards, three_point_pose
from imgcal.types import CalibrationObject, CameraRig
from renderers.compiling import njit

MOST_TRIPLES = 40_000  # maximum number of fiducial triples to try them all
FEW_TRIPLES = 1_000  # maximum number of fiducial triples to try without trying the edges of the hull first
MOST_FIDUCIAL_TRIPLES = 300_000  # of the outer fiducials; beyond that, a random subset is used
DRAWS = 3  # blob triples drawn, to use the widest
PROBES = 8  # fiducials for the first test of a hypothesis; only promising ones are tested on all
CELLS = 4  # raster cells per tolerance
MOST_CELLS = 512  # across the blobs; larger cells also increase the tolerance


@dataclass(frozen=True)
class FiducialTriples:
    """Ordered triples of fiducials, one of each set that the object's symmetry makes equivalent."""

    triples: NDArray[np.int64]  # (T, 3)
    sides: NDArray[np.float64]  # (T, 3) mm^2, squared distances 0-1, 0-2, 1-2
    frames: NDArray[np.float64]  # (T, 3, 3) columns: along the first side, in the plane, normal
    points: NDArray[np.float64]  # (N, 3) mm
    order: NDArray[np.int64]  # (N,) random order for testing a hypothesis


@dataclass(frozen=True)
class Poses:
    """Candidate poses of the object."""

    rotation: NDArray[np.float64]  # (K, 3, 3) rig_from_object
    translation: NDArray[np.float64]  # (K, 3) mm

    def __len__(self) -> int:
        return len(self.rotation)

    def select(self, rows: NDArray[np.int64]) -> Poses:
        """Keep the given rows."""
        return Poses(self.rotation[rows], self.translation[rows])

    def __add__(self, other: Poses) -> Poses:
        return Poses(
            np.concatenate((self.rotation, other.rotation)), np.concatenate((self.translation, other.translation))
        )


def fiducial_triples(obj: CalibrationObject, generator: np.random.Generator) -> FiducialTriples:
    """List the triples to try: all of them; if there are many, those of the outer fiducials, or a random subset of
    these.
    """
    points = obj.points.double().cpu().numpy()
    count = len(points)
    symmetries = tuple(motion.permutation.astype(np.int64).tobytes() for motion in obj.symmetries)
    outer = has_many_triples(obj) and not obj.planar
    found = _every_triple(points.tobytes(), symmetries, outer)
    if found is None:
        among = _outer(points, outer)
        triples = among[generator.integers(0, len(among), (MOST_FIDUCIAL_TRIPLES, 3))]
        found = _drop_symmetric(points, triples[(triples != np.roll(triples, 1, axis=1)).all(1)], symmetries)
    return FiducialTriples(*found, points, generator.permutation(count))


def edge_triples(obj: CalibrationObject, generator: np.random.Generator) -> FiducialTriples | None:
    """List edges of the object's convex hull, each with every third outer fiducial; None = all triples are few.

    Neighbours on the hull of an image are an edge of the hull in space. They are the quickest try if little is hidden.
    """
    points = obj.points.double().cpu().numpy()
    if obj.planar or _orders(len(points)) <= FEW_TRIPLES:
        return None
    symmetries = tuple(motion.permutation.astype(np.int64).tobytes() for motion in obj.symmetries)
    found, outer = _edge_triples(points.tobytes(), symmetries)
    inner = np.setdiff1d(np.arange(len(points)), outer)
    order = np.concatenate((generator.permutation(outer), generator.permutation(inner)))
    return FiducialTriples(*found, points, order)


@lru_cache(maxsize=4)
def _edge_triples(coordinates: bytes, symmetries: tuple[bytes, ...]) -> tuple[Triples, NDArray[np.int64]]:
    """Triples, sides and frames of `edge_triples`, and the outer fiducials, once per object."""
    points = np.frombuffer(coordinates).reshape(-1, 3)
    hull = ConvexHull(points)
    edges = np.unique(np.concatenate([hull.simplices[:, pair] for pair in permutations(range(3), 2)]), axis=0)
    count = len(hull.vertices)
    triples = np.column_stack((edges.repeat(count, axis=0), np.tile(hull.vertices, len(edges))))
    triples = triples[(triples[:, :2] != triples[:, 2:]).all(1)]
    return _drop_symmetric(points, triples, symmetries), hull.vertices


Triples = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]
"""Triples, sides and frames of `FiducialTriples`."""


@lru_cache(maxsize=4)
def _every_triple(coordinates: bytes, symmetries: tuple[bytes, ...], outer: bool) -> Triples | None:
    """All ordered triples, computed once per object: snapshots are many, objects few. None = too many."""
    points = np.frombuffer(coordinates).reshape(-1, 3)
    among = _outer(points, outer)
    if _orders(len(among)) > MOST_FIDUCIAL_TRIPLES:
        return None
    return _drop_symmetric(points, among[list(permutations(range(len(among)), 3))], symmetries)


def _outer(points: NDArray[np.float64], outer: bool) -> NDArray[np.int64]:
    """Fiducials to use in triples: the outermost ones, or all."""
    return ConvexHull(points).vertices if outer else np.arange(len(points))


def _drop_symmetric(points: NDArray[np.float64], triples: NDArray[np.int64], symmetries: tuple[bytes, ...]) -> Triples:
    """Triples (T, 3) that are not collinear, one of each set of equivalent ones, and their shape."""
    count = len(points)
    if len(symmetries) > 1:
        permuted = np.stack([np.frombuffer(motion, dtype=np.int64)[triples] for motion in symmetries])  # (G, T, 3)
        triples = triples[(permuted @ [count * count, count, 1]).argmin(0) == 0]
    a, b = points[triples[:, 1]] - points[triples[:, 0]], points[triples[:, 2]] - points[triples[:, 0]]
    normal = np.cross(a, b)
    area = np.linalg.norm(normal, axis=1)
    wide = area > 1e-3 * area.max()
    triples, a, b, normal = triples[wide], a[wide], b[wide], normal[wide] / area[wide, None]
    along = a / np.linalg.norm(a, axis=1, keepdims=True)
    frames = np.stack((along, np.cross(normal, along), normal), axis=-1)
    sides = np.stack([(side * side).sum(1) for side in (a, b, a - b)], axis=1)
    return triples, sides, frames


def has_many_triples(obj: CalibrationObject) -> bool:
    """Tell whether the object has too many triples to try.

    If so, only outer blobs are matched with outer fiducials: what is outermost in an image is so in space.
    """
    return _orders(obj.num_fiducials) > MOST_TRIPLES


def _orders(count: int) -> int:
    """Number of ordered triples."""
    return count * (count - 1) * (count - 2)


def likely_blobs(blobs: PaddedBlobs, camera: int, outer: bool) -> NDArray[np.int64]:
    """List the blobs of a camera that are probably fiducials: those close to others.

    Args:
        blobs: the snapshot.
        camera: index of the camera, which has at least four blobs.
        outer: take the outermost blobs only, in their order around the image; see `has_many_triples`.
    """
    uv = blobs.ideal[camera, : blobs.count[camera]].astype(np.float64)
    gaps = cKDTree(uv).query(uv, k=4)[0][:, -1]
    dense = np.flatnonzero(gaps <= (4 if outer else 2) * np.sort(gaps)[len(uv) // 4])  # sparser at the rim
    if len(dense) < 4:
        dense = np.argsort(gaps)[:4]
    return dense[ConvexHull(uv[dense], qhull_options="QJ").vertices] if outer else dense


def blob_triples(
    uv: NDArray[np.floating],
    likely: NDArray[np.int64],
    count: int,
    generator: np.random.Generator,
    neighbours: bool = False,
) -> NDArray[np.int64]:
    """Draw triples of blobs (count, 3) that are wide enough.

    Args:
        uv: (M, 2) pixels, the blobs of a camera.
        likely: (L >= 3,) blobs to draw from.
        count: number of triples.
        generator: source of randomness.
        neighbours: the first two of each triple follow each other in `likely`, or are its last and first.
    """
    # Draw three different numbers: each counts among the remaining ones and is moved past those already drawn.
    drawn = generator.integers(0, len(likely) - np.arange(3), (DRAWS * count, 3))
    if neighbours:
        drawn[:, 1] = (drawn[:, 0] + 1) % len(likely)
    else:
        drawn[:, 1] += drawn[:, 1] >= drawn[:, 0]
    taken = np.sort(drawn[:, :2], axis=1)
    drawn[:, 2] += drawn[:, 2] >= taken[:, 0]
    drawn[:, 2] += drawn[:, 2] >= taken[:, 1]
    drawn = likely[drawn]
    at = uv.astype(np.float64)[drawn]
    a, b = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).reshape(DRAWS, count)
    return drawn.reshape(DRAWS, count, 3)[area.argmax(0), np.arange(count)]


def single_camera_poses(
    blobs: PaddedBlobs,
    rig: CameraRig,
    cameras: NDArray[np.int64],
    triples: NDArray[np.int64],
    fiducials: FiducialTriples,
    tolerance: float,
    keep: int,
) -> Poses:
    """Find poses under which the blobs of one camera look like the object, for several blob triples at once.

    Args:
        blobs: the snapshot.
        rig: factory rig.
        cameras: (Q,) camera of each triple.
        triples: (Q, 3) blobs.
        fiducials: triples to match them with.
        tolerance: minimum distance (px) within which a predicted fiducial counts as seen.
        keep: number of poses to keep for each blob triple.
    """
    focal = rig.focal_length.numpy().mean(-1)
    rays = blobs.ideal[cameras[:, None], triples].astype(np.float64) / focal[cameras, None, None]
    seen = blobs.ideal[blobs.row >= 0]
    cell = max(tolerance / CELLS, float(np.ptp(seen, axis=0).max()) / MOST_CELLS)
    origin = np.zeros((len(blobs.count), 2))
    count = np.zeros_like(blobs.count)
    count[cameras] = blobs.count[cameras]
    raster = _rasterize(blobs.ideal, count, cell, origin)
    score = np.zeros((len(triples), keep))
    rotation, translation = np.zeros((len(triples), keep, 3, 3)), np.zeros((len(triples), keep, 3))
    _search(
        (*rotation_towards(rays), cameras),
        (fiducials.triples, fiducials.sides, fiducials.frames, fiducials.points, fiducials.order),
        (focal, raster, origin, 1 / cell),
        (score, rotation, translation),
    )
    found = score > 0
    camera = np.broadcast_to(cameras[:, None], found.shape)[found]
    back = rig.cam_from_rig.rotation.mT.numpy()[camera]
    offset = rig.cam_from_rig.translation.numpy()[camera]
    return Poses(back @ rotation[found], (back @ (translation[found] - offset)[..., None])[..., 0])


@njit(cache=True, fastmath=FAST)
def _search(blobs, fiducials, images, poses):
    """Fill in the best poses (in the camera's frame) of each blob triple.

    Args:
        blobs: for each triple, the rays as turned by `rotation_towards`, its rotations, and the camera.
        fiducials: triples, sides, frames, points and order of `FiducialTriples`.
        images: for each camera, focal length, raster of the blobs and its origin; cells per pixel.
        poses: score, rotation and translation of the best ones, best first.
    """
    rays, directions, cameras = blobs
    triples, sides, frames, points, order = fiducials
    focal, raster, origin, per_pixel = images
    score, rotation, translation = poses
    for q in range(len(rays)):
        camera = cameras[q]
        frame, depths, turn = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        for t in range(len(triples)):
            for mirror in (1.0, -1.0):
                if not three_point_pose(rays[q], directions[q], sides[t], mirror, frame, depths):
                    continue
                for i in range(3):
                    for j in range(3):
                        turn[i, j] = (
                            frame[i, 0] * frames[t, j, 0]
                            + frame[i, 1] * frames[t, j, 1]
                            + frame[i, 2] * frames[t, j, 2]
                        )
                p = points[triples[t, 0]]
                x = directions[q, 0, 0] * depths[0] - turn[0, 0] * p[0] - turn[0, 1] * p[1] - turn[0, 2] * p[2]
                y = directions[q, 0, 1] * depths[0] - turn[1, 0] * p[0] - turn[1, 1] * p[1] - turn[1, 2] * p[2]
                z = directions[q, 0, 2] * depths[0] - turn[2, 0] * p[0] - turn[2, 1] * p[1] - turn[2, 2] * p[2]
                image = (focal[camera], raster[camera], origin[camera], per_pixel)
                value = _score_pose(turn, (x, y, z), points, order, image, score[q, -1])
                if value > score[q, -1]:
                    place = len(score[q]) - 1
                    while place > 0 and score[q, place - 1] < value:
                        score[q, place] = score[q, place - 1]
                        for i in range(3):
                            translation[q, place, i] = translation[q, place - 1, i]
                            for j in range(3):
                                rotation[q, place, i, j] = rotation[q, place - 1, i, j]
                        place -= 1
                    score[q, place] = value
                    translation[q, place, 0], translation[q, place, 1], translation[q, place, 2] = x, y, z
                    for i in range(3):
                        for j in range(3):
                            rotation[q, place, i, j] = turn[i, j]


@njit(cache=True, fastmath=FAST)
def _score_pose(turn, shift, points, order, image, least):
    """Sum, over fiducials, their nearness to a blob; stop early if `least` cannot, or will probably not, be reached."""
    x, y, z = shift
    focal, raster, origin, per_pixel = image
    height, width = raster.shape
    total = np.float64(0)
    for i in range(len(order)):
        p = points[order[i]]
        depth = turn[2, 0] * p[0] + turn[2, 1] * p[1] + turn[2, 2] * p[2] + z
        if depth > 1:
            scale = focal / depth
            u = (scale * (turn[0, 0] * p[0] + turn[0, 1] * p[1] + turn[0, 2] * p[2] + x) - origin[0]) * per_pixel
            v = (scale * (turn[1, 0] * p[0] + turn[1, 1] * p[1] + turn[1, 2] * p[2] + y) - origin[1]) * per_pixel
            if u >= 0 and v >= 0 and u < width and v < height:
                total += raster[int(v), int(u)]
        if total + (len(order) - 1 - i) <= least:
            return 0.0
        if i + 1 == PROBES and i + 1 < len(order) and total * len(order) < 0.5 * least * PROBES:
            return 0.0
    return total


@njit(cache=True)
def _rasterize(uv, count, cell, origin):
    """Raster 1 - (distance to the nearest blob / tolerance)^2 for each camera, so that a lookup replaces the search.

    Returns:
        raster (C, H, W); `origin` gets the pixel coordinates (C, 2) of its corner.
    """
    cameras, reach = len(uv), CELLS
    height, width = 1, 1
    for c in range(cameras):
        if count[c] == 0:
            continue
        low_u, low_v = float(uv[c, 0, 0]), float(uv[c, 0, 1])
        high_u, high_v = low_u, low_v
        for m in range(1, count[c]):
            low_u, high_u = min(low_u, uv[c, m, 0]), max(high_u, uv[c, m, 0])
            low_v, high_v = min(low_v, uv[c, m, 1]), max(high_v, uv[c, m, 1])
        origin[c, 0], origin[c, 1] = low_u - (reach + 1) * cell, low_v - (reach + 1) * cell
        width = max(width, int((high_u - low_u) / cell) + 2 * reach + 4)
        height = max(height, int((high_v - low_v) / cell) + 2 * reach + 4)
    raster = np.zeros((cameras, height, width), dtype=np.float32)
    for c in range(cameras):
        for m in range(count[c]):
            u, v = (uv[c, m, 0] - origin[c, 0]) / cell, (uv[c, m, 1] - origin[c, 1]) / cell
            for row in range(int(v) - reach, int(v) + reach + 1):
                for column in range(int(u) - reach, int(u) + reach + 1):
                    away = ((column + 0.5 - u) ** 2 + (row + 0.5 - v) ** 2) / (CELLS * CELLS)
                    if 1 - away > raster[c, row, column]:
                        raster[c, row, column] = 1 - away
    return raster
