"""How other tools' lenses map rays to pixels: evaluated exactly, with the numbers that stand in their files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Model = Literal["opencv", "fisheye", "to_ideal"]

STEPS = 24  # from the principal point outwards, so that each solution is near the one before
NEWTON = 12
NEAR = 1e-9  # on the z = 1 plane
TINY = 1e-30
CLOSE = 1e-11  # of what a pixel is asked to be, on the z = 1 plane
STEEPEST = np.deg2rad(89.5)  # from the optical axis: beyond, a ray meets no plane z = 1


@dataclass(frozen=True)
class Lens:
    """A lens as a file states it.

    `opencv`: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty, those at the end may be absent. `fisheye`: k1 to k4 of the
    angle from the axis (Kannala-Brandt; `cv2.fisheye`). `to_ideal`: k1 k2 k3 in pixels that take a point of the image
    to where a pinhole would have put it (Vicon), the other direction than the first two, and how far the centre of that
    is from the principal point.
    """

    focal_length: tuple[float, float]  # pixels: fx, fy
    principal_point: tuple[float, float]  # pixels: cx, cy; (0, 0) is the centre of the top-left pixel
    coefficients: tuple[float, ...] = ()
    model: Model = "opencv"
    skew: float = 0.0  # pixels: what y on the z = 1 plane adds to u

    @property
    def length(self) -> int:
        """How many coefficients are needed: without the zeros at the end."""
        nonzero = [number for number, value in enumerate(self.coefficients, start=1) if value]
        return nonzero[-1] if nonzero else 0

    @property
    def matrix(self) -> Array:
        """The camera matrix K: (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_length, self.principal_point
        return np.array([[fx, self.skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def pad(self, count: int) -> list[float]:
        """The coefficients, filled with zeros or cut to `count`."""
        return [float(value) for value in (*self.coefficients, *(0.0,) * count)[:count]]

    def project(self, points_cam: Array) -> Array:
        """Project points.

        Args:
            points_cam: (N, 3) in the camera's frame, any unit.

        Returns:
            (N, 2) pixels; nan where a point is not before the camera.
        """
        x, y, z = np.asarray(points_cam, dtype=np.float64).T
        if self.model == "fisheye":
            radius = np.hypot(x, y)
            angle = np.arctan2(radius, z)
            bent = _fisheye(angle, self.pad(4))
            scale = np.where(radius > TINY, bent / np.maximum(radius, TINY), 1.0 / np.where(z == 0, 1.0, z))
            return self._pixels(x * scale, y * scale)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.where(z > 0, x / z, np.nan), np.where(z > 0, y / z, np.nan)
        if self.model == "to_ideal":
            return self._from_ideal(self._pixels(x, y))
        return self._pixels(*distort(x, y, self.pad(14)))

    def rays(self, uv: Array) -> Array:
        """Find the ray of each pixel: (N, 2) -> (N, 3) with z = 1; nan where the model has none (beyond its fold)."""
        if self.model == "to_ideal":
            return _append_one(self._plane(self._to_ideal(uv)))
        wanted = self._plane(uv)
        if self.model == "fisheye":
            return _append_one(_undistort_fisheye(wanted, self.pad(4)))
        return _append_one(undistort(wanted, self.pad(14)))

    def _pixels(self, x: Array, y: Array) -> Array:
        (fx, fy), (cx, cy) = self.focal_length, self.principal_point
        return np.stack((fx * x + self.skew * y + cx, fy * y + cy), axis=-1)

    def _plane(self, uv: Array) -> Array:
        """Where pixels are on the z = 1 plane, distortion included."""
        (fx, fy), (cx, cy) = self.focal_length, self.principal_point
        y = (uv[:, 1] - cy) / fy
        return np.stack(((uv[:, 0] - cx - self.skew * y) / fx, y), axis=-1)

    @property
    def _centre(self) -> Array:
        """Of a distortion `to_ideal`: (2,) pixels."""
        return np.array(self.principal_point) + self.pad(5)[3:]

    def _radius(self, offset: Array) -> Array:
        """Distance from the centre in pixels of the u axis."""
        return np.hypot(offset[:, 0], offset[:, 1] * (self.focal_length[0] / self.focal_length[1]))

    def _to_ideal(self, uv: Array) -> Array:
        offset = uv - self._centre
        square = self._radius(offset) ** 2
        k1, k2, k3 = self.pad(3)
        return uv + offset * (square * (k1 + square * (k2 + square * k3)))[:, None]

    def _from_ideal(self, ideal: Array) -> Array:
        """Invert `_to_ideal` along each radius."""
        offset = ideal - self._centre
        wanted = self._radius(offset)
        k1, k2, k3 = self.pad(3)
        radius = np.zeros_like(wanted)
        sound = np.isfinite(wanted)
        with np.errstate(all="ignore"):
            for step in range(1, STEPS + 1):
                for _ in range(NEWTON if step == STEPS else 3):
                    square = radius**2
                    slope = 1 + square * (3 * k1 + square * (5 * k2 + square * 7 * k3))
                    sound &= slope > 0
                    value = radius * (1 + square * (k1 + square * (k2 + square * k3)))
                    radius = radius - (value - wanted * step / STEPS) / slope
            scale = np.where(wanted > TINY, radius / np.maximum(wanted, TINY), 1.0)
        scale = np.where(sound & np.isfinite(scale), scale, np.nan)
        return self._centre + offset * scale[:, None]


def distort(x: Any, y: Any, coefficients: Sequence[Any]) -> tuple[Any, Any]:
    """OpenCV's model of 14 coefficients on the z = 1 plane; x and y may be complex, for derivatives."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = coefficients
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
    v = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
    if tx == 0 and ty == 0:
        return u, v
    about_x = np.array([[1, 0, 0], [0, np.cos(tx), np.sin(tx)], [0, -np.sin(tx), np.cos(tx)]])
    about_y = np.array([[np.cos(ty), 0, -np.sin(ty)], [0, 1, 0], [np.sin(ty), 0, np.cos(ty)]])
    turned = about_y @ about_x
    sheared = np.array([[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1]]) @ turned
    w = sheared[2, 0] * u + sheared[2, 1] * v + sheared[2, 2]
    return (
        (sheared[0, 0] * u + sheared[0, 1] * v + sheared[0, 2]) / w,
        (sheared[1, 0] * u + sheared[1, 1] * v + sheared[1, 2]) / w,
    )


def undistort(wanted: Array, coefficients: list[float]) -> Array:
    """Invert `distort` by Newton steps, followed from the centre outwards: (N, 2) -> (N, 2), nan beyond the fold."""
    tiny = 1e-200
    at = np.zeros_like(wanted)
    sound = np.ones(len(wanted), dtype=bool)
    centre = np.stack(distort(np.zeros(1), np.zeros(1), coefficients), axis=-1)  # a tilted sensor moves it
    with np.errstate(all="ignore"):
        for step in range(1, STEPS + 1):
            target = centre + (wanted - centre) * (step / STEPS)
            for _ in range(NEWTON if step == STEPS else 4):
                x, y = at.T
                # Both derivatives in one call.
                u, v = distort(np.concatenate((x + 1j * tiny, x)), np.concatenate((y, y + 1j * tiny)), coefficients)
                (u_x, u_y), (v_x, v_y) = u.reshape(2, -1), v.reshape(2, -1)
                a, b, c, d = u_x.imag / tiny, u_y.imag / tiny, v_x.imag / tiny, v_y.imag / tiny
                determinant = a * d - b * c
                miss_u, miss_v = u_x.real - target[:, 0], v_x.real - target[:, 1]
                move = np.stack((d * miss_u - b * miss_v, a * miss_v - c * miss_u), axis=-1) / determinant[:, None]
                at = at - move
                if not (np.abs(move).max(axis=-1) > NEAR)[sound].any():  # the next step would move it by the square
                    break
            sound &= (determinant > 0) & (a + d > 0)
        miss = np.abs(np.stack(distort(at[:, 0], at[:, 1], coefficients), axis=-1) - wanted).max(axis=-1)
        sound &= miss < CLOSE * (1 + np.abs(wanted).max(axis=-1))
    return np.where(sound[:, None], at, np.nan)


def _fisheye(angle: Array, coefficients: list[float]) -> Array:
    k1, k2, k3, k4 = coefficients
    square = angle * angle
    return angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))


def _undistort_fisheye(wanted: Array, coefficients: list[float]) -> Array:
    """Invert the fisheye: (N, 2) on the image -> (N, 2) on the z = 1 plane, nan beyond the fold or 89.5 degrees."""
    k1, k2, k3, k4 = coefficients
    radius = np.hypot(*wanted.T)
    angle = np.zeros_like(radius)
    sound = np.ones(len(radius), dtype=bool)
    with np.errstate(all="ignore"):
        for step in range(1, STEPS + 1):
            for _ in range(NEWTON if step == STEPS else 3):
                square = angle * angle
                slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
                angle = angle - (_fisheye(angle, coefficients) - radius * step / STEPS) / slope
            sound &= slope > 0
        sound &= (angle >= 0) & (angle < STEEPEST)
        sound &= np.abs(_fisheye(angle, coefficients) - radius) < CLOSE * (1 + radius)
        scale = np.where(radius > TINY, np.tan(angle) / np.maximum(radius, TINY), 1.0)
    return np.where(sound[:, None], wanted * scale[:, None], np.nan)


def _append_one(xy: Array) -> Array:
    return np.concatenate((xy, np.ones((len(xy), 1))), axis=-1)
