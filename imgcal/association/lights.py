"""Unknown markers: find which blobs of different cameras are the same marker, moment by moment.

`associate_lights` needs a rig that is accurate to a few pixels (`error`). If the rig is off by more than the spacing of
the markers, `align_rig` improves it first, from the unlabelled blobs of many moments at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from imgcal.association.blobs import undistort
from imgcal.association.light_alignment import FREE, epipolar_equations, image_equations
from imgcal.association.light_search import find_all_lights
from imgcal.types import CameraRig, Detections

Array = NDArray[np.float64]

LEAST_ODDS = 6.0
"""Minimum log odds of a marker against false blobs."""
LEAST_CAMERAS = 3
"""Minimum number of cameras that agree on a marker."""
STEPS, SHRINK = 20, 0.8
"""Number of steps of `align_rig`, and the factor by which each narrows the lines."""
NARROWEST = 1.0
"""px, final width of the lines."""
CHANCE = 0.5
"""Weight of "no partner" on a line, relative to a partner exactly on it."""
SHIFTS = ((60.0, 0.0), (-60.0, 0.0), (0.0, 60.0), (0.0, -60.0), (45.0, 45.0), (-45.0, -45.0))
"""px: offsets from predicted places at which chance matches are counted."""
VIEW = 0.03
"""Margin at the image border, as a share of its size, in which predicted markers may be out of view."""
LEAST_MOMENTS, STILL, SHARE_OF_MOMENTS = 8, 1.0, 0.5
"""Minimum number of a camera's moments for background detection; maximum motion (px) of a static blob; minimum share of
moments that show it."""
MOST_PAIRS = 150_000
"""Maximum number of blob pairs per step of `align_rig`, evenly over the moments."""


@dataclass(frozen=True)
class Lights:
    """Markers found at some moments, most probable first at each moment."""

    row: NDArray[np.int64]  # (R, C) row of the detections in each camera, -1 = none
    moment: NDArray[np.int64]  # (R,) number of the snapshot
    point: Array  # (R, 3) mm in the rig's frame
    odds: Array  # (R,) log odds against false blobs
    margin: Array  # (R,) log odds against the best rival that uses one of its blobs; inf = none

    def __len__(self) -> int:
        return len(self.row)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Lights:
        """Keep some of the R markers, given as a mask (R,) or as indices."""
        return Lights(self.row[rows], self.moment[rows], self.point[rows], self.odds[rows], self.margin[rows])

    @cached_property
    def cameras(self) -> NDArray[np.int64]:
        """Number of cameras that show each: (R,)."""
        return np.asarray((self.row >= 0).sum(1))


@dataclass(frozen=True)
class SortedBlobs:
    """Usable blobs ordered by moment and camera, on the plane z = 1 without distortion."""

    xy: Array  # (M, 2)
    start: NDArray[np.int64]  # (S, C + 1) first blob of each moment and camera
    row: NDArray[np.int64]  # (M,) row of the detections


def associate_lights(
    detections: Detections,
    rig: CameraRig,
    error: NDArray[np.float64],
    least_cameras: int = LEAST_CAMERAS,
) -> Lights:
    """Find the markers of each moment: blobs of at least three cameras that may show one point.

    Each blob belongs to at most one marker. Blobs are left out if a blob nearby may equally be the marker.

    Args:
        detections: blobs of one or more moments, cameras as in the rig; labels are ignored.
        rig: without batch axes, float64.
        error: (C,) px, standard deviation of errors of rig and blobs in each camera, see `image_error`; a more accurate
            rig allows denser markers.
        least_cameras: minimum number of cameras that agree on it; two rays may meet by chance.

    Returns:
        One row per marker and moment.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import simulate_volume, true_detections
        >>> rig, wand = imgcal.load_rig("room10"), imgcal.load_object("wand4")
        >>> seen = true_detections(simulate_volume(rig, wand, 3, torch.Generator().manual_seed(0), None))
        >>> found = associate_lights(seen, rig, np.full(10, 0.5))
        >>> len(found), bool((np.ptp(seen.fiducial[found.row[0][found.row[0] >= 0]]) == 0))
        (12, True)
    """
    blobs = sort_blobs(detections, rig)
    cameras = rig.num_cameras
    most = max(len(blobs.xy) // 3, 1)
    chosen, point = np.full((most, cameras), -1), np.empty((most, 3))
    odds, margin, moment = np.empty(most), np.empty(most), np.empty(most, dtype=np.int64)
    focal = rig.focal_length.double().numpy()
    rotation, position = rig.cam_from_rig.rotation.double().numpy(), rig.positions.double().numpy()
    half = 0.5 * rig.image_size.double().numpy() / focal
    gate = np.asarray(error, dtype=np.float64) / focal.mean(1)
    count = find_all_lights(
        blobs.xy, blobs.start, np.ascontiguousarray(rotation), np.ascontiguousarray(position), gate, half, LEAST_ODDS,
        least_cameras, chosen, point, odds, margin, moment,
    )  # fmt: skip
    chosen = chosen[:count]
    row = np.where(chosen >= 0, blobs.row[np.maximum(chosen, 0)] if len(blobs.row) else -1, -1)
    found = Lights(row, moment[:count], point[:count], odds[:count], margin[:count])
    return found.select(found.cameras >= 2)


def sort_blobs(detections: Detections, rig: CameraRig) -> SortedBlobs:
    """Arrange the usable blobs for compiled loops."""
    rows = np.flatnonzero(detections.usable)
    camera, snapshot = detections.camera[rows], detections.snapshot[rows]
    ideal = undistort(detections.uv[rows], camera, rig).astype(np.float64)
    xy = ideal / rig.focal_length.double().mean(1).numpy()[camera, None]
    good = np.isfinite(xy).all(1)
    rows, camera, snapshot, xy = rows[good], camera[good], snapshot[good], xy[good]
    moments, cameras = len(detections.snapshot_names), rig.num_cameras
    cell = snapshot * cameras + camera
    order = np.argsort(cell, kind="stable")
    ends = np.concatenate(([0], np.cumsum(np.bincount(cell, minlength=moments * cameras))))
    start = ends[np.arange(moments)[:, None] * cameras + np.arange(cameras + 1)]
    return SortedBlobs(np.ascontiguousarray(xy[order]), start, rows[order])


def image_error(rig: CameraRig, std: Tensor) -> Array:
    """Standard deviation of blobs around their predictions by a rig: (C,) px.

    Args:
        rig: without batch axes.
        std: (C, K) one standard deviation of each value, as `RigPrior.std` gives it.
    """
    spread, size = std.double().numpy(), rig.image_size.double().numpy()
    focal, position = rig.focal_length.double().mean(1).numpy(), rig.positions.double().numpy()
    distance = np.linalg.norm(position - position.mean(0), axis=1).mean() or 1000.0
    turned, moved = spread[:, :3].mean(1) * focal, spread[:, 3:6].mean(1) * focal / distance
    zoomed, shifted = spread[:, 6:8].mean(1) / focal * size.mean(1) * 0.3, spread[:, 8:10].mean(1)
    return np.asarray(np.sqrt(turned**2 + moved**2 + zoomed**2 + shifted**2))


def align_rig(
    detections: Detections, rig: CameraRig, std: Tensor, first: CameraRig | None = None, seed: int = 0
) -> tuple[CameraRig, float]:
    """Align a rig to unlabelled blobs, so that most of them lie on epipolar lines of blobs of all other cameras.

    Each blob is attracted by the most probable lines of each other camera. The lines are as wide as the rig's error at
    first, and become narrower step by step. Each least squares problem is solved by Gauss-Newton, with the factory's
    prior.

    Args:
        detections: blobs of many moments; labels are ignored.
        rig: the factory rig.
        std: (C, K) its prior.
        first: initial rig; None = the factory rig.
        seed: of the random choice of moments.

    Returns:
        The rig, and the mean log likelihood of a blob in a pair of cameras: larger is better.
    """
    blobs = sort_blobs(detections, rig)
    counts = np.diff(blobs.start, axis=1)
    pairs = (counts.sum(1) ** 2 - (counts**2).sum(1)) // 2
    order = np.random.default_rng(seed).permutation(np.flatnonzero(pairs > 0))
    order = order[np.cumsum(pairs[order]) <= max(MOST_PAIRS, int(pairs[order[:1]].sum()))]
    some = detections.select(blobs.row[np.isin(detections.snapshot[blobs.row], order)])  # sorted: sorting again is fast
    size, whitening = FREE * rig.num_cameras, std[:, :FREE].double()
    scale = np.ascontiguousarray(whitening.numpy())
    information, gradient = np.empty((size, size)), np.empty(size)
    now = rig if first is None else first
    width = float(np.sqrt(2) * np.median(image_error(rig, std)))
    cost, weight = 0.0, 1.0
    for _ in range(STEPS):
        there = sort_blobs(some, now)
        focal, rotation, position = (
            np.ascontiguousarray(t.double().numpy())
            for t in (now.focal_length, now.cam_from_rig.rotation, now.positions)
        )
        cost, weight = epipolar_equations(
            there.xy, there.start[order], rotation, position, focal, scale, width, CHANCE, information, gradient
        )
        change = now.local(rig)[:, :FREE].double()
        offset = torch.where(whitening > 0, change / whitening.clamp_min(1e-30), 0.0).reshape(-1).numpy()
        step = -np.linalg.solve(information + np.eye(size), gradient + offset)
        whole = torch.zeros_like(std)
        whole[:, :FREE] = torch.from_numpy(step.reshape(-1, FREE)) * whitening
        now = now.retract(whole)
        width = max(width * SHRINK, NARROWEST)
    return now, -cost / max(weight, 1.0)


def align_camera(
    detections: Detections, rig: CameraRig, std: Tensor, now: CameraRig, camera: int, lights: Lights
) -> CameraRig:
    """Align one camera to markers that the others see: each blob is attracted by its most probable markers.

    Args:
        detections: blobs of the same moments; labels are ignored.
        rig: the factory rig, whose values the camera starts from.
        std: (C, K) its prior.
        now: the rig in whose frame the markers are.
        camera: index of the camera.
        lights: markers that others see.

    Returns:
        `now` with this camera aligned.
    """
    blobs = sort_blobs(detections.select(detections.camera == camera), rig)
    order = np.argsort(lights.moment, kind="stable")
    moments = len(detections.snapshot_names)
    point_start = np.concatenate(([0], np.cumsum(np.bincount(lights.moment, minlength=moments))))
    points = np.ascontiguousarray(lights.point[order])
    start = np.append(blobs.start[:, camera], blobs.start[-1, camera + 1])
    whitening = std[camera, :FREE].double()
    information, gradient = np.empty((FREE, FREE)), np.empty(FREE)
    moved = rig
    width = 1.5 * float(image_error(rig, std)[camera])
    counts = np.diff(start)
    density = float(counts[counts > 0].mean()) / float(_spread_area(blobs, start) * rig.focal_length[camera].prod())
    for _ in range(STEPS):
        own = sort_blobs(detections.select(detections.camera == camera), moved)
        focal = moved.focal_length[camera].double()
        uv = own.xy * focal.mean().item()
        chance = max(CHANCE, 1.0) * min(2 * np.pi * width**2 * density, 1.0) + 0.05
        image_equations(
            uv, start, points, point_start, np.ascontiguousarray(moved.cam_from_rig.rotation[camera].double().numpy()),
            np.ascontiguousarray(moved.positions[camera].double().numpy()), np.full(2, focal.mean().item()),
            np.ascontiguousarray(whitening.numpy()), width, chance, information, gradient,
        )  # fmt: skip
        change = moved.local(rig)[camera, :FREE].double()
        offset = torch.where(whitening > 0, change / whitening.clamp_min(1e-30), 0.0).numpy()
        step = -np.linalg.solve(information + np.eye(FREE), gradient + offset)
        whole = torch.zeros_like(std)
        whole[camera, :FREE] = torch.from_numpy(step) * whitening
        moved = moved.retract(whole)
        width = max(width * SHRINK, NARROWEST)
    change = torch.zeros_like(std)
    change[camera] = moved.local(now)[camera]
    return now.retract(change)


def _spread_area(blobs: SortedBlobs, start: NDArray[np.int64]) -> float:
    """Median area of one moment's blobs on the plane z = 1, four standard deviations wide."""
    parts = [blobs.xy[a:b] for a, b in pairwise(start) if b - a > 2]
    sides = [16 * float(np.prod(np.std(part, axis=0))) for part in parts]
    return max(float(np.median(sides)) if sides else 1.0, 1e-4)


