"""How a rig is drawn: which way is up, the viewpoint, the size of its cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import WorkingVolume
from imgcal.live_page.page import round_values
from imgcal.types import CameraRig

Array = NDArray[np.float64]

USUAL_DISTANCE = 1000.0  # mm, of cameras whose axes meet nowhere
PARALLEL = 0.02
"""Of the mean square of the sine between axes: below it, where they meet is not known."""
STEPS = 21
REACH = 0.6
"""Half a side of the searched cube, of the distance to where the axes meet."""
ENOUGH = 0.6
"""Of the most cameras that see a point together: what belongs to the volume."""
CLEAR = 0.3
"""Length of the mean of unit vectors from which on they agree."""
ALONG_AXIS = 0.97
"""Cosine up to which a direction counts as that of an axis of the rig's frame."""


def viewing_volume(rig: CameraRig) -> WorkingVolume:
    """Find the box that holds what many cameras see at once, about where they look; a rig that names its volume has it.

    Args:
        rig: without batch axes.

    Examples:
        >>> import imgcal
        >>> box = viewing_volume(imgcal.load_rig("O10"))
        >>> bool(box.contains(torch.tensor([0.0, 0.0, 850.0], dtype=torch.float64)))
        True
    """
    rig = rig.to(torch.float64)
    if rig.volume is not None:
        low, high = torch.tensor([rig.volume.low, rig.volume.high], dtype=torch.float64)
        return WorkingVolume(low, high)
    middle = _meeting_point(rig)
    distance = float((rig.positions - middle).norm(dim=-1).median())
    half = max(REACH * distance, 1.0)
    searched = WorkingVolume(middle - half, middle + half)
    grid = searched.grid(STEPS).flatten(0, -2)
    count = rig.project(grid).visible.sum(0)
    apart = (rig.positions[:, None] - grid).norm(dim=-1).amin(0)
    shared = grid[(count >= ENOUGH * count.max()) & (count > 0) & (apart >= 0.3 * distance)]
    if not len(shared):
        return searched
    # The outermost layers are thin corners of the views.
    share = shared.new_tensor([0.05, 0.95])
    low, high = shared.quantile(share, dim=0)
    margin = 0.05 * half
    return WorkingVolume(low - margin, high + margin)


def _meeting_point(rig: CameraRig) -> Tensor:
    """Where the cameras look: the point nearest to all axes, or the working distance ahead where they are parallel."""
    axes, centres = rig.cam_from_rig.rotation[:, 2], rig.positions
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    mean = axes.mean(0)
    ahead = rig.working_distance or USUAL_DISTANCE
    if rig.working_distance is not None and mean.norm() > 0.5:
        return centres.mean(0) + ahead * mean / mean.norm()
    if torch.linalg.eigvalsh(across.mean(0))[0] > PARALLEL:
        point = torch.linalg.solve(across.sum(0), (across @ centres[..., None]).sum(0)[:, 0])
        depth = ((point - centres) * axes).sum(-1)
        if bool((depth > 0).float().mean() > 0.5):
            return point
    return centres.mean(0) + ahead * mean / mean.norm().clamp_min(1e-9)


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


def up_and_forward(rig: CameraRig) -> tuple[Array, Array]:
    """Find which way is up, and the level direction in which most cameras look, both (3,).

    A direction that is nearly that of an axis of the rig's frame is that of the axis.

    Args:
        rig: float64, without batch axes.
    """
    centres, axes = rig.positions.numpy(), rig.cam_from_rig.rotation.numpy()
    up = _snap(upright(centres, axes, _meeting_point(rig).numpy()))
    return up, _snap(forward(centres, axes, up))


def upright(centres: Array, axes: Array, middle: Array) -> Array:
    """Find the up direction (3,): the top of most cameras' images, or away from the object, across the cameras.

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
    """Find the level direction (3,) in which most cameras look; the longest side of a rig that looks inwards."""
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


def _snap(direction: Array) -> Array:
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < ALONG_AXIS:
        return direction
    return np.asarray(np.eye(3)[axis] * np.sign(direction[axis]))


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
