"""A rig in 3D for a page in a browser: the scene as plain values, and the script that draws it on a canvas.

The script defines `RigView`, a `Viewer` of `imgcal.live_page`: `new RigView(canvas).set(scene)`. It reads the colours
--page, --ink, --muted, --line, --ghost, --before and --after of the page's style sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from imgcal.live_page import frustum_length, frustums, read_asset, up_and_forward, viewer_script
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


def rig_view_script() -> str:
    """The script that defines `RigView`."""
    return viewer_script() + read_asset("report/templates/rig_view.js")


def _round(points: Array) -> list[Any]:
    """Nested lists, to 0.01 mm."""
    rounded: list[Any] = np.round(points, 2).tolist()
    return rounded
