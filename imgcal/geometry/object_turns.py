"""Turns of an object that nothing of it shows: those of a stick about itself, all of a single light."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from imgcal.geometry.kernels import fill_free_turns


def free_turns(points: Tensor) -> Tensor:
    """Projector (3, 3) onto the turns about the origin that leave points (N, 3) where they are.

    Examples:
        >>> free_turns(torch.tensor([[0.0, 0.0, -250.0], [0.0, 0.0, 250.0]])).diagonal()
        tensor([0., 0., 1.])
    """
    turns = np.empty((3, 3))
    fill_free_turns(points.detach().cpu().double().numpy(), turns)
    return torch.from_numpy(turns).to(points)


def pose_rank(points: Tensor) -> int:
    """How many of the 6 numbers of a pose some points (N, 3) show: 3 of one point, 5 of a line, else 6.

    Examples:
        >>> pose_rank(torch.zeros(1, 3)), pose_rank(torch.eye(3))
        (3, 6)
    """
    return 6 - fill_free_turns((points - points.mean(0)).detach().cpu().double().numpy(), np.empty((3, 3)))
