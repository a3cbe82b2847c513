"""Input and output of every peer that recalibrates a rig: plain arrays, mm and pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigTask:
    """Labelled observations of a known object, a factory calibration, and start poses."""

    points: Array  # (N, 3) object, about its own origin
    uv: Array  # (S, C, N, 2)
    sigma: float  # px, each axis
    focal_length: Array  # (C, 2)
    principal_point: Array  # (C, 2)
    distortion: Array  # (C, 5) k1, k2, p1, p2, k3
    rotation: Array  # (C, 3, 3) cam_from_rig
    translation: Array  # (C, 3)
    start_rotation: Array  # (S, 3, 3) rig_from_object
    start_translation: Array  # (S, 3)
    prior_std: (
        Array  # (C, 15) standard deviation of the factory values, in the order of imgcal.types.rig.PARAMETER_NAMES
    )
    image_size: tuple[int, int]  # width, height
    seen: NDArray[np.bool_] | None = None  # (S, C, N), None = all; only used by scipy_rig


@dataclass(frozen=True)
class RigAnswer:
    """A calibrated rig in any frame; only relations between cameras are scored."""

    focal_length: Array  # (C, 2)
    principal_point: Array  # (C, 2)
    distortion: Array  # (C, 5)
    rotation: Array  # (C, 3, 3) cam_from_rig
    translation: Array  # (C, 3)
    seconds: float  # solver time, with inputs already in its own structures


def rotation_matrices(vectors: Array) -> Array:
    """Rotation vectors (..., 3) to matrices (..., 3, 3)."""
    flat = [cv2.Rodrigues(vector)[0] for vector in vectors.reshape(-1, 3)]
    return np.array(flat, dtype=np.float64).reshape(*vectors.shape[:-1], 3, 3)


def rotation_vectors(matrices: Array) -> Array:
    """Rotation matrices (..., 3, 3) to vectors (..., 3)."""
    flat = [cv2.Rodrigues(matrix)[0].ravel() for matrix in matrices.reshape(-1, 3, 3)]
    return np.array(flat, dtype=np.float64).reshape(matrices.shape[:-1])


def mean_extrinsics(rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Average each camera's pose relative to the first one over the snapshots.

    For tools without rigs, which calibrate one camera at a time.

    Args:
        rotation: (S, C, 3, 3) cam_from_object.
        translation: (S, C, 3).

    Returns:
        cam_from_first: rotation (C, 3, 3), the matrix nearest to the mean, and translation (C, 3).
    """
    relative = rotation @ rotation[:, :1].swapaxes(-1, -2)
    u, _, vt = np.linalg.svd(relative.mean(0))
    mean = u @ vt
    shift = translation - (relative @ translation[:, :1, :, None])[..., 0]
    return mean, shift.mean(0)
