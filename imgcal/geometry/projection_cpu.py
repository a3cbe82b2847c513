"""Projection without gradients on CPUs: `CameraRig.project` compiled to one loop, without temporaries.

`projection.py` does the same with tensors on any device; tests compare the two.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import kernels
from imgcal.geometry.lens_kernels import CompiledLens, as_tuple, chain_models, compile_as, compile_each_lens
from imgcal.geometry.lens_model import Formula
from imgcal.geometry.lenses import DEFAULT, ModelNames, lens_codes
from imgcal.geometry.projection import NEAREST_DEPTH, Projection
from imgcal.geometry.shapes import require_shapes
from imgcal.geometry.transforms import RigidTransform
from renderers.compiling import njit

STEPS = 25
"""Most steps of Newton's method on the inverse of a lens."""


def project_cpu(
    points_rig: Tensor,
    cam_from_rig: RigidTransform,
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
    models: ModelNames = DEFAULT,
) -> Projection:
    """Project like `projection.project_components`, for tensors on the CPU: without gradients, several times faster.

    Args:
        points_rig: (*B, N, 3) mm; all others have the same floating-point type.
        cam_from_rig: (*B, C).
        focal_length: (*B, C, 2) pixels.
        principal_point: (*B, C, 2) pixels.
        distortion: (*B, C, D) coefficients of the lenses.
        image_size: (C, 2) pixels, width and height.
        radius: (N,) mm of spherical fiducials; None = points.
        models: lens model of all cameras, or of each.

    Raises:
        InputError: shapes that do not fit together.
    """
    given = (cam_from_rig.rotation, cam_from_rig.translation, focal_length, principal_point, distortion)
    # NumPy's calls take half the time of PyTorch's, and its large arrays ask Linux for huge pages.
    points = np.ascontiguousarray(points_rig.detach().numpy().swapaxes(-1, -2))
    batch, fiducials, kind = points.shape[:-2], points.shape[-1], points.dtype
    count = math.prod(batch)
    radius_squared = np.zeros(fiducials, kind) if radius is None else radius.detach().numpy().astype(kind) ** 2
    arrays = [np.ascontiguousarray(tensor.detach().numpy()) for tensor in given]
    sizes = np.ascontiguousarray(image_size.numpy())
    cameras, width = _require_fit(points, radius_squared, arrays, sizes)
    image = np.empty((count, cameras, 4, fiducials), kind)  # u, v, depth, visible
    points, *arrays = (array.reshape(count, *array.shape[len(batch) :]) for array in (points, *arrays))
    project_arrays(lens_codes(models, cameras, width), (points, radius_squared, *arrays, sizes, image))
    image = image.reshape(*batch, *image.shape[1:])
    uv, depth, visible = image[..., :2, :].swapaxes(-1, -2), image[..., 2, :], image[..., 3, :] > 0
    return Projection(torch.from_numpy(uv), torch.from_numpy(depth), torch.from_numpy(visible))


def _require_fit(points, radius, arrays, sizes):
    """Number of cameras and width of the distortion, if the arrays of `project_cpu` have the shapes that follow."""
    *batch, axes, fiducials = points.shape
    if axes != 3 or points.dtype.kind != "f":
        found = f"points of shape {(*batch, fiducials, axes)} and type {points.dtype}"
        raise InputError(f"projection: found {found}, expected three real coordinates (mm) each")
    rotation, translation, focal_length, principal_point, distortion = arrays
    batch, cameras, width = tuple(batch), rotation.shape[-3], distortion.shape[-1]
    require_shapes(
        "projection",
        (
            ("rotation", rotation, (*batch, cameras, 3, 3)),
            ("translation", translation, (*batch, cameras, 3)),
            ("focal_length", focal_length, (*batch, cameras, 2)),
            ("principal_point", principal_point, (*batch, cameras, 2)),
            ("distortion", distortion, (*batch, cameras, width)),
            ("image_size", sizes, (cameras, 2)),
            ("radius", radius, (fiducials,)),
        ),
    )
    return cameras, width