def background_rows(detections: Detections) -> NDArray[np.bool_]:
    """Mark the blobs that never move in their camera's image: lamps, doorways, reflections.

    Args:
        detections: blobs of some moments.

    Returns:
        (M,) bool.

    Examples:
        >>> moments = np.arange(20)
        >>> lamp, light = np.tile([[300.0, 200.0]], (20, 1)), np.column_stack((10.0 * moments, np.full(20, 50.0)))
        >>> blobs = Detections(
        ...     np.concatenate((lamp, light)), np.full(40, 0.1), np.zeros(40, dtype=int), np.tile(moments, 2),
        ...     np.full(40, -1), np.full(40, np.nan), np.zeros(40, dtype=np.uint8), ("left",), tuple(map(str, moments)),
        ... )
        >>> int(background_rows(blobs).sum())
        20
    """
    marked = np.zeros(len(detections), dtype=bool)
    for camera in np.unique(detections.camera):
        rows = np.flatnonzero(detections.camera == camera)
        uv, snapshot = detections.uv[rows], detections.snapshot[rows]
        moments = len(np.unique(snapshot))
        if moments < LEAST_MOMENTS:
            continue
        least = SHARE_OF_MOMENTS * moments
        # A circle lies in four cells at most; hardly any image has so many blobs in one.
        cell = np.floor(uv / (2.001 * STILL)) @ (1.0, 2.0**24)
        if np.unique(cell, return_counts=True)[1].max() < least / 4:
            continue
        near = cKDTree(uv).query_ball_point(uv, STILL, return_length=True)
        for k in np.flatnonzero(near >= least):  # few: markers move
            there = np.square(uv - uv[k]).sum(1) <= STILL**2
            marked[rows[k]] = len(np.unique(snapshot[there])) >= least
    return marked


