"""Two descriptions of one rig, compared where it counts: known points, as each of them projects them."""

from __future__ import annotations

import numpy as np

from imgcal.formats.fitting import pixel_grid
from imgcal.formats.foreign_rig import ForeignRig
from imgcal.formats.lens import Array

SIDE = 7  # points along each side of an image, its border included
DEPTHS = (0.5, 1.0, 4.0)  # in units of the rig's size


def known_points(rig: ForeignRig) -> list[Array]:
    """Points before each camera, all over its image and in three depths: (N, 3) in the rig's frame, one array a camera.

    Pixels that a lens has no ray for (beyond its fold) give none.
    """
    centres = np.array([camera.centre for camera in rig.cameras])
    size = float(np.linalg.norm(centres - centres.mean(axis=0), axis=-1).max()) or 1000.0
    found = []
    for camera in rig.cameras:
        assert camera.image_size is not None
        rays = camera.lens.rays(pixel_grid(camera.image_size, SIDE))
        rays = rays[np.isfinite(rays).all(axis=-1)]
        points_cam = np.concatenate([rays * depth * size for depth in DEPTHS])
        found.append((points_cam - camera.translation) @ camera.rotation)
    return found


def worst_difference(rig: ForeignRig, other: ForeignRig) -> tuple[float, int]:
    """How far two rigs in the same unit are apart in the images, cameras in the same order.

    The rig's frame is free: points are taken from one to the other through the first camera.

    Returns:
        The largest distance in pixels over all known points and cameras, and the number of points.
    """
    first, same = rig.cameras[0], other.cameras[0]
    worst, count = 0.0, 0
    for camera, counterpart, points in zip(rig.cameras, other.cameras, known_points(rig), strict=True):
        in_first = first.in_camera(points)
        there = (in_first - same.translation) @ same.rotation
        away = np.linalg.norm(counterpart.project(there) - camera.project(points), axis=-1)
        worst = max(worst, float(np.where(np.isfinite(away), away, np.inf).max(initial=0.0)))
        count += len(points)
    return worst, count
