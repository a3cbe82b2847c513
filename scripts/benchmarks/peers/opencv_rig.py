"""OpenCV's calibrateCamera for each camera alone, from its factory intrinsics; then the mean of the extrinsics."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np

from scripts.benchmarks.peers.rig_task import RigAnswer, RigTask, mean_extrinsics, rotation_matrices

HELD = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_TANGENT_DIST


def solve(task: RigTask, *, distortion: bool = True) -> RigAnswer:
    """Calibrate; OpenCV finds its own start poses, and supports neither a rig nor a prior."""
    snapshots, cameras = task.uv.shape[:2]
    calibrate: Any = cv2.calibrateCamera  # its stubs lack half of its arguments
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | (0 if distortion else HELD)
    shown = [task.points.astype(np.float32)] * snapshots
    seen = [[task.uv[s, c].astype(np.float32) for s in range(snapshots)] for c in range(cameras)]
    matrices = np.zeros((cameras, 3, 3))
    matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 2, 2] = *task.focal_length.T, 1
    matrices[:, :2, 2] = task.principal_point
    lenses = task.distortion.copy()
    begin = time.perf_counter()
    found = [calibrate(shown, seen[c], task.image_size, matrices[c], lenses[c], flags=flags) for c in range(cameras)]
    seconds = time.perf_counter() - begin
    matrices = np.array([one[1] for one in found])
    lenses = np.array([np.ravel(one[2])[:5] for one in found])
    rotation = rotation_matrices(np.array([[one[3][s] for one in found] for s in range(snapshots)])[..., 0])
    translation = np.array([[np.ravel(one[4][s]) for one in found] for s in range(snapshots)])
    extrinsics = mean_extrinsics(rotation, translation)
    focal = np.stack((matrices[:, 0, 0], matrices[:, 1, 1]), axis=-1)
    return RigAnswer(focal, matrices[:, :2, 2], lenses, *extrinsics, seconds)
