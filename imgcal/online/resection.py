"""Find a camera that may be anywhere, given the object's pose in each snapshot by its neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform, undistort_cpu
from imgcal.types import EXTRINSICS, CalibrationObject, CameraRig, Observations

TRIES = 1200
"""Number of blob triples to match with fiducial triples: about 300 tries find a correct one."""
FIRST, SHORTLIST = 4, 128
"""Number of evenly spread snapshots that rate all poses, and number of poses to rate by all snapshots."""
ROUGH_PX, FINE_PX = 6.0, 2.0
"""Maximum distance (px) between a blob and its fiducial: for a pose from three of them, and after a fit of all."""
LEAST_MATCHES = 8
"""Minimum number of matches over all snapshots: four in one snapshot may agree by chance."""
LEAST_AT_ONCE = 4
"""Minimum number of matches in a single snapshot of a camera with known pose."""
LEAST_SHARE = 0.7
"""Minimum share of possible matches: per snapshot, the smaller of the numbers of blobs and fiducials."""
LEAST_LEAD = 1.3
"""Minimum ratio of matches to those of any pose that gives other labels."""


@dataclass(frozen=True)
class Resected:
    """A camera that was found."""

    labels: NDArray[np.int64]  # (M,) fiducial of each blob of the last snapshot, -1 = none
    camera: CameraRig  # the camera alone, in its present pose


def resect_camera(
    blobs: Sequence[NDArray[np.float64]],
    points_rig: Tensor,
    camera: CameraRig,
    std: Tensor,
    generator: np.random.Generator,
) -> Resected | None:
    """Label the blobs of the last snapshot by the only pose of the camera that explains all snapshots.

    Args:
        blobs: (M_s, 2) pixels for each of S snapshots.
        points_rig: (S, N, 3) mm, the fiducials.
        camera: a rig of one camera; only its lens is taken from it.
        std: (1, K) its uncertainty; only that of the lens counts.
        generator: selects triples if there are many.

    Returns:
        The camera; None if no pose explains enough, or several do.
    """
    seen = [_ideal(uv, camera) for uv in blobs]
    points = points_rig.numpy()
    poses = _hypotheses(seen, points, generator)
    if not len(poses):
        return None
    focal = float(camera.focal_length.mean())
    poses = poses[_choose_promising(poses, points, seen, ROUGH_PX / focal)]
    labels = [_matches(poses, p, xy, ROUGH_PX / focal) for p, xy in zip(points, seen, strict=True)]  # S x (K, M)
    count = sum((found >= 0).sum(1) for found in labels)
    best = int(np.argmax(count))
    first = [found[best] for found in labels]
    fitted = _fit(camera, std, points_rig, blobs, first)
    if fitted is None:
        return None
    inside = fitted.expand(len(points)).project(points_rig).visible[:, 0].sum(-1).numpy()
    final = [
        _matches(_pose(fitted), p, _ideal(uv, fitted), FINE_PX / focal)[0] for p, uv in zip(points, blobs, strict=True)
    ]
    matches = sum(int((found >= 0).sum()) for found in final)
    possible = sum(min(int(n), len(xy)) for n, xy in zip(inside, seen, strict=True))
    agree = sum((found == mine).sum(1) for found, mine in zip(labels, final, strict=True))
    others = count[agree < 0.5 * sum(len(xy) for xy in seen)]
    if matches < max(LEAST_MATCHES, LEAST_SHARE * possible, LEAST_LEAD * others.max(initial=0)):
        return None
    return Resected(final[-1], fitted)


def labels_at(uv: NDArray[np.float64], points_rig: Tensor, camera: CameraRig) -> NDArray[np.int64] | None:
    """Label the blobs (M, 2) of a snapshot by a camera with known pose; None if it explains too few of them.

    Args:
        uv: pixels.
        points_rig: (N, 3) mm, the fiducials.
        camera: a rig of one camera.
    """
    tolerance = FINE_PX / float(camera.focal_length.mean())
    labels = _matches(_pose(camera), points_rig.numpy(), _ideal(uv, camera), tolerance)[0]
    possible = min(int(camera.project(points_rig).visible.sum()), len(uv))
    found = int((labels >= 0).sum())
    return labels if found >= LEAST_AT_ONCE and found >= LEAST_SHARE * possible else None


def _choose_promising(
    poses: NDArray[np.float64], points: NDArray[np.float64], seen: list[NDArray[np.float64]], tolerance: float
) -> NDArray[np.int64]:
    """Indices of the poses that explain the most of a few snapshots."""
    some = np.unique(np.linspace(0, len(seen) - 1, FIRST).astype(np.int64)).tolist()
    count = sum((_matches(poses, points[s], seen[s], tolerance) >= 0).sum(1) for s in some)
    return np.argsort(-np.asarray(count), kind="stable")[:SHORTLIST]


def _ideal(uv: NDArray[np.float64], camera: CameraRig) -> NDArray[np.float64]:
    """Undistort: (M, 2) on the z = 1 plane."""
    if not len(uv):
        return np.zeros((0, 2))
    at = (torch.from_numpy(uv)[None] - camera.principal_point[:, None]) / camera.focal_length[:, None]
    xy, _ = undistort_cpu(at, camera.distortion, camera.lens_model)
    return xy[0].numpy()


def _hypotheses(
    seen: list[NDArray[np.float64]], points: NDArray[np.float64], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Poses (K, 3, 4), cam_from_rig, each from three blobs of one snapshot."""
    found = []
    triples = np.array([t for t in combinations(range(points.shape[1]), 3) if _spans(points[0, list(t)], points[0])])
    usable = [s for s, xy in enumerate(seen) if len(xy) >= 3]
    for s in usable if len(triples) else []:
        wanted = TRIES // len(usable) + 1
        choice = _ordered_triples(len(seen[s]), wanted, generator)
        pairs = generator.permutation(len(triples) * len(choice))[:wanted]
        for pair in pairs:
            fiducials, rows = triples[pair // len(choice)], choice[pair % len(choice)]
            _, turns, shifts = cv2.solveP3P(
                points[s, fiducials], seen[s][rows], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
            )
            found += [np.hstack((cv2.Rodrigues(r)[0], t)) for r, t in zip(turns, shifts, strict=True)]
    poses: NDArray[np.float64] = np.array(found, dtype=np.float64).reshape(-1, 3, 4)
    return np.asarray(poses[np.isfinite(poses).all((1, 2))])


def _ordered_triples(count: int, wanted: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Ordered triples of different blobs: all of them, or `wanted` random ones if there are more."""
    if count <= 8:
        return np.array(list(permutations(range(count), 3)))
    return np.array([generator.permutation(count)[:3] for _ in range(wanted)])


def _spans(triangle: NDArray[np.float64], whole: NDArray[np.float64]) -> bool:
    """Tell whether three points are far enough from collinear to give a pose."""
    area = np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
    return bool(area > 0.05 * np.square(whole - whole.mean(0)).sum(1).mean())


def _matches(
    poses: NDArray[np.float64], points: NDArray[np.float64], xy: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """Fiducial (K, M) that matches each blob: mutually nearest, within a tolerance; -1 = none."""
    at = points @ poses[:, :, :3].swapaxes(-1, -2) + poses[:, None, :, 3]  # (K, N, 3)
    front = at[..., 2] > 1.0
    where = np.where(front[..., None], at[..., :2] / np.maximum(at[..., 2:], 1.0), 1e6)
    if not len(xy):
        return np.zeros((len(poses), 0), dtype=np.int64)
    distance = np.linalg.norm(where[:, :, None] - xy[None, None], axis=-1)  # (K, N, M)
    nearest = distance.argmin(1)  # (K, M)
    back = np.take_along_axis(distance.argmin(2), nearest, axis=1)
    close = np.take_along_axis(distance, nearest[:, None], axis=1)[:, 0] < tolerance
    return np.where(close & (back == np.arange(len(xy))), nearest, -1)


def _fit(
    camera: CameraRig,
    std: Tensor,
    points_rig: Tensor,
    blobs: Sequence[NDArray[np.float64]],
    labels: list[NDArray[np.int64]],
) -> CameraRig | None:
    """Fit the camera's pose, and its lens within a standard deviation (1, K), to its labels; None if they are few."""
    snapshot = np.repeat(np.arange(len(labels)), [len(found) for found in labels])
    fiducial, uv = np.concatenate(labels), np.concatenate(list(blobs))
    rows = np.flatnonzero(fiducial >= 0)
    if len(rows) < 4:
        return None
    cloud = points_rig[snapshot[rows], fiducial[rows]]
    given = torch.from_numpy(uv[rows])[None, None]
    observations = Observations(
        given, torch.full_like(given[..., 0], 1.0), torch.ones_like(given[..., 0], dtype=torch.bool)
    )
    lens = std.to(points_rig.dtype).clone()
    lens[:, :EXTRINSICS] = 0.0
    fit = estimate(
        observations,
        camera,
        CalibrationObject(cloud, torch.ones_like(cloud)),
        prior_std=lens,
        options=EstimationOptions(loss="cauchy"),
    )
    return replace(fit.rig, cam_from_rig=camera.cam_from_rig @ fit.rig_from_object[0].reshape(1))


def _pose(camera: CameraRig) -> NDArray[np.float64]:
    transform: RigidTransform = camera.cam_from_rig
    return torch.cat((transform.rotation, transform.translation[..., None]), dim=-1).numpy()
