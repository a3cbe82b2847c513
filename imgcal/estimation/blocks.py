"""How much more the snapshots disagree about the rig than their noise allows.

Errors of lenses, centroids and the object go with place and time, so that many snapshots say the same wrong thing: the
inverse of the information, which takes all residuals for independent, is then too small. The influence of each snapshot
on the estimate, summed over blocks of snapshots that follow each other, is independent from block to block. What the
blocks say about focal lengths and principal points, which no motion of the whole rig can change, is compared with what
noise would make them say; one factor for all parameters keeps what the covariance says about their relations.

Source: the cluster-robust ("sandwich") covariance, Liang and Zeger (Biometrika 1986), pooled because blocks are few.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.estimation.covariance import whitened_covariance
from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import Problem
from imgcal.estimation.map_estimate import equations_by_snapshot
from imgcal.estimation.robust_losses import NamedLoss

LEAST_BLOCKS = 6
"""Blocks whose scatter is trusted."""
SURE = 4.0
"""Standard deviations by which the scatter must exceed what noise makes it."""

POOLED = (slice(6, 8), slice(8, 10))
"""Parameters whose scatter is looked at: focal lengths, principal points."""
LEAST_SAID = 1e-6
"""Variance that noise gives a parameter, in units of its prior, below which it is not looked at."""
LEAST_CORRELATED = 1e-3
"""Eigenvalue of a correlation below which a direction is rounding."""


@dataclass(frozen=True)
class BlockScatter:
    """Scatter of the blocks' influences, over what the noise makes it."""

    factor: float = 1.0  # on the standard deviations that the noise gives the parameters; at least 1
    length: int = 0  # snapshots in a block, where they scatter most; 0 = no more than the noise makes them


def block_scatter(problem: Problem, solution: Solution, loss: NamedLoss) -> BlockScatter:
    """Measure the scatter for one rig, B = 1.

    Args:
        problem: given, snapshots in the order of time.
        solution: the minimum.
        loss: of the fit.
    """
    snapshots, cameras = problem.uv.shape[1:3]
    if snapshots < LEAST_BLOCKS:
        return BlockScatter()
    covariance = whitened_covariance(solution)[0]
    equations = equations_by_snapshot(problem, solution.state, loss)
    pull = (solution.state.offset - equations.camera_gradient).flatten(1)  # the prior's own pull taken out
    pull = pull - pull.mean(0)
    found, size = BlockScatter(), 1
    numbers = torch.arange(pull.shape[1]).view(cameras, -1)
    kinds = [_whitened(pull, covariance, numbers[:, part].flatten()) for part in POOLED]
    while snapshots // size >= LEAST_BLOCKS:
        count = snapshots // size
        for whitened in kinds:
            sums = whitened[: count * size].unflatten(0, (count, size)).sum(1)  # (blocks, D)
            ratio = float(sums.var(0).mean()) * snapshots / size if sums.shape[1] else 0.0
            certain = 1 + SURE * (2 / (count * max(sums.shape[1], 1))) ** 0.5
            if ratio > max(certain, found.factor**2):
                found = BlockScatter(ratio**0.5, size)
        size *= 2
    return found


def _whitened(pull: Tensor, covariance: Tensor, rows: Tensor) -> Tensor:
    """Influences (S, D) of pulls (S, K C) on parameters of a kind, along directions in which noise makes their sum
    vary by one; parameters of which the data say nothing are left out.
    """
    columns = covariance[:, rows]
    by_noise = covariance[rows[:, None], rows] - columns.mT @ columns  # the rest is the prior's
    influence, known = pull @ columns, by_noise.diagonal() > LEAST_SAID
    by_noise, influence = by_noise[known][:, known], influence[:, known]
    scale = by_noise.diagonal().sqrt()
    values, vectors = torch.linalg.eigh(by_noise / (scale[:, None] * scale))
    sure = values > LEAST_CORRELATED
    return influence / scale @ vectors[:, sure] * values[sure].rsqrt()
