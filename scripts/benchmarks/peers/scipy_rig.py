"""scipy's least_squares with imgcal's MAP cost: analytic Jacobian in NumPy, dense or sparse, whichever is faster.

Written independently from the formulas, so that it also checks imgcal's code.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from scripts.benchmarks.peers.rig_task import Array, RigAnswer, RigTask

CAMERA, POSE = 15, 6
MOST_DENSE = 20  # snapshots; with more, the singular value decomposition takes minutes
LSMR = {"atol": 1e-8, "btol": 1e-8, "maxiter": 2000}  # its own tolerances stop far from the minimum


def solve(task: RigTask) -> RigAnswer:
    """Minimize from the factory values and the start poses."""
    cost = _Cost(task, _pattern(task.uv.shape))
    dense = len(task.uv) <= MOST_DENSE
    start = np.zeros(cost.size)
    begin = time.perf_counter()
    if dense:
        found = least_squares(cost.residual, start, lambda x: cost.jacobian(x).toarray(), ftol=1e-6)
    else:
        iterative = {"tr_solver": "lsmr", "tr_options": LSMR, "x_scale": "jac", "max_nfev": 30}
        found = least_squares(cost.residual, start, cost.jacobian, ftol=1e-6, **iterative)
    seconds = time.perf_counter() - begin
    rotation, position, focal, principal, distortion = cost.rig(found.x)
    return RigAnswer(focal, principal, distortion, rotation, -np.einsum("cij,cj->ci", rotation, position), seconds)


def _pattern(shape: tuple[int, ...]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Columns and row starts of the Jacobian: 15 camera and 6 pose entries per row, then the prior's unit matrix."""
    cameras = shape[1]
    s, c, _, _ = np.indices(shape)
    camera = CAMERA * c[..., None] + np.arange(CAMERA)
    pose = CAMERA * cameras + POSE * s[..., None] + np.arange(POSE)
    columns = np.concatenate((np.concatenate((camera, pose), -1).ravel(), np.arange(CAMERA * cameras)))
    rows = np.concatenate((np.full(s.size, CAMERA + POSE), np.ones(CAMERA * cameras, dtype=int)))
    return columns.astype(np.int32), np.concatenate(([0], np.cumsum(rows))).astype(np.int32)


