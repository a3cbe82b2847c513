"""Projection without gradients on CPUs: `CameraRig.project` compiled to one loop, without temporaries.

`projection.py` says the same in tensors, runs on any device, and is what this is tested against.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.geometry import kernels
from imgcal.geometry.projection import NEAREST_DEPTH, Projection
from imgcal.geometry.transforms import RigidTransform
from renderers.compiling import njit

Array = NDArray[np.floating[Any]]


def project_cpu(
    points_rig: Tensor,
    cam_from_rig: RigidTransform,
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
) -> Projection:
    """Do the work of `projection.project_components` for tensors on the CPU: without gradients, several times faster.

    Args:
        points_rig: (B, N, 3) mm; its floating-point type is that of all others.
        cam_from_rig: (B, C).
        focal_length: (B, C, 2) pixels.
        principal_point: (B, C, 2) pixels.
        distortion: (B, C, 5) k1, k2, p1, p2, k3.
        image_size: (C, 2) pixels, width and height.
        radius: (N,) mm of spherical fiducials; None = points.
    """
    given = (cam_from_rig.rotation, cam_from_rig.translation, focal_length, principal_point, distortion)
    # NumPy's calls take half the time of PyTorch's, and its large arrays ask Linux for huge pages.
    points = np.ascontiguousarray(points_rig.detach().numpy().transpose(0, 2, 1))
    count, _, fiducials = points.shape
    kind = points.dtype
    radius_squared = np.zeros(fiducials, kind) if radius is None else radius.detach().numpy().astype(kind) ** 2
    image = np.empty((count, focal_length.shape[1], 4, fiducials), kind)  # u, v, depth, visible
    arrays = [np.ascontiguousarray(tensor.detach().numpy()) for tensor in given]
    _project(points, radius_squared, *arrays, np.ascontiguousarray(image_size.numpy()), image)  # type: ignore[call-arg]
    uv, depth, visible = image[:, :, :2].swapaxes(2, 3), image[:, :, 2], image[:, :, 3] > 0
    return Projection(torch.from_numpy(uv), torch.from_numpy(depth), torch.from_numpy(visible))


@njit(cache=True, fastmath=kernels.FAST, error_model="numpy")
def _project(
    points: Array, radius_squared: Array, rotation: Array, translation: Array,
    focal_length: Array, principal_point: Array, distortion: Array, image_size: NDArray[Any], image: Array,
) -> None:  # fmt: skip
    # One output array and constants of the points' own type: with more of either, the inner loop is not vectorized.
    kind = points.dtype.type
    nearest, zero, half, one = kind(NEAREST_DEPTH), kind(0), kind(0.5), kind(1)
    for b in range(rotation.shape[0]):
        for c in range(rotation.shape[1]):
            r, t = rotation[b, c], translation[b, c]
            r00, r01, r02, tx = r[0, 0], r[0, 1], r[0, 2], t[0]
            r10, r11, r12, ty = r[1, 0], r[1, 1], r[1, 2], t[1]
            r20, r21, r22, tz = r[2, 0], r[2, 1], r[2, 2], t[2]
            fx, fy = focal_length[b, c]
            cx, cy = principal_point[b, c]
            k1, k2, p1, p2, k3 = distortion[b, c]
            width, height = kind(image_size[c, 0]) - half, kind(image_size[c, 1]) - half
            slope1, slope2, slope3 = kind(3) * k1, kind(5) * k2, kind(7) * k3
            blind_from = kind(kernels.blind_from(slope1, slope2, slope3))
            for n in range(points.shape[2]):
                x, y, z = points[b, 0, n], points[b, 1, n], points[b, 2, n]
                px = r00 * x + r01 * y + r02 * z + tx
                py = r10 * x + r11 * y + r12 * z + ty
                pz = r20 * x + r21 * y + r22 * z + tz
                clamped = pz if pz > nearest else nearest
                sphere = clamped * clamped - radius_squared[n]
                per_depth = clamped / (sphere if sphere > half * clamped * clamped else half * clamped * clamped)
                x, y, _, _, _, rr = kernels.distort(one, px * per_depth, py * per_depth, k1, k2, p1, p2, k3)
                u, v = fx * x + cx, fy * y + cy
                slope = one + rr * (slope1 + rr * (slope2 + rr * slope3))
                inside = (u >= -half) & (v >= -half) & (u <= width) & (v <= height)
                visible = inside & (pz > nearest) & (slope > zero) & (rr < blind_from)
                image[b, c, 0, n], image[b, c, 1, n], image[b, c, 2, n] = u, v, pz
                image[b, c, 3, n] = one if visible else zero


def undistort_cpu(xy_distorted: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """Do the work of `projection.undistort` for tensors on the CPU, without gradients, until nothing changes any more.

    Args:
        xy_distorted: (*B, C, N, 2) distorted coordinates on the z = 1 plane.
        distortion: (*B, C, 5).
    """
    distorted = xy_distorted.detach().double().reshape(-1, 2).contiguous().numpy()
    lenses = distortion.detach().double().unsqueeze(-2).expand(*xy_distorted.shape[:-1], 5).reshape(-1, 5).numpy()
    xy, good = np.empty_like(distorted), np.empty(len(distorted), dtype=np.bool_)
    _undistort(distorted, lenses, xy, good)
    shape = xy_distorted.shape
    return torch.from_numpy(xy).to(xy_distorted.dtype).reshape(shape), torch.from_numpy(good).reshape(shape[:-1])


@njit(fastmath=kernels.FAST, error_model="numpy")
def _undistort(distorted: Array, lenses: Array, xy: Array, good: NDArray[np.bool_]) -> None:
    rounding = 64 * np.finfo(np.float64).eps
    for m in range(len(distorted)):
        k1, k2, p1, p2, k3 = lenses[m]
        xd, yd = distorted[m]
        x, y, error, rr = xd, yd, np.inf, 0.0
        for _ in range(9):
            ux, uy, jxx, jxy, jyy, rr = kernels.distort(1.0, x, y, k1, k2, p1, p2, k3)
            ex, ey = ux - xd, uy - yd
            error = max(abs(ex), abs(ey))
            if error < 4 * np.finfo(np.float64).eps:
                break
            determinant = jxx * jyy - jxy * jxy
            x, y = x - (jyy * ex - jxy * ey) / determinant, y - (jxx * ey - jxy * ex) / determinant
        slope1, slope2, slope3 = 3 * k1, 5 * k2, 7 * k3
        before_fold = 1 + rr * (slope1 + rr * (slope2 + rr * slope3)) > 0
        before_fold = before_fold and rr < kernels.blind_from(slope1, slope2, slope3)
        good[m] = error < rounding and before_fold
        xy[m, 0], xy[m, 1] = (x, y) if good[m] else (xd, yd)