def predicted_misses(
    lights: Lights, detections: Detections, rig: CameraRig, camera: int, error: Array, near: float, far: float
) -> tuple[int, float, float]:
    """Compare one camera's blobs with the predicted markers found by the others.

    Args:
        lights: found without this camera.
        detections: blobs of the same moments.
        rig: the rig they were found with.
        camera: index of the camera.
        error: (C,) px, as for `associate_lights`.
        near: standard deviations within which a blob is in place.
        far: standard deviations within which it is a near miss.

    Returns:
        Number of markers in the camera's view; the share with a blob in place, and the share whose nearest blob that
        is not in another one's place is a near miss, both less the chance level at shifted places.
    """
    blobs = sort_blobs(detections, rig)
    one, focal = rig.select([camera]), float(rig.focal_length[camera].mean())
    points = torch.from_numpy(lights.point)
    image = one.project(points)
    inside = image.visible[0].numpy()
    size = one.image_size[0].double().numpy()
    uv = image.uv[0].numpy()
    inside &= ((uv > VIEW * size) & (uv < (1 - VIEW) * size)).all(-1)
    there = (points - one.positions[0]) @ one.cam_from_rig.rotation[0].mT
    xy = (there[:, :2] / there[:, 2:]).numpy()
    sigma = error[camera] * np.sqrt(1 + _uncertainty(lights, rig, camera))
    shifted = xy[:, None] + np.array([(0.0, 0.0), *SHIFTS]) / focal  # (R, 1 + shifts, 2)
    least = np.full((2, 1 + len(SHIFTS), len(xy)), np.inf)  # standard deviations to the nearest blob, as counted below
    for moment in np.unique(lights.moment[inside]):
        rows = np.flatnonzero(inside & (lights.moment == moment))
        own = slice(blobs.start[moment, camera], blobs.start[moment, camera + 1])
        away = np.linalg.norm(blobs.xy[own] - shifted[rows][:, :, None], axis=-1)  # (rows, 1 + shifts, blobs)
        away *= (focal / sigma[rows])[:, None, None]
        least[0, :, rows] = away.min(axis=-1, initial=np.inf)
        in_place = away[:, 0] < near
        away[np.broadcast_to((in_place.any(0) & ~in_place)[:, None], away.shape)] = np.inf  # the blob of another marker
        least[1, :, rows] = away.min(axis=-1, initial=np.inf)
    total = int(inside.sum())
    if total == 0:
        return 0, 0.0, 0.0
    nearest, not_of_others = least[..., inside]
    beside = (nearest >= near) & (near <= not_of_others) & (not_of_others < far)
    share = np.stack(((nearest < near).mean(1), beside.mean(1)), 1)
    chance = share[1:].mean(0)
    found = (share[0, 0] - chance[0]) / max(1 - chance[0], 1e-9)
    # A near miss counts only if no blob is in place.
    missed = share[0, 1] - chance[1] * (1 - share[0, 0]) / max(1 - chance[0], 1e-9)
    return total, float(found), float(missed)


def _uncertainty(lights: Lights, rig: CameraRig, camera: int) -> Array:
    """Approximate variance of predicted images (R,), relative to that of a blob: the larger of both axes."""
    position = rig.positions.double().numpy()
    ray = lights.point[:, None] - position  # (R, C, 3)
    away = np.linalg.norm(ray, axis=-1, keepdims=True)
    ray = ray / away
    across = (np.eye(3) - ray[..., :, None] * ray[..., None, :]) / away[..., None] ** 2
    information = (across * (lights.row >= 0)[..., None, None]).sum(1)
    covariance = np.linalg.inv(information + 1e-12 * np.eye(3))
    one = across[:, camera] * away[:, camera, :, None]
    return np.asarray(np.linalg.eigvalsh(one @ covariance @ one)[:, -1])
