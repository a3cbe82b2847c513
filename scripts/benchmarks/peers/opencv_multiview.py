"""OpenCV 5's `calibrateMultiview`, for cameras with approximately known focal lengths."""

from __future__ import annotations

import time

import cv2
import numpy as np

from scripts.benchmarks.peers.rig_task import Array, RigAnswer

VIEWS = 50  # views per camera to calibrate its lens alone
METRES = 1e-3  # OpenCV treats objects of hundreds of units as collinear


def solve(uv: Array, seen: Array, points: Array, focal: Array, image_size: Array) -> RigAnswer:
    """Calibrate from scratch.

    Args:
        uv: (S, C, N, 2) pixels.
        seen: (S, C, N); a camera is used in a snapshot only if it sees the whole object.
        points: (N, 3) mm.
        focal: (C, 2) pixels, rough.
        image_size: (C, 2) pixels.

    Raises:
        cv2.error: OpenCV gives up.
    """
    spread = np.linalg.norm(np.cross(points - points[0], points[-1] - points[0]), axis=1)
    order = [0, len(points) - 1, int(spread.argmax())]  # the first three must not be collinear
    order += [n for n in range(len(points)) if n not in order]
    uv, seen, points = uv[:, :, order], seen[:, :, order], points[order]
    cameras = seen.shape[1]
    whole = np.asarray(seen.all(-1))
    kept = np.flatnonzero(whole.sum(1) >= 2)
    middle = (image_size - 1) / 2
    matrices = [
        np.array([[focal[c, 0], 0, middle[c, 0]], [0, focal[c, 1], middle[c, 1]], [0, 0, 1]]) for c in range(cameras)
    ]
    begin = time.perf_counter()
    flat = (points * METRES).astype(np.float32)
    known = []
    for c in range(cameras):  # solid objects require approximately known lenses
        rows = np.flatnonzero(whole[:, c])
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, VIEWS).astype(int))]
        images, size = [uv[s, c].astype(np.float32) for s in rows], tuple(int(v) for v in image_size[c])
        guess = cv2.CALIB_USE_INTRINSIC_GUESS
        known.append(cv2.calibrateCamera([flat] * len(rows), images, size, matrices[c], np.zeros(5), flags=guess)[1:3])
    _, found, distortion, rotations, translations = cv2.calibrateMultiview(
        [flat for _ in kept],
        [[uv[s, c].astype(np.float32) for s in kept] for c in range(cameras)],
        [tuple(int(v) for v in size) for size in image_size],
        whole[kept].T.astype(np.uint8),
        np.full(cameras, cv2.CALIB_MODEL_PINHOLE, dtype=np.uint8),
        [matrix for matrix, _ in known],
        [distortion.ravel() for _, distortion in known],
        [np.eye(3) for _ in range(cameras)],
        [np.zeros(3) for _ in range(cameras)],
        flagsForIntrinsics=np.full(cameras, cv2.CALIB_USE_INTRINSIC_GUESS, dtype=np.int32),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )[:5]
    seconds = time.perf_counter() - begin
    intrinsics = np.stack(found).astype(np.float64)
    turned = [r if np.shape(r) == (3, 3) else cv2.Rodrigues(np.asarray(r))[0] for r in rotations]
    return RigAnswer(
        intrinsics[:, [0, 1], [0, 1]],
        intrinsics[:, :2, 2],
        np.stack([np.ravel(d)[:5] for d in distortion]).astype(np.float64),
        np.stack(turned).astype(np.float64),
        np.stack([np.ravel(t) for t in translations]).astype(np.float64) / METRES,
        seconds,
    )
