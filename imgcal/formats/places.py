"""Which numbers of a camera a file may hold, for the places in which a reader has found them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from imgcal.formats.chains import Pose, compose, inverse
from imgcal.formats.documents import Element
from imgcal.formats.foreign_rig import ForeignCamera, Place
from imgcal.formats.lens import Array
from imgcal.formats.values import quaternion_from_rotation, vector_from_rotation

Numbers = Callable[[ForeignCamera], Sequence[float]]


def attributes(path: Path, element: Element | None, numbers: Mapping[str, Numbers]) -> list[Place]:
    """Places of the attributes that an element has, out of some."""
    if element is None:
        return []
    return [Place(path, (element.number, f"@{key}"), of) for key, of in numbers.items() if key in element.attributes]


def camera_matrix(camera: ForeignCamera) -> list[float]:
    """K, row by row."""
    return camera.lens.matrix.ravel().tolist()


def focal_and_centre(camera: ForeignCamera) -> list[float]:
    """Fx, fy, cx, cy."""
    return [*camera.lens.focal_length, *camera.lens.principal_point]


def entry(numbers: Numbers, place: int, factor: float = 1.0, shift: float = 0.0) -> Numbers:
    """One of several numbers, shifted and then scaled."""
    return lambda camera: [(numbers(camera)[place] + shift) * factor]


def coefficients(count: int) -> Numbers:
    """As many distortion coefficients."""
    return lambda camera: camera.lens.pad(count)


def translation(camera: ForeignCamera) -> list[float]:
    """Of cam_from_rig."""
    return camera.translation.tolist()


def centre(camera: ForeignCamera) -> list[float]:
    """Where the camera stands."""
    return camera.centre.tolist()


def rotation_matrix(camera: ForeignCamera) -> list[float]:
    """Of cam_from_rig, row by row."""
    return camera.rotation.ravel().tolist()


def rotation_like(found: Sequence[float]) -> Numbers:
    """Of cam_from_rig, as a file has it: nine numbers of a matrix, or the three of a vector on the same branch."""
    if len(found) == 9:
        return rotation_matrix

    def vector(camera: ForeignCamera) -> list[float]:
        made = vector_from_rotation(camera.rotation)
        angle = float(np.linalg.norm(made))
        turns = [made * (1 + 2 * np.pi * n / angle) for n in (-1, 0, 1)] if angle > 1e-9 else [made]
        return min(turns, key=lambda one: float(np.linalg.norm(one - np.array(found)))).tolist()

    return vector


def pose_numbers(camera: ForeignCamera) -> list[float]:
    """Quaternion w, x, y, z and translation of cam_from_rig."""
    return [*quaternion_from_rotation(camera.rotation).tolist(), *translation(camera)]


def near_quaternion(rotation: Array, wxyz: Sequence[float]) -> list[float]:
    """A rotation's quaternion w, x, y, z with the sign of the one in the file."""
    made = quaternion_from_rotation(rotation)
    return (made if made @ np.array(wxyz) >= 0 else -made).tolist()


def matrix_rows(camera: ForeignCamera) -> list[float]:
    """Of cam_from_rig: rotation and translation, (3, 4) row by row."""
    return np.column_stack((camera.rotation, camera.translation)).ravel().tolist()


def carry_pose(before: Pose, pose: Pose, numbers: Numbers) -> Numbers:
    """Numbers of a pose of the file that goes along with a camera (camera_from_imu, the pose of an image).

    Args:
        before: cam_from_rig as the file has it.
        pose: camera_from_something as the file has it.
        numbers: of camera_from_something.
    """
    rest = compose(inverse(before), pose)

    def of(camera: ForeignCamera) -> Sequence[float]:
        turned, moved = compose((camera.rotation, camera.translation), rest)
        return numbers(replace(camera, rotation=turned, translation=moved))

    return of


def inverse_rows(camera: ForeignCamera) -> list[float]:
    """Of rig_from_cam: rotation and translation, (3, 4) row by row."""
    return np.column_stack(inverse((camera.rotation, camera.translation))).ravel().tolist()
