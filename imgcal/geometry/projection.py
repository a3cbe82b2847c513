"""Pinhole projection with Brown-Conrady distortion: kornia's ops for training, a fused path for speed, proven equal.

Conventions: OpenCV camera frame (x right, y down, z forward); pixel (0, 0) is the centre of the top-left pixel;
distortion coefficients k1, k2, p1, p2, k3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.geometry.calibration import distort_points
from torch import Tensor

# Nearer than this (mm) a point counts as behind the camera; its pixel is computed at this depth and stays finite.
NEAREST_DEPTH = 1e-3


@dataclass(frozen=True)
class Projection:
    """Image of points in cameras; `visible` alone says whether a pixel means anything.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("O10"), imgcal.load_object("cube8")
        >>> seen = rig.project(obj.points + obj.points.new_tensor([0.0, 0.0, rig.working_distance]))
        >>> seen.uv.shape, bool(seen.visible.all())
        (torch.Size([10, 8, 2]), True)
    """

    uv: Tensor  # (*B, C, N, 2) pixels, always finite for finite input
    depth: Tensor  # (*B, C, N) mm along the optical axis
    visible: Tensor  # (*B, C, N) bool: in front, inside the image, before the distortion folds over


def resized_pixels(uv: Tensor, scale: Tensor | float) -> Tensor:
    """Take pixels to the same image in another size, by the pixel-centre rule u' + 1/2 = scale (u + 1/2).

    Examples:
        >>> resized_pixels(torch.tensor([0.0, 9.0]), 0.5)
        tensor([-0.2500,  4.2500])
    """
    return (uv + 0.5) * scale - 0.5


def apparent_centre_scale(depth: Tensor, radius: Tensor | None) -> Tensor | float:
    """Factor that takes the centre of a sphere to the centre of its elliptic image, on the z = 1 plane.

    Args:
        depth: (*B, N) mm.
        radius: (N,) mm, radius of each spherical fiducial; None = points.

    Returns:
        (*B, N) factor 1 / (1 - (radius / depth)^2).

    Source: the tangent cone of a sphere at (x, 0, z) meets z = 1 at tan(a + b) and tan(a - b); their mean is
    x z / (z^2 - r^2).
    """
    if radius is None:
        return 1.0
    return 1 / (1 - (radius / depth.clamp_min(NEAREST_DEPTH)).square().clamp_max(0.5))


def project(
    points_cam: Tensor,
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
) -> Projection:
    """Project points in camera frames to pixels: the fused path, plain component arithmetic.

    Args:
        points_cam: (*B, C, N, 3) mm.
        focal_length: (*B, C, 2) pixels.
        principal_point: (*B, C, 2) pixels.
        distortion: (*B, C, 5) k1, k2, p1, p2, k3.
        image_size: (C, 2) width, height in pixels.
        radius: (N,) mm, radius of spherical fiducials, whose apparent centre is projected; None = points.

    Returns:
        The projection, differentiable in every floating-point argument.
    """
    return project_components(points_cam.unbind(-1), focal_length, principal_point, distortion, image_size, radius)


def project_components(
    points_cam: tuple[Tensor, ...],
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
) -> Projection:
    """Do the work of `project` on separate x, y, z components (*B, C, N) mm: contiguous components are fastest."""
    px, py, depth = points_cam
    inverse_depth = apparent_centre_scale(depth, radius) / depth.clamp_min(NEAREST_DEPTH)
    x, y = px * inverse_depth, py * inverse_depth
    k1, k2, p1, p2, k3 = distortion.unsqueeze(-2).unbind(-1)
    xd, yd, _, rr = _distort(x, y, k1, k2, p1, p2, k3)
    fx, fy = focal_length.unsqueeze(-2).unbind(-1)
    cx, cy = principal_point.unsqueeze(-2).unbind(-1)
    u, v = fx * xd + cx, fy * yd + cy
    visible = is_inside(u, v, image_size) & (depth > NEAREST_DEPTH) & is_before_fold(rr, distortion)
    return Projection(torch.stack((u, v)).movedim(0, -1), depth, visible)


def project_kornia(
    points_cam: Tensor,
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
) -> Projection:
    """Project like `project`, through kornia's distortion: the path of training losses.

    Convention: every argument is expanded to the full (*B, C) shape first, because kornia pairs axes by position.

    Source: kornia.geometry.calibration.distort_points (kornia 0.9).
    """
    depth = points_cam[..., 2]
    scale = apparent_centre_scale(depth, radius) / depth.clamp_min(NEAREST_DEPTH)
    xy = points_cam[..., :2] * scale[..., None]
    batch = xy.shape[:-2]
    eye = torch.eye(3, dtype=xy.dtype, device=xy.device).expand(*batch, 3, 3)
    flat = (xy.reshape(-1, *xy.shape[-2:]), eye.reshape(-1, 3, 3), distortion.expand(*batch, 5).reshape(-1, 5))
    distorted = distort_points(*flat, new_K=flat[1]).reshape(xy.shape)
    uv = distorted * focal_length.unsqueeze(-2) + principal_point.unsqueeze(-2)
    inside = is_inside(uv[..., 0], uv[..., 1], image_size)
    visible = inside & (depth > NEAREST_DEPTH) & is_before_fold(xy.square().sum(-1), distortion)
    return Projection(uv, depth, visible)


def is_inside(u: Tensor, v: Tensor, image_size: Tensor) -> Tensor:
    """Tell which pixels (*B, C, N) lie inside the image, image_size (C, 2): borders at -0.5 and size - 0.5."""
    limit = (image_size - 0.5).to(u.dtype)
    # Distances to the nearest border: a comparison costs several times as much as a minimum.
    across = torch.minimum(u + 0.5, limit[:, :1] - u)
    down = torch.minimum(v + 0.5, limit[:, 1:] - v)
    return torch.minimum(across, down) >= 0


def is_before_fold(rr: Tensor, distortion: Tensor) -> Tensor:
    """Tell which points lie before the radius at which radial distortion stops growing (the image folds over).

    Args:
        rr: (*B, C, N) squared radius on the z = 1 plane.
        distortion: (*B, C, 5).

    Returns:
        (*B, C, N) bool: the derivative 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 of the distorted radius is positive for every
        s in [0, rr]. The smallest value of a cubic on an interval is at an end or at its one local minimum.
    """
    k1, k2, _, _, k3 = distortion.detach().unsqueeze(-2).unbind(-1)
    rr = rr.detach()
    a, b, c = 3 * k1, 5 * k2, 7 * k3

    def slope(s: Tensor) -> Tensor:
        return 1 + s * (a + s * (b + s * c))

    # The local minimum, (root - b) / (3 c), in forms that stay accurate as c goes to zero; nan or infinite without one.
    root = (b * b - 3 * a * c).sqrt()
    lowest = torch.where(b > 0, -a / (b + root), (root - b) / (3 * c))
    # Where the slope dips below zero, a camera is blind from there on, though the slope may recover farther out.
    blind_from = torch.where((lowest > 0) & (slope(lowest) <= 0), lowest, torch.inf)
    return torch.minimum(slope(rr), blind_from - rr) > 0


def undistort(xy_distorted: Tensor, distortion: Tensor, iterations: int = 8) -> tuple[Tensor, Tensor]:
    """Invert the distortion by Newton's method with a two-by-two Jacobian.

    Args:
        xy_distorted: (*B, C, N, 2) distorted coordinates on the z = 1 plane.
        distortion: (*B, C, 5).
        iterations: Newton steps; 8 reach machine precision for the lenses of infrared rigs.

    Returns:
        (*B, C, N, 2) undistorted coordinates and (*B, C, N) bool: converged, and before the fold. Where false, the
        coordinates are the distorted ones.

    Examples:
        >>> xy, converged = undistort(torch.tensor([[[0.1, 0.2]]]), torch.tensor([[0.1, 0.0, 0.0, 0.0, 0.0]]))
        >>> xy.round(decimals=4), bool(converged.all())
        (tensor([[[0.0995, 0.1990]]]), True)
    """
    k1, k2, p1, p2, k3 = distortion.unsqueeze(-2).unbind(-1)
    xd, yd = xy_distorted.unbind(-1)
    x, y = xd, yd
    for _ in range(iterations):
        ex, ey, jxx, jxy, jyy, _ = distort_with_jacobian(x, y, k1, k2, p1, p2, k3)
        ex, ey = ex - xd, ey - yd
        determinant = jxx * jyy - jxy * jxy
        x, y = x - (jyy * ex - jxy * ey) / determinant, y - (jxx * ey - jxy * ex) / determinant
    ex, ey, _, _, _, rr = distort_with_jacobian(x, y, k1, k2, p1, p2, k3)
    error = torch.maximum((ex - xd).abs(), (ey - yd).abs())
    good = (error < 64 * torch.finfo(xd.dtype).eps) & is_before_fold(rr, distortion)
    return torch.where(good[..., None], torch.stack((x, y), dim=-1), xy_distorted), good


def distort_with_jacobian(
    x: Tensor, y: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor, k3: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Distorted point, its symmetric Jacobian (xx, xy, yy) and the squared radius."""
    xd, yd, radial, rr = _distort(x, y, k1, k2, p1, p2, k3)
    growth = 2 * (k1 + rr * (2 * k2 + 3 * rr * k3))
    jxx = radial + growth * x * x + 2 * p1 * y + 6 * p2 * x
    jxy = growth * x * y + 2 * p1 * x + 2 * p2 * y
    jyy = radial + growth * y * y + 6 * p1 * y + 2 * p2 * x
    return xd, yd, jxx, jxy, jyy, rr


def _distort(
    x: Tensor, y: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor, k3: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distorted point, the factor of the radius, and the squared radius.

    Source: Brown 1966, "Decentering Distortion of Lenses"; coefficients and their order as in OpenCV.
    """
    xx, yy, xy2 = x * x, y * y, 2 * x * y
    rr = xx + yy
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    return x * radial + p1 * xy2 + p2 * (rr + 2 * xx), y * radial + p1 * (rr + 2 * yy) + p2 * xy2, radial, rr