@dataclass(frozen=True)
class _Cost:
    """Whitened residuals as a function of whitened offsets (C, 15) and, per snapshot, rotation and shift (S, 6)."""

    task: RigTask
    pattern: tuple[NDArray[np.int32], NDArray[np.int32]]

    @property
    def size(self) -> int:
        return CAMERA * self.task.uv.shape[1] + POSE * self.task.uv.shape[0]

    @property
    def weight(self) -> Array:
        """Inverse of sigma (S, C, N), 0 = not seen."""
        seen = np.ones(self.task.uv.shape[:-1]) if self.task.seen is None else self.task.seen
        return seen / self.task.sigma

    def rig(self, x: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Rotations (C, 3, 3), positions (C, 3), focal lengths, principal points (C, 2), distortion (C, 5)."""
        task = self.task
        step = x[: task.prior_std.size].reshape(task.prior_std.shape) * task.prior_std
        rotation = _exponential(step[:, :3]) @ task.rotation
        position = -np.einsum("cji,cj->ci", task.rotation, task.translation) + step[:, 3:6]
        focal, principal = task.focal_length + step[:, 6:8], task.principal_point + step[:, 8:10]
        return rotation, position, focal, principal, task.distortion + step[:, 10:]

    def residual(self, x: Array) -> Array:
        rotation, position, focal, principal, distortion = self.rig(x)
        xy, _ = _seen(self._points(x)[1], rotation, position)
        uv = focal[:, None] * _distorted(xy, distortion[:, None]) + principal[:, None]
        return np.concatenate((((uv - self.task.uv) * self.weight[..., None]).ravel(), x[: self.task.prior_std.size]))

    def jacobian(self, x: Array) -> csr_matrix:
        task = self.task
        rotation, position, focal, _, distortion = self.rig(x)
        turned, points = self._points(x)
        xy, cam = _seen(points, rotation, position)
        by_xy, by_distortion = _lens_jacobian(xy, distortion[:, None])
        depth = cam[..., 2]
        by_point = np.empty((*xy.shape, 3))  # (S, C, N, 2, 3) d pixel / d point in the camera's frame
        by_point[..., :2] = by_xy / depth[..., None, None]
        by_point[..., 2] = -np.einsum("scnij,scnj->scni", by_xy, xy) / depth[..., None]
        by_point *= focal[:, None, :, None]
        by_rig = by_point @ rotation[:, None]
        step = x[: task.prior_std.size].reshape(task.prior_std.shape) * task.prior_std
        poses = x[task.prior_std.size :].reshape(-1, POSE)
        full = np.zeros((*xy.shape, CAMERA + POSE))
        full[..., 0:3] = np.cross(cam[..., None, :], by_point) @ _left_jacobian(step[:, :3])[:, None]
        full[..., 3:6] = -by_rig
        full[..., 0, 6], full[..., 1, 7] = np.moveaxis(_distorted(xy, distortion[:, None]), -1, 0)
        full[..., 0, 8] = full[..., 1, 9] = 1
        full[..., 10:15] = by_distortion * focal[:, None, :, None]
        full[..., :CAMERA] *= task.prior_std[:, None, None]
        full[..., 15:18] = np.cross(turned[:, None, :, None], by_rig) @ _left_jacobian(poses[:, :3])[:, None, None]
        full[..., 18:21] = by_rig
        data = np.concatenate(((full * self.weight[..., None, None]).ravel(), np.ones(task.prior_std.size)))
        return csr_matrix((data, *self.pattern), shape=(len(self.pattern[1]) - 1, self.size))

    def _points(self, x: Array) -> tuple[Array, Array]:
        """Fiducials of every snapshot in the rig frame (S, N, 3): only rotated, and rotated and translated."""
        task = self.task
        poses = x[task.prior_std.size :].reshape(-1, POSE)
        centroid = task.points.mean(0)
        start = task.start_rotation @ centroid + task.start_translation
        turned = (task.points - centroid) @ (_exponential(poses[:, :3]) @ task.start_rotation).swapaxes(-1, -2)
        return turned, turned + (start + poses[:, 3:])[:, None]


def _seen(points: Array, rotation: Array, position: Array) -> tuple[Array, Array]:
    """Points (S, N, 3) on the z = 1 planes (S, C, N, 2), and in the camera frames (S, C, N, 3)."""
    cam = (points[:, None] - position[:, None]) @ rotation.swapaxes(-1, -2)
    return cam[..., :2] / cam[..., 2:], cam


def _distorted(xy: Array, distortion: Array) -> Array:
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, p1, p2, k3 = np.moveaxis(distortion, -1, 0)
    rr = x * x + y * y
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    dx = x * radial + 2 * p1 * x * y + p2 * (rr + 2 * x * x)
    dy = y * radial + p1 * (rr + 2 * y * y) + 2 * p2 * x * y
    return np.stack((dx, dy), axis=-1)


def _lens_jacobian(xy: Array, distortion: Array) -> tuple[Array, Array]:
    """Derivatives of the distorted point with respect to the point (..., 2, 2) and coefficients (..., 2, 5)."""
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, p1, p2, k3 = np.moveaxis(distortion, -1, 0)
    rr = x * x + y * y
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    slope = 2 * (k1 + rr * (2 * k2 + 3 * rr * k3))
    by_xy, by_k = np.empty((*x.shape, 2, 2)), np.empty((*x.shape, 2, 5))
    by_xy[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by_xy[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    by_xy[..., 0, 1] = by_xy[..., 1, 0] = slope * x * y + 2 * (p1 * x + p2 * y)
    for column, power in ((0, rr), (1, rr**2), (4, rr**3)):
        by_k[..., column] = xy * power[..., None]
    by_k[..., 0, 2] = by_k[..., 1, 3] = 2 * x * y
    by_k[..., 1, 2], by_k[..., 0, 3] = rr + 2 * y * y, rr + 2 * x * x
    return by_xy, by_k


def _exponential(vectors: Array) -> Array:
    """Rotation matrices of rotation vectors (M, 3)."""
    angle = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-12)[:, None, None]
    cross = _cross(vectors)
    return np.eye(3) + np.sin(angle) / angle * cross + 2 * (np.sin(angle / 2) / angle) ** 2 * (cross @ cross)


def _left_jacobian(vectors: Array) -> Array:
    """Derivative of the exponential map on the left, (M, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    small, safe = angle < 1e-4, np.maximum(angle, 1e-4)
    cross = _cross(vectors)
    third = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + 2 * (np.sin(safe / 2) / safe) ** 2 * cross + third * (cross @ cross)


def _cross(vectors: Array) -> Array:
    matrices = np.zeros((len(vectors), 3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        matrices[:, k, j], matrices[:, j, k] = vectors[:, i], -vectors[:, i]
    return matrices
