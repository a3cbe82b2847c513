"""Do the cameras' lines of sight to the object meet? A check of a rig and its images that needs no identity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imgcal.association import undistort
from imgcal.types import CameraRig, Detections

LEAST_BLOBS, LEAST_CAMERAS = 3, 2
"""Minimum number of blobs of a camera for a direction, and of such cameras for a meeting point."""
MOST_ASKED = 8
"""Maximum number of snapshots to use."""
ROBUST = np.radians(3.0)
"""A line of sight that misses by this angle counts half."""
ROUNDS = 6
"""Iterations of reweighting."""
FARTHEST = np.radians(20.0)
"""A line of sight that misses by more counts as this much in the mean."""

Array = NDArray[np.float64]


def choose_telling_snapshots(
    detections: Detections, cameras: int, most: int = MOST_ASKED, least_cameras: int = LEAST_CAMERAS
) -> NDArray[np.int64]:
    """Choose snapshots that many cameras see, spread over the capture: their numbers in time order, at most `most`."""
    rows = detections.usable
    count = np.zeros((int(detections.snapshot.max(initial=-1)) + 1, cameras), dtype=int)
    np.add.at(count, (detections.snapshot[rows], detections.camera[rows]), 1)
    seeing = (count >= LEAST_BLOBS).sum(1)
    best = np.flatnonzero((seeing >= least_cameras) & (seeing >= np.sort(seeing)[-most:][:1]))
    return best[np.linspace(0, len(best) - 1, min(len(best), most)).astype(int)]


def mean_miss(detections: Detections, rig: CameraRig) -> float | None:
    """Mean angle (rad) by which the lines of sight miss, see `sight_angles`; None = nothing to compare."""
    angles = sight_angles(detections, rig)
    known = np.isfinite(angles)
    return float(np.fmin(angles[known], FARTHEST).mean()) if known.any() else None


def sight_angles(detections: Detections, rig: CameraRig) -> Array:
    """Angles by which the cameras' lines of sight to the object miss their meeting point.

    A line of sight goes through the median of a camera's blobs, forward. The meeting point minimizes the squared
    distances from the lines, those that miss it weighing less.

    Args:
        detections: blobs; the median must be near the object, which clutter may prevent.
        rig: in float64.

    Returns:
        (S, C) rad for at most `MOST_ASKED` snapshots that two cameras see; nan where a camera has too few blobs.
    """
    snapshots = choose_telling_snapshots(detections, rig.num_cameras)
    row, camera, middle = _find_medians(detections, snapshots, rig.num_cameras)
    focal, rotation, positions = rig.focal_length.mean(-1), rig.cam_from_rig.rotation.numpy(), rig.positions.numpy()
    ideal = undistort(middle, camera, rig).astype(np.float64)
    finite = np.isfinite(ideal).all(1)  # the others: beyond what the lens shows
    row, camera, ideal = row[finite], camera[finite], ideal[finite]
    ray = np.concatenate((ideal, focal.numpy()[camera, None]), axis=1)
    forward = np.zeros((len(snapshots), rig.num_cameras, 3))
    forward[row, camera] = np.einsum("nij,ni->nj", rotation[camera], ray / np.linalg.norm(ray, axis=1, keepdims=True))
    known = forward.any(-1)
    across = np.eye(3) - forward[..., :, None] * forward[..., None, :]
    weight = known.astype(float)
    for _ in range(ROUNDS):
        normal = np.einsum("sc,scij->sij", weight, across) + 1e-9 * np.eye(3)
        right = np.einsum("sc,scij,cj->si", weight, across, positions)
        towards = np.linalg.solve(normal, right[..., None])[..., 0][:, None] - positions
        cosine = (towards * forward).sum(-1) / np.maximum(np.linalg.norm(towards, axis=-1), 1e-12)
        angle = np.arccos(np.clip(cosine, -1, 1))
        weight = known / (1 + (angle / ROBUST) ** 2)
    return np.where(known, angle, np.nan)


def _find_medians(
    detections: Detections, snapshots: NDArray[np.int64], cameras: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Median of the blobs of each camera that has enough: index into `snapshots` (R,), camera (R,), and (R, 2) px."""
    rows = np.flatnonzero(detections.usable & np.isin(detections.snapshot, snapshots))
    group = np.searchsorted(snapshots, detections.snapshot[rows]) * cameras + detections.camera[rows]
    count = np.bincount(group, minlength=len(snapshots) * cameras)
    first = np.cumsum(count) - count
    known = np.flatnonzero(count >= LEAST_BLOBS)
    middle = np.empty((len(known), 2))
    for axis in range(2):
        value = detections.uv[rows, axis]
        value = value[np.lexsort((value, group))]
        low, high = (first[known] + half for half in ((count[known] - 1) // 2, count[known] // 2))
        middle[:, axis] = (value[low] + value[high]) / 2
    return known // cameras, known % cameras, middle
