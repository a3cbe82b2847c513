"""A rig in 3D for a page in a browser: the scene as plain values, and the script that draws it on a canvas.

The script defines `RigView` and nothing else that a page needs: `new RigView(canvas).set(scene)`. It reads the colours
--page, --ink, --muted, --line, --ghost, --before and --after of the page's style sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import torch

from imgcal.live_page import up_and_forward
from imgcal.report.svg import Array
from imgcal.types import CameraRig

Scene = dict[str, Any]


@dataclass(frozen=True)
class DrawnRig:
    """One rig of a scene, in one or several states to choose from."""

    name: str
    colour: str  # a custom property of the page's style sheet, as "--after"
    steps: tuple[CameraRig, ...]  # without batch axes
    filled: bool = False


def rig_scene(rigs: Sequence[DrawnRig], points: Array | None = None) -> Scene:
    """Describe rigs of the same cameras, and points beside them, in the form that `RigView` draws.

    Args:
        rigs: the first one is the reference: from it to the last, shifts of cameras are drawn, and it says what is up.
        points: (G, N, 3) mm in the rigs' frame, coloured by group from the first to the last.

    Examples:
        >>> import imgcal
        >>> scene = rig_scene([DrawnRig("factory", "--ghost", (imgcal.load_rig("T4"),))])
        >>> scene["names"], len(scene["rigs"][0]["steps"][0])
        (['cam01', 'cam02', 'cam03', 'cam04'], 4)
    """
    first = rigs[0].steps[0].to(torch.float64)
    length = frustum_length(first, points)
    up, ahead = up_and_forward(first)
    drawn = [
        {
            "name": rig.name,
            "colour": rig.colour,
            "filled": rig.filled,
            "steps": [_round(frustums(step, length)) for step in rig.steps],
        }
        for rig in rigs
    ]
    return {
        "names": list(first.camera_names),
        "up": [round(float(v), 6) for v in up],
        "forward": [round(float(v), 6) for v in ahead],
        "rigs": drawn,
        "groups": [] if points is None else _round(points),
    }


@cache
def rig_view_script() -> str:
    """The script that defines `RigView`."""
    return files("imgcal.report").joinpath("templates", "rig_view.js").read_text(encoding="utf-8")


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


def _round(points: Array) -> list[Any]:
    """Nested lists, to 0.01 mm."""
    rounded: list[Any] = np.round(points, 2).tolist()
    return rounded
