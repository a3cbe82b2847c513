"""Where an object is seen best: a box in which a rig's cameras look together, for any arrangement of them."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.estimation import WorkingVolume
from imgcal.types import CameraRig

USUAL_DISTANCE = 1000.0  # mm, of cameras whose axes meet nowhere
PARALLEL = 0.02
"""Of the mean square of the sine between axes: below it, where they meet is not known."""
STEPS = 21
REACH = 0.6
"""Half a side of the searched cube, of the distance to where the axes meet."""
ENOUGH = 0.6
"""Of the most cameras that see a point together: what belongs to the volume."""


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
