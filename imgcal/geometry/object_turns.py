"""Unobservable rotations of an object: those of a stick about its axis, and all rotations of a single marker."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from imgcal.geometry.kernels import fill_free_turns


def free_turns(points: Tensor) -> Tensor:
    """Projector (3, 3) onto rotations about the origin that leave points (N, 3) in place.

    Examples:
        >>> free_turns(torch.tensor([[0.0, 0.0, -250.0], [0.0, 0.0, 250.0]])).diagonal()
        tensor([0., 0., 1.])
    """
    turns = np.empty((3, 3))
    fill_free_turns(points.detach().cpu().double().numpy(), turns)
    return torch.from_numpy(turns).to(points)


def pose_rank(points: Tensor) -> int:
    """Number of a pose's 6 degrees of freedom that points (N, 3) determine: 3 for one point, 5 for a line, else 6.

    Examples:
        >>> pose_rank(torch.zeros(1, 3)), pose_rank(torch.eye(3))
        (3, 6)
    """
    return 6 - fill_free_turns((points - points.mean(0)).detach().cpu().double().numpy(), np.empty((3, 3)))
