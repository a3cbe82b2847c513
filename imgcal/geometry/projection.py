"""Pinhole projection with any lens of `lenses.py`: kornia's ops for training, an equivalent fused path for speed.

Conventions: OpenCV camera frame (x right, y down, z forward); pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.geometry.lenses import DEFAULT, ModelNames, distort, distort_kornia, is_before_fold
from imgcal.messages import brief_repr

# A point nearer than this (mm) counts as behind the camera; its pixel is computed at this depth and stays finite.
NEAREST_DEPTH = 1e-3


@dataclass(frozen=True)
class Projection:
    """Image of points in cameras; only `visible` tells whether a pixel is valid.

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

    __repr__ = brief_repr


def resized_pixels(uv: Tensor, scale: Tensor | float) -> Tensor:
    """Convert pixels to the same image at another size, by the pixel-centre rule u' + 1/2 = scale (u + 1/2).

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
    models: ModelNames = DEFAULT,
) -> Projection:
    """Project points in camera frames to pixels: the fused path, plain component arithmetic.

    Args:
        points_cam: (*B, C, N, 3) mm.
        focal_length: (*B, C, 2) pixels.
        principal_point: (*B, C, 2) pixels.
        distortion: (*B, C, D) coefficients of the lenses.
        image_size: (C, 2) width, height in pixels.
        radius: (N,) mm, radius of spherical fiducials, whose apparent centre is projected; None = points.
        models: lens model of all cameras, or of each.

    Returns:
        The projection, differentiable in every floating-point argument.
    """
    components = points_cam.unbind(-1)
    return project_components(components, focal_length, principal_point, distortion, image_size, radius, models)


def project_components(
    points_cam: tuple[Tensor, ...],
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
    models: ModelNames = DEFAULT,
) -> Projection:
    """Project like `project`, from separate x, y, z components (*B, C, N) mm: contiguous components are fastest."""
    px, py, depth = points_cam
    inverse_depth = apparent_centre_scale(depth, radius) / depth.clamp_min(NEAREST_DEPTH)
    x, y = px * inverse_depth, py * inverse_depth
    xd, yd, rr = distort(x, y, distortion, models)
    fx, fy = focal_length.unsqueeze(-2).unbind(-1)
    cx, cy = principal_point.unsqueeze(-2).unbind(-1)
    u, v = fx * xd + cx, fy * yd + cy
    visible = is_inside(u, v, image_size) & (depth > NEAREST_DEPTH) & is_before_fold(rr, distortion, models)
    return Projection(torch.stack((u, v)).movedim(0, -1), depth, visible)


def project_kornia(
    points_cam: Tensor,
    focal_length: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    image_size: Tensor,
    radius: Tensor | None = None,
    models: ModelNames = DEFAULT,
) -> Projection:
    """Project like `project`, through kornia's distortion: the path of training losses.

    Convention: every argument is expanded to the full (*B, C) shape first, because kornia pairs axes by position.

    Source: `kornia_distortion.py`.
    """
    depth = points_cam[..., 2]
    scale = apparent_centre_scale(depth, radius) / depth.clamp_min(NEAREST_DEPTH)
    xy = points_cam[..., :2] * scale[..., None]
    distorted = distort_kornia(xy, distortion.expand(*xy.shape[:-2], -1), models)
    uv = distorted * focal_length.unsqueeze(-2) + principal_point.unsqueeze(-2)
    inside = is_inside(uv[..., 0], uv[..., 1], image_size)
    visible = inside & (depth > NEAREST_DEPTH) & is_before_fold(xy.square().sum(-1), distortion, models)
    return Projection(uv, depth, visible)


def is_inside(u: Tensor, v: Tensor, image_size: Tensor) -> Tensor:
    """Tell which pixels (*B, C, N) lie inside the image, image_size (C, 2): borders at -0.5 and size - 0.5."""
    limit = (image_size - 0.5).to(u.dtype)
    # Distances to the nearest border: a comparison costs several times as much as a minimum.
    across = torch.minimum(u + 0.5, limit[:, :1] - u)
    down = torch.minimum(v + 0.5, limit[:, 1:] - v)
    return torch.minimum(across, down) >= 0
