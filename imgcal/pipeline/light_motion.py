"""Find cameras that moved while unknown markers were shown, farther than labels can follow.

Only blobs that fit the rig have a label, so a camera has none after such a move: its blobs are where no marker should
be. As for known objects, one other place of the camera must explain them; reflections do not follow the markers.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.estimation import LEAST_SNAPSHOTS
from imgcal.pipeline.camera_places import CameraView
from imgcal.pipeline.label_counts import is_well_inside
from imgcal.pipeline.motion_check import compare_views, split_cleanly
from imgcal.types import CameraRig, Detections, MovedCamera, MovedError

MOST_MIXED = 0.4
"""Maximum share of moments of the other kind before and after a move: markers are hidden, and beside false blobs they
look like markers elsewhere."""

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


def require_steady_cameras(
    detections: Detections, moment: Numbers, points: Array, seen: NDArray[np.bool_], rig: CameraRig
) -> None:
    """Refuse if a camera shows the markers in place first and elsewhere later, or vice versa.

    Args:
        detections: blobs of S moments without those that never move, cameras as in the rig.
        moment: (R,) number of the moment of each marker found.
        points: (R, 3) mm in the rig's frame.
        seen: (R, C) cameras that show a marker in place.
        rig: the rig that was found, without batch axes, float64.

    Raises:
        MovedError: names the cameras; how far they moved is not known.
    """
    blobs, names = detections.select(detections.usable), detections.snapshot_names
    moves = _find_lost_cameras(blobs, moment, points, seen, rig)
    if moves:
        lost = [MovedCamera(name, names[first], "unknown") for first, name in moves]
        raise MovedError(lost, len(names) - moves[-1][0], len(names), labelled=detections)


def _find_lost_cameras(
    blobs: Detections, moment: Numbers, points: Array, seen: NDArray[np.bool_], rig: CameraRig
) -> list[tuple[int, str]]:
    """Find the first moment after each move, in chronological order, and the camera's name."""
    shape = (len(blobs.snapshot_names), rig.num_cameras)
    image = rig.project(torch.from_numpy(points))
    inside = is_well_inside(image.uv.numpy(), rig) & image.visible.numpy()  # (C, R)
    in_place, expected, usable = (np.zeros(shape, dtype=np.int64) for _ in range(3))
    np.add.at(in_place, moment, seen)
    np.add.at(expected, moment, inside.T | seen)
    np.add.at(usable, (blobs.snapshot, blobs.camera), 1)
    agrees, differs = compare_views(in_place, np.minimum(expected, usable) - in_place, expected)
    suspects = np.flatnonzero(differs.sum(0) >= LEAST_SNAPSHOTS).tolist()
    arranged, moves = _by_moment(moment, points, shape[0]), []
    for camera in suspects:
        rows = np.flatnonzero(agrees[:, camera] | differs[:, camera])
        wrong = differs[rows, camera]
        place = split_cleanly(wrong, LEAST_SNAPSHOTS, len(suspects), MOST_MIXED)
        if place is not None:
            view = CameraView(blobs.select(blobs.camera == camera), *arranged, rig, camera)
            if view.some_turn_explains(rows[wrong]) and not view.one_place_explains(rows[~wrong], rows[wrong]):
                moves.append((int(rows[place]), rig.camera_names[camera]))
    return sorted(moves)


def _by_moment(moment: Numbers, points: Array, count: int) -> tuple[Array, NDArray[np.bool_]]:
    """Arrange markers by their moment: (S, N, 3) mm, and which of them there are (S, N)."""
    order = np.argsort(moment, kind="stable")
    many = np.bincount(moment, minlength=count)
    number = np.arange(len(moment)) - (np.cumsum(many) - many)[moment[order]]
    arranged, present = (
        np.zeros((count, many.max(initial=0), 3)),
        np.zeros((count, many.max(initial=0)), dtype=np.bool_),
    )
    arranged[moment[order], number], present[moment[order], number] = points[order], True
    return arranged, present
