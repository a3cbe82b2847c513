"""Projection with Brown-Conrady distortion by other tools: cameras and points in, pixels out, in float64.

Every function prepares what users would reuse (camera objects, matrices, rotation vectors), and returns a function to
time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from scripts.benchmarks.peer import peer

Array = NDArray[np.float64]
Run = Callable[[], Any]


@dataclass(frozen=True)
class Views:
    """Points in front of cameras."""

    points: Array  # (B, N, 3) mm
    rotation: Array  # (B, C, 3, 3)
    translation: Array  # (B, C, 3)
    focal_length: Array  # (B, C, 2)
    principal_point: Array  # (B, C, 2)
    distortion: Array  # (B, C, 5)
    image_size: tuple[int, int]  # width, height

    @property
    def matrices(self) -> Array:
        """Camera matrices (B, C, 3, 3)."""
        made = np.zeros((*self.focal_length.shape[:2], 3, 3))
        made[..., 0, 0], made[..., 1, 1], made[..., 2, 2] = self.focal_length[..., 0], self.focal_length[..., 1], 1
        made[..., :2, 2] = self.principal_point
        return made


def numpy_arrays(views: Views) -> Run:
    """Plain NumPy over all rigs and cameras at once, with separate components."""
    k1, k2, p1, p2, k3 = np.moveaxis(views.distortion[..., None], 2, 0)  # (B, C, 1)
    (fx, fy), (cx, cy) = (np.moveaxis(x[..., None], 2, 0) for x in (views.focal_length, views.principal_point))

    def run() -> Array:
        cam = views.rotation @ views.points[:, None].swapaxes(2, 3) + views.translation[..., None]  # (B, C, 3, N)
        x, y = cam[:, :, 0] / cam[:, :, 2], cam[:, :, 1] / cam[:, :, 2]
        xx, yy, xy2 = x * x, y * y, 2 * x * y
        rr = xx + yy
        radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
        uv = np.empty((*x.shape, 2))
        uv[..., 0] = fx * (x * radial + p1 * xy2 + p2 * (rr + 2 * xx)) + cx
        uv[..., 1] = fy * (y * radial + p1 * (rr + 2 * yy) + p2 * xy2) + cy
        return uv

    return run


def opencv(views: Views) -> Run:
    """cv2.projectPoints, camera by camera, into one array."""
    given = _opencv_cameras(views)
    rigs, cameras = views.rotation.shape[:2]

    def run() -> Array:
        uv = np.empty((rigs * cameras, views.points.shape[1], 2))
        for row, camera in zip(uv, given, strict=True):
            row[:] = cv2.projectPoints(*camera)[0][:, 0]
        return uv.reshape(rigs, cameras, -1, 2)

    return run


def opencv_jacobian(views: Views, upstream: Array) -> Run:
    """The same with its Jacobian with respect to rotation, translation, focal length, principal point, distortion.

    The timed function returns upstream (B, C, N, 2) times the Jacobians: (B * C, 15).
    """
    given = _opencv_cameras(views)
    pulls = upstream.reshape(len(given), -1)

    def run() -> Array:
        return np.array([pull @ cv2.projectPoints(*camera)[1] for pull, camera in zip(pulls, given, strict=True)])

    return run


def pycolmap_cameras(views: Views) -> Run | None:
    """Rigid3d times points, then Camera.img_from_cam of model FULL_OPENCV, camera by camera; None if absent."""
    pycolmap = peer("pycolmap")
    if pycolmap is None:
        return None
    width, height = views.image_size
    rigs, cameras = views.rotation.shape[:2]
    given = []
    for b in range(rigs):
        for c in range(cameras):
            params = [*views.focal_length[b, c], *views.principal_point[b, c], *views.distortion[b, c], 0, 0, 0]
            camera = pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params)
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(views.rotation[b, c]), views.translation[b, c])
            given.append((camera, pose, views.points[b]))

    def run() -> Array:
        uv = np.empty((len(given), views.points.shape[1], 2))
        for row, (camera, pose, points) in zip(uv, given, strict=True):
            row[:] = camera.img_from_cam(pose * points, False)
        return uv.reshape(rigs, cameras, -1, 2)

    return run


def kornia_camera(views: Views) -> Run:
    """kornia's PinholeCamera and distort_points, all cameras in one batch."""
    cameras, points, matrices, distortion = _kornia_inputs(views)

    def run() -> Tensor:
        with torch.no_grad():
            return _kornia_project(cameras, points, matrices, distortion).view(*views.rotation.shape[:2], -1, 2)

    return run


def kornia_gradient(views: Views, upstream: Array) -> Run:
    """The same, and gradients of pixels times `upstream` for camera matrices, extrinsics, distortion and points."""
    cameras, points, _, distortion = _kornia_inputs(views)
    leaves = [x.clone().requires_grad_() for x in (cameras.intrinsics, cameras.extrinsics, distortion, points)]
    pull = torch.from_numpy(upstream).flatten(0, 1)

    def run() -> tuple[Tensor, ...]:
        intrinsics, extrinsics, lens, seen = leaves
        made = PinholeCamera(intrinsics, extrinsics, cameras.height, cameras.width)
        return torch.autograd.grad(_kornia_project(made, seen, intrinsics[:, :3, :3], lens), leaves, pull)

    return run


def _kornia_project(cameras: PinholeCamera, points: Tensor, matrices: Tensor, distortion: Tensor) -> Tensor:
    return distort_points(cameras.project(points), matrices, distortion)


def _kornia_inputs(views: Views) -> tuple[PinholeCamera, Tensor, Tensor, Tensor]:
    rigs, cameras = views.rotation.shape[:2]
    eye = torch.eye(4, dtype=torch.float64).repeat(rigs * cameras, 1, 1)
    intrinsics, extrinsics = eye.clone(), eye.clone()
    intrinsics[:, :3, :3] = torch.from_numpy(views.matrices).flatten(0, 1)
    extrinsics[:, :3, :3] = torch.from_numpy(views.rotation).flatten(0, 1)
    extrinsics[:, :3, 3] = torch.from_numpy(views.translation).flatten(0, 1)
    width, height = (torch.full((rigs * cameras,), float(x)) for x in views.image_size)
    points = torch.from_numpy(views.points)[:, None].expand(-1, cameras, -1, -1).flatten(0, 1).contiguous()
    lens = torch.from_numpy(views.distortion).flatten(0, 1)
    camera = PinholeCamera(intrinsics, extrinsics, height, width)
    return camera, points, intrinsics[:, :3, :3].contiguous(), lens


def _opencv_cameras(views: Views) -> list[tuple[Any, ...]]:
    rigs, cameras = views.rotation.shape[:2]
    matrices = views.matrices
    return [
        (
            views.points[b],
            cv2.Rodrigues(views.rotation[b, c])[0],
            views.translation[b, c],
            matrices[b, c],
            views.distortion[b, c],
        )
        for b in range(rigs)
        for c in range(cameras)
    ]
