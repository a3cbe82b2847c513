"""Images of physical markers: the ellipses that spheres project to."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.geometry import NEAREST_DEPTH, distort_with_jacobian
from imgcal.types import CameraRig


def sphere_images(rig: CameraRig, points_rig: Tensor, radius: Tensor) -> Tensor:
    """Shapes of the images of spheres, to first order in the distortion across a marker.

    Args:
        rig: (*B) cameras.
        points_rig: (*B, N, 3) mm, centres of the spheres.
        radius: (N,) mm.

    Returns:
        (*B, C, N, 2, 2) pixels^2: A of the boundary (x - centre)^T A^-1 (x - centre) = 1. The centres are those of
        `rig.project(points_rig, radius)`.

    Source: rays d that touch a sphere at p satisfy (p d)^2 = (|p|^2 - r^2) |d|^2, a conic on the z = 1 plane.
    """
    points = rig.cam_from_rig.rotation @ points_rig.unsqueeze(-3).mT + rig.cam_from_rig.translation[..., None]
    x, y, z = points.unbind(-2)  # (*B, C, N)
    z = z.clamp_min(NEAREST_DEPTH)
    squared = radius * radius
    gap = (z * z - squared).clamp_min(NEAREST_DEPTH)
    # In the radial direction the ellipse's squared semi-axis is r^2 (|p|^2 - r^2) / gap^2, across it is r^2 / gap.
    scale = squared / (gap * gap)
    aa, ab, bb = scale * (gap + x * x), scale * x * y, scale * (gap + y * y)
    cx, cy = x * z / gap, y * z / gap
    _, _, jxx, jxy, jyy, _ = distort_with_jacobian(cx, cy, rig.distortion, rig.lens_model)
    fx, fy = rig.focal_length.unsqueeze(-2).unbind(-1)
    uu = fx * fx * (jxx * jxx * aa + 2 * jxx * jxy * ab + jxy * jxy * bb)
    uv = fx * fy * (jxx * jxy * aa + (jxx * jyy + jxy * jxy) * ab + jxy * jyy * bb)
    vv = fy * fy * (jxy * jxy * aa + 2 * jxy * jyy * ab + jyy * jyy * bb)
    return torch.stack((uu, uv, uv, vv), dim=-1).unflatten(-1, (2, 2))