def _projection(lens: CompiledLens, size: int) -> Formula:
    distort, blind = lens.distort, lens.blind_from

    @compile_as(lens.name, fastmath=kernels.FAST, error_model="numpy")
    def project(
        number, models, points, radius_squared, rotation, translation, focal_length, principal_point, distortion,
        image_size, image,
    ):  # fmt: skip
        # One output array, and constants of the points' own type: otherwise the inner loop is not vectorized.
        kind = points.dtype.type
        nearest, zero, half, one = kind(NEAREST_DEPTH), kind(0), kind(0.5), kind(1)
        for b in range(rotation.shape[0]):
            for c in range(rotation.shape[1]):
                if models is not None and models[c] != number:
                    continue
                r, t = rotation[b, c], translation[b, c]
                r00, r01, r02, tx = r[0, 0], r[0, 1], r[0, 2], t[0]
                r10, r11, r12, ty = r[1, 0], r[1, 1], r[1, 2], t[1]
                r20, r21, r22, tz = r[2, 0], r[2, 1], r[2, 2], t[2]
                fx, fy = focal_length[b, c]
                cx, cy = principal_point[b, c]
                k = as_tuple(distortion[b, c], size)
                width, height = kind(image_size[c, 0]) - half, kind(image_size[c, 1]) - half
                blind_from = kind(blind(k))
                for n in range(points.shape[2]):
                    x, y, z = points[b, 0, n], points[b, 1, n], points[b, 2, n]
                    px = r00 * x + r01 * y + r02 * z + tx
                    py = r10 * x + r11 * y + r12 * z + ty
                    pz = r20 * x + r21 * y + r22 * z + tz
                    clamped = pz if pz > nearest else nearest
                    sphere = clamped * clamped - radius_squared[n]
                    per_depth = clamped / (sphere if sphere > half * clamped * clamped else half * clamped * clamped)
                    x, y, _, _, _, rr, slope = distort(one, px * per_depth, py * per_depth, k)
                    u, v = fx * x + cx, fy * y + cy
                    inside = (u >= -half) & (v >= -half) & (u <= width) & (v <= height)
                    visible = inside & (pz > nearest) & (slope > zero) & (rr < blind_from)
                    image[b, c, 0, n], image[b, c, 1, n], image[b, c, 2, n] = u, v, pz
                    image[b, c, 3, n] = one if visible else zero

    return project


_project_all = chain_models("projection", compile_each_lens(_projection))


@njit(cache=True)
def project_arrays(models, given):
    """Fill an image (B, C, 4, N) with u, v, depth and visibility; `given` as in `project_cpu`, which calls this."""
    _project_all(models, *given)


def undistort_cpu(xy_distorted: Tensor, distortion: Tensor, models: ModelNames = DEFAULT) -> tuple[Tensor, Tensor]:
    """Undistort like `lenses.undistort`, for tensors on the CPU: without gradients, in as many steps as it takes.

    At most `STEPS`: near the edge of a lens that magnifies it many times, the start is too far off.

    Args:
        xy_distorted: (*B, C, N, 2) distorted coordinates on the z = 1 plane.
        distortion: (*B, C, D).
        models: lens model of all cameras, or of each.

    Raises:
        InputError: shapes that do not fit together.
    """
    cameras, points = xy_distorted.shape[-3:-1]
    width = distortion.shape[-1]
    require_shapes(
        "undistortion",
        (
            ("points", xy_distorted, (*xy_distorted.shape[:-1], 2)),
            ("distortion", distortion, (*distortion.shape[:-2], cameras, width)),
        ),
    )
    distorted = xy_distorted.detach().double().reshape(-1, cameras, points, 2).contiguous().numpy()
    lenses = distortion.detach().double().expand(*xy_distorted.shape[:-2], width).reshape(-1, cameras, width)
    xy, good = np.empty_like(distorted), np.empty(distorted.shape[:-1], dtype=np.bool_)
    _undistort(lens_codes(models, cameras, width), (distorted, lenses.contiguous().numpy(), xy, good))
    shape = xy_distorted.shape
    return torch.from_numpy(xy).to(xy_distorted.dtype).reshape(shape), torch.from_numpy(good).reshape(shape[:-1])


def _inverse(lens: CompiledLens, size: int) -> Formula:
    distort, blind, start = lens.distort, lens.blind_from, lens.start

    @compile_as(lens.name, fastmath=kernels.FAST, error_model="numpy")
    def undistort(number, models, distorted, lenses, xy, good):
        rounding = 64 * np.finfo(np.float64).eps
        for b in range(distorted.shape[0]):
            for c in range(distorted.shape[1]):
                if models is not None and models[c] != number:
                    continue
                k = as_tuple(lenses[b, c], size)
                blind_from = blind(k)
                for n in range(distorted.shape[2]):
                    xd, yd = distorted[b, c, n, 0], distorted[b, c, n, 1]
                    x, y = start(xd, yd, k)
                    error, rr, slope = np.inf, 0.0, 1.0
                    for _ in range(STEPS):
                        ux, uy, jxx, jxy, jyy, rr, slope = distort(1.0, x, y, k)
                        ex, ey = ux - xd, uy - yd
                        last, error = error, max(abs(ex), abs(ey))
                        if error < 4 * np.finfo(np.float64).eps or last <= error < rounding:
                            break
                        determinant = jxx * jyy - jxy * jxy
                        x, y = x - (jyy * ex - jxy * ey) / determinant, y - (jxx * ey - jxy * ex) / determinant
                    good[b, c, n] = error < rounding and slope > 0 and rr < blind_from
                    xy[b, c, n, 0], xy[b, c, n, 1] = (x, y) if good[b, c, n] else (xd, yd)

    return undistort


_undistort_all = chain_models("inverse", compile_each_lens(_inverse))


@njit(cache=True)
def _undistort(models, given):
    _undistort_all(models, *given)
