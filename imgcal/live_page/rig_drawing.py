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
        Plain values: `centres` and `cameras` as `frustums` draws them (mm), `up` and `ahead` (unit vectors across each
        other), whether cameras look inward from all sides, and the volume.
    """
    centres, axes = rig.positions.double().numpy(), rig.cam_from_rig.rotation.double().numpy()
    low, high = volume.low.double().numpy(), volume.high.double().numpy()
    up = upright(centres, axes, (low + high) / 2)
    return {
        "centres": round_values(centres),
        "cameras": round_values(frustums(rig, frustum_length(rig, np.stack((low, high))))),
        "up": round_values(up),
        "ahead": round_values(forward(centres, axes, up)),
        "inward": bool(_level(axes[:, 2].mean(0), up) < CLEAR),
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


def frustum_length(rig: CameraRig, points: Array | None = None) -> float:
    """Size of the drawn cameras, mm: so small beside the distances between neighbours that they stay apart."""
    centres = rig.positions.double().numpy()
    if len(centres) > 1:
        distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        least = 0.03 * float(np.linalg.norm(np.ptp(centres, axis=0)))
        return max(0.45 * float(np.median(distance.min(axis=1))), least, 1e-3)
    if points is not None and len(points):
        return 0.15 * float(np.linalg.norm(points.reshape(-1, 3).mean(axis=0) - centres[0]))
    return 0.2 * (rig.working_distance or 500.0)


def frustums(rig: CameraRig, length: float) -> Array:
    """Centre of each camera and the corners of its view, from the top left one: (C, 5, 3) mm in the rig.

    The view is cut off where its depth or its half diagonal reaches `length`.
    """
    rig = rig.to(torch.float64)
    focal = rig.focal_length.clamp_min(1.0)
    low = ((-0.5 - rig.principal_point) / focal).detach()  # (C, 2) on the plane z = 1
    high = ((rig.image_size - 0.5 - rig.principal_point) / focal).detach()
    half = (high - low).norm(dim=-1) / 2
    depth = length / half.clamp_min(1.0)
    (left, top), (right, bottom) = low.unbind(-1), high.unbind(-1)
    one, zero = torch.ones_like(left), torch.zeros_like(left)
    corners = [(zero, zero, zero), (left, top, one), (right, top, one), (right, bottom, one), (left, bottom, one)]
    rays = torch.stack([torch.stack(corner, -1) for corner in corners], dim=1) * depth[:, None, None]
    return (rays @ rig.cam_from_rig.rotation + rig.positions[:, None]).detach().cpu().numpy()
