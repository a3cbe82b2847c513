"""Numbers, matrices and rotations out of the plain values of a file, each checked: one line says what is wrong."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from imgcal.formats.documents import Element
from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.lens import Array
from imgcal.types import limits

LARGEST = 1e12
LOOSEST = 5e-3  # how far the columns of a rotation may be from orthonormal: three digits


def number(value: Any, what: str) -> float:
    """Read one finite number; text that is a number counts (XML)."""
    found = value
    if isinstance(value, str):
        try:
            found = float(value)
        except ValueError:
            found = None
    if isinstance(found, bool) or not isinstance(found, int | float) or not abs(found) <= LARGEST:
        raise FormatError(f"{what}: found {reprlib.repr(value)}, expected a finite number")
    return float(found)


def numbers(value: Any, what: str) -> list[float]:
    """Read all numbers of a list, of nested lists, of `{rows, cols, data}`, or of text with spaces between."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if isinstance(value, str):
        value = value.replace(",", " ").split()
    if not isinstance(value, list):
        return [number(value, what)]
    found: list[float] = []
    for part in value:
        found.extend(numbers(part, what) if isinstance(part, list) else [number(part, what)])
    return found


def array(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """Read as many finite numbers as a shape has, however they are nested."""
    found = numbers(value, what)
    if len(found) != math.prod(shape):
        wanted = " x ".join(map(str, shape))
        raise FormatError(f"{what}: found {len(found)} numbers, expected {wanted}")
    return np.array(found).reshape(shape)


def coefficients(value: Any, what: str, counts: Sequence[int] = (0, 4, 5, 8, 12, 14)) -> tuple[float, ...]:
    """Read distortion coefficients, and check how many there are."""
    found = numbers(value, what) if value is not None else []
    if len(found) not in counts:
        wanted = ", ".join(map(str, counts))
        raise FormatError(f"{what}: found {len(found)} distortion coefficients, expected {wanted}")
    return tuple(found)


def camera_matrix(value: Any, what: str) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Read K: focal lengths, principal point and skew."""
    k = array(value, (3, 3), what)
    if abs(k[2, 2]) < 1e-9 or not np.allclose(
        k / k[2, 2] * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1]]), np.diag([0, 0, 1])
    ):
        raise FormatError(
            f"{what}: found {np.round(k, 6).tolist()}, expected a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]"
        )
    k = k / k[2, 2]
    return focal_length(k[0, 0], k[1, 1], what), (float(k[0, 2]), float(k[1, 2])), float(k[0, 1])


def focal_length(fx: Any, fy: Any, what: str) -> tuple[float, float]:
    """Read the focal lengths, which are plausible numbers of pixels."""
    both = number(fx, what), number(fy, what)
    if not all(limits.FOCAL_LENGTH.low <= value <= limits.FOCAL_LENGTH.high for value in both):
        raise FormatError(
            f"{what}: found the focal lengths {both[0]:g} and {both[1]:g}, expected {limits.FOCAL_LENGTH}"
        )
    return both


def image_size(value: Any, what: str) -> tuple[int, int] | None:
    """Read width and height; None where the file has none (absent, or zeros)."""
    if value is None:
        return None
    width, height = array(value, (2,), what)
    if width == height == 0:
        return None
    if not all(side == int(side) and 1 <= side <= limits.LONGEST_SIDE for side in (width, height)):
        raise FormatError(f"{what}: found {width:g} x {height:g}, expected width and height in pixels")
    return int(width), int(height)


def nearest_rotation(matrix: Array, what: str) -> Array:
    """Take the rotation that is nearest to a matrix of a file, whose digits are rounded.

    Raises:
        FormatError: it is no rotation, but a mirror or something else.
    """
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > LOOSEST:
        raise FormatError(f"{what}: found {np.round(matrix, 4).tolist()}, expected a rotation matrix")
    if np.linalg.det(matrix) < 0:
        raise FormatError(f"{what}: found a mirror (determinant -1), expected a rotation matrix")
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def rotation(value: Any, what: str) -> Array:
    """Read a rotation: a 3 x 3 matrix, or a rotation vector in rad (Rodrigues) where there are three numbers."""
    found = numbers(value, what)
    if len(found) == 3:
        return rotation_from_vector(np.array(found))
    return nearest_rotation(array(found, (3, 3), what), what)


def rotation_from_vector(vector: Array) -> Array:
    """The rotation matrix of a rotation vector in rad."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def vector_from_rotation(matrix: Array) -> Array:
    """The rotation vector in rad of a rotation matrix; of a half turn, too."""
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def rotation_from_quaternion(value: Any, what: str) -> Array:
    """The rotation matrix of a Hamilton quaternion w, x, y, z, which is normalized first."""
    w, *xyz = array(value, (4,), what).tolist()
    length = math.hypot(w, *xyz)
    if not 0.5 < length < 2:
        raise FormatError(f"{what}: found a quaternion of length {length:g}, expected 1")
    return np.asarray(Rotation.from_quat([*xyz, w]).as_matrix())


def quaternion_from_rotation(matrix: Array) -> Array:
    """The Hamilton quaternion w, x, y, z with w >= 0."""
    return np.roll(Rotation.from_matrix(matrix).as_quat(canonical=True), 1)


def attribute(element: Element, key: str, name: str) -> str:
    """The text of an attribute that a camera of a name must have."""
    if key not in element.attributes:
        raise FormatError(f"{name}: no {key}")
    return element.attributes[key]


def mapping(value: Any, what: str) -> dict[str, Any]:
    """Read a mapping."""
    if not isinstance(value, dict):
        raise FormatError(f"{what}: found {reprlib.repr(value)}, expected keys and values")
    return value


def text(value: Any, what: str) -> str:
    """Read a short text; a number is one, too (names of cameras)."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise FormatError(f"{what}: found {reprlib.repr(value)}, expected text")
    return str(value)


def texts(value: Any, what: str) -> list[str]:
    """Read a list of short texts (names of cameras)."""
    if not isinstance(value, list):
        raise FormatError(f"{what}: found {reprlib.repr(value)}, expected a list of names")
    return [text(one, what) for one in value]
