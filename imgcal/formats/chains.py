"""Poses that are given from camera to camera: followed from one camera to all that hang together with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.lens import Array
from imgcal.formats.values import nearest_rotation
from imgcal.messages import name_cameras

Pose = tuple[Array, Array]  # rotation (3, 3) and translation (3,) of destination_from_source
IDENTITY: Pose = (np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Link:
    """X_destination = R X_source + t."""

    destination: str
    source: str
    pose: Pose


def pose_from_matrix(matrix: Array, what: str) -> Pose:
    """Take a 4 x 4 (or 3 x 4) matrix apart."""
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise FormatError(f"{what}: found the last row {matrix[3].tolist()}, expected 0 0 0 1")
    return nearest_rotation(matrix[:3, :3], what), matrix[:3, 3]


def inverse(pose: Pose) -> Pose:
    """The transform the other way."""
    rotation, translation = pose
    return rotation.T, -rotation.T @ translation


def compose(outer: Pose, inner: Pose) -> Pose:
    """First the inner one, then the outer one."""
    return outer[0] @ inner[0], outer[0] @ inner[1] + outer[1]


def follow_links(root: str, cameras: Sequence[str], links: Sequence[Link]) -> dict[str, Pose]:
    """Follow links to every camera: camera_from_root.

    Raises:
        FormatError: a camera that no chain of links reaches.
    """
    poses = find_linked(root, links)
    lost = [camera for camera in cameras if camera not in poses]
    if lost:
        raise FormatError(f"{name_cameras(lost)}: no pose relative to {root}, and without one there is no rig")
    return {camera: poses[camera] for camera in cameras}


def find_linked(root: str, links: Sequence[Link]) -> dict[str, Pose]:
    """Find camera_from_root of all cameras that chains of links reach, the nearest first."""
    near: dict[str, list[tuple[str, Pose]]] = {}
    for link in links:
        near.setdefault(link.source, []).append((link.destination, link.pose))
        near.setdefault(link.destination, []).append((link.source, inverse(link.pose)))
    poses: dict[str, Pose] = {root: IDENTITY}
    waiting = [root]
    while waiting:
        source = waiting.pop(0)
        for destination, pose in near.get(source, ()):
            if destination not in poses:
                poses[destination] = compose(pose, poses[source])
                waiting.append(destination)
    return poses
