"""How a rig is drawn: which way is up, the viewpoint, the size of its cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.estimation import WorkingVolume
from imgcal.live_page.text import round_values
from imgcal.types import CameraRig

Array = NDArray[np.float64]

CLEAR = 0.3
"""Length of the mean of unit vectors from which on they agree."""


def arrangement(rig: CameraRig, volume: WorkingVolume) -> dict[str, Any]:
    """Describe how a rig is drawn.

    Args:
        rig: without batch axes.
        volume: where the object is seen.

    Returns:
        Plain values: cameras (their axes as rows: right, down, ahead; tangents of half their angles of view), `up` and
        `ahead` (unit vectors across each other), whether cameras look inward from all sides, `size` of a camera (mm),
        and the volume.
    """
    centres, axes = rig.positions.double().numpy(), rig.cam_from_rig.rotation.double().numpy()
    low, high = volume.low.double().numpy(), volume.high.double().numpy()
    up = upright(centres, axes, (low + high) / 2)
    return {
        "centres": round_values(centres),
        "axes": round_values(axes),
        "view": round_values((rig.image_size / rig.focal_length.double() / 2).numpy()),
        "up": round_values(up),
        "ahead": round_values(forward(centres, axes, up)),
        "inward": bool(_level(axes[:, 2].mean(0), up) < CLEAR),
        "size": _camera_size(centres, low, high),
        "low": round_values(low),
        "high": round_values(high),
    }


def upright(centres: Array, axes: Array, middle: Array) -> Array:
    """Which way is up (3,): where most cameras' images have their top, or away from the object, across the cameras.

    Examples:
        >>> upright(np.eye(3), np.stack([np.eye(3)] * 3), np.zeros(3))  # upright OpenCV cameras: y is down
        array([-0., -1., -0.])
    """
    mean = -axes[:, 1].mean(0)
    if np.linalg.norm(mean) > CLEAR:
        up: Array = mean / np.linalg.norm(mean)
        return up
    away = centres.mean(0) - middle
    normal: Array = np.linalg.svd(centres - centres.mean(0))[2][-1]
    return normal if normal @ away >= 0 else -normal


def forward(centres: Array, axes: Array, up: Array) -> Array:
    """Which way most cameras look (3,), level; the longest side of a rig that looks inwards."""
    mean = axes[:, 2].mean(0)
    level = mean - (mean @ up) * up
    if np.linalg.norm(level) < CLEAR:
        spread = centres - centres.mean(0)
        spread = spread - np.outer(spread @ up, up)
        level = np.linalg.svd(spread)[2][0] if len(centres) > 1 else np.zeros(3)
        if np.linalg.norm(level - (level @ up) * up) < CLEAR:
            level = np.eye(3)[int(np.argmin(np.abs(up)))]
        level = level - (level @ up) * up
    ahead: Array = level / np.linalg.norm(level)
    return ahead


def _level(vector: Array, up: Array) -> float:
    return float(np.linalg.norm(vector - (vector @ up) * up))


def _camera_size(centres: Array, low: Array, high: Array) -> float:
    """Length of a drawn camera: small beside the distances between neighbours, and never too small to be seen."""
    whole = float(np.linalg.norm(np.maximum(centres.max(0), high) - np.minimum(centres.min(0), low)))
    if len(centres) == 1:
        return 0.06 * whole
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return float(np.clip(0.45 * np.median(distance.min(1)), 0.02 * whole, 0.06 * whole))
