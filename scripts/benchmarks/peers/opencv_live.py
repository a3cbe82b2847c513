"""From frames to a rig, as commonly written with OpenCV: blobs, labels by the nearest projection, PnP, calibrateCamera.

Cameras are processed one by one. Intrinsics that one view cannot determine keep their previous values.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.benchmarks.peers.rig_task import Array, RigAnswer, rotation_matrices

LENS = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_TANGENT_DIST
FLAGS = cv2.CALIB_USE_INTRINSIC_GUESS | LENS  # eight points in one view do not determine the lens
NEAR = 10.0  # px, largest distance of a blob from its fiducial's projection
LARGEST = 1.0  # px, the same for a labelled blob, with the last intrinsics
LEAST = 6  # least number of labelled blobs to calibrate a camera

Seen = tuple[NDArray[np.int64], Array]  # fiducials (K,), positions (K, 2)


@dataclass(frozen=True)
class View:
    """Current intrinsics of one camera, and its pose in the previous snapshot."""

    matrix: Array  # (3, 3)
    distortion: Array  # (5,)
    rotation: Array  # (3,) vector, cam_from_object
    translation: Array  # (3,)

    def project(self, points: Array) -> Array:
        uv = cv2.projectPoints(points, self.rotation, self.translation, self.matrix, self.distortion)[0]
        return np.asarray(uv[:, 0], dtype=float)


def detector(radius: tuple[float, float], thresholds: int) -> Any:
    """Make a detector for bright markers with radii in this range (px), about 180 grey levels above a dark background.

    A blob's centre is the mean over the thresholds at which it was found: more thresholds are more accurate and slower.
    One is enough to find the blobs.
    """
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 100, 101, 10
    if thresholds > 1:
        step = 140 / (thresholds - 1)
        settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 40, 180 + step / 2, step
    settings.minRepeatability, settings.minDistBetweenBlobs = min(thresholds, 2), 5
    settings.filterByColor, settings.blobColor = True, 255
    settings.filterByArea = True
    settings.minArea, settings.maxArea = np.pi * radius[0] ** 2, np.pi * radius[1] ** 2
    settings.filterByCircularity, settings.minCircularity = True, 0.7
    settings.filterByConvexity, settings.minConvexity = True, 0.9
    settings.filterByInertia, settings.minInertiaRatio = True, 0.5
    return cv2.SimpleBlobDetector.create(settings)


def update(
    frames: Sequence[NDArray[np.uint8]], points: Array, views: Sequence[View], finder: Any, pool: Executor
) -> tuple[list[View], list[Seen]]:
    """Calibrate every camera from its current frame.

    Args:
        frames: of each camera.
        points: (N, 3) object.
        views: from the previous snapshot.
        finder: from `detector`.
        pool: threads, one per camera.

    Returns:
        The cameras, and for each the fiducials (K,) and positions (K, 2) of the blobs that fit.
    """
    size = (frames[0].shape[1], frames[0].shape[0])

    def one(frame: NDArray[np.uint8], view: View) -> tuple[View, Seen]:
        seen = without_outliers(*labelled(_blobs(finder, frame), points, view), points, view)
        return calibrated(*seen, points, view, size), seen

    found = list(pool.map(one, frames, views))
    return [view for view, _ in found], [seen for _, seen in found]


def labelled(uv: Array, points: Array, view: View) -> Seen:
    """Label each blob (M, 2) with the nearest projected fiducial, if both are mutually nearest."""
    if len(uv) == 0:
        return np.empty(0, dtype=np.int64), uv
    distance = np.linalg.norm(uv[:, None] - view.project(points), axis=-1)
    nearest = distance.argmin(1)
    good = (distance.argmin(0)[nearest] == np.arange(len(uv))) & (distance.min(1) < NEAR)
    return nearest[good], uv[good]


def without_outliers(labels: NDArray[np.int64], uv: Array, points: Array, view: View) -> Seen:
    """Keep the labels that fit the last intrinsics, by solvePnPRansac; keep all if too few fit."""
    if len(labels) < LEAST:
        return labels, uv
    pose = (view.rotation[:, None].copy(), view.translation[:, None].copy())
    lens = (view.matrix, view.distortion)
    inliers = cv2.solvePnPRansac(points[labels], uv, *lens, *pose, True, reprojectionError=LARGEST)[3]
    if inliers is None or len(inliers) < LEAST:
        return labels, uv
    return labels[inliers[:, 0]], uv[inliers[:, 0]]


def calibrated(labels: NDArray[np.int64], uv: Array, points: Array, view: View, size: tuple[int, int]) -> View:
    """Fit the pose by solvePnP, starting from the last one, then pose, focal length and principal point together."""
    if len(labels) < LEAST:
        return view
    shown = points[labels]
    _, vector, shift = cv2.solvePnP(
        shown, uv, view.matrix, view.distortion, view.rotation[:, None].copy(), view.translation[:, None].copy(), True
    )
    view = replace(view, rotation=np.asarray(vector[:, 0], float), translation=np.asarray(shift[:, 0], float))
    calibrate: Any = cv2.calibrateCamera  # its stubs lack half of its arguments
    given = ([shown.astype(np.float32)], [uv.astype(np.float32)], size)
    _, matrix, distortion, vectors, shifts = calibrate(*given, view.matrix.copy(), view.distortion.copy(), flags=FLAGS)
    return View(matrix, np.ravel(distortion)[:5], np.ravel(vectors[0]), np.ravel(shifts[0]))


def answer(views: Sequence[View]) -> RigAnswer:
    """Express the cameras in the object's frame, as if it were the rig's."""
    rotation = rotation_matrices(np.array([view.rotation for view in views]))
    return RigAnswer(
        np.array([view.matrix[[0, 1], [0, 1]] for view in views]),
        np.array([view.matrix[:2, 2] for view in views]),
        np.array([view.distortion for view in views]),
        rotation,
        np.array([view.translation for view in views]),
        0.0,
    )


def _blobs(finder: Any, frame: NDArray[np.uint8]) -> Array:
    return np.array([keypoint.pt for keypoint in finder.detect(frame)], dtype=float).reshape(-1, 2)
