"""Blobs to render, and where their light is."""

import math

import torch
from torch import Tensor

from renderers import Spots


def blobs(uv: Tensor, shape: Tensor | float, depth: Tensor | None = None, intensity: float = 1.0) -> Spots:
    """Make visible blobs; a number is the radius of discs."""
    if not isinstance(shape, Tensor):
        shape = shape**2 * torch.eye(2, dtype=uv.dtype).expand(*uv.shape, 2)
    ones = torch.ones_like(uv[..., 0])
    return Spots(uv, shape, intensity * ones, ones > 0, ones if depth is None else depth)


def tilted(major: float, minor: float, angle: float) -> Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    root = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64) * torch.tensor([major, minor])
    return root @ root.mT


def centroid(frame: Tensor) -> Tensor:
    light = frame.double()
    v, u = (torch.arange(n, dtype=torch.float64) for n in frame.shape)
    return torch.stack([light.sum(0) @ u, light.sum(1) @ v]) / light.sum()
