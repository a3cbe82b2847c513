"""How much more the snapshots disagree about the rig than their noise allows.

Errors of lenses, centroids and the object go with place and time, so that many snapshots say the same wrong thing: the
inverse of the information, which takes all residuals for independent, is then too small. The snapshots are parted into
blocks that follow each other, long enough to be nearly independent, and the estimate without each block is compared
with the estimate from all. Were the residuals independent, the difference would have the covariance

    C_without - C,    C = (1 + sum H_b)^-1,    C_without = (1 + sum H_b - H_block)^-1,

where H_b is a block's information about the (whitened) parameters once its poses have adapted, and 1 that of the prior.
The squared differences over these variances, averaged over all parameters, are the factor by which the noise's part of
the covariance is too small; one for all parameters keeps what the covariance says about their relations. Leaving a
block out, rather than summing the residuals' pulls, counts what the fit has taken of a block that it rests on.

Source: the delete-block jackknife (Kunsch, Annals of Statistics 1989), studentized by its value for independent noise,
as the bias-reduced cluster-robust covariances are (Bell and McCaffrey, Survey Methodology 2002). Errors that go on
across the border between two blocks are added by the flat-top window of Politis and Romano (1995): twice the scatter of
the double blocks less that of the single ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import Problem, State
from imgcal.estimation.map_estimate import equations_at
from imgcal.estimation.robust_losses import NamedLoss

LEAST_BLOCKS = 6
"""Blocks whose scatter is trusted."""
MANY_BLOCKS = 32
"""Blocks at first, and less than twice as many: each costs a factorization; they are then joined two by two."""
SURE = 4.0
"""Standard deviations by which the scatter of some blocks must exceed what independent noise makes it."""
OVERLAP = 2 / 3
"""Blocks that overlap all but fully tell as much as this share of those which do not."""
LEAST_SAID = 1e-6
"""Variance that leaving out a block adds to a parameter, in units of its prior, below which it is not looked at."""


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
    snapshots = problem.uv.shape[1]
    size = 1
    while snapshots // (2 * size) >= MANY_BLOCKS:
        size *= 2
    if snapshots // size < LEAST_BLOCKS:
        return BlockScatter()
    parts = [_evidence(problem, solution.state, first, first + size, loss) for first in range(0, snapshots, size)]
    information, pull = (torch.stack(part) for part in zip(*parts, strict=True))
    cameras, joined = problem.prior_std[0].numel(), 1
    found, before, sure = BlockScatter(), None, False
    while snapshots // (size * joined) >= LEAST_BLOCKS:
        scatter, deviation = _scatter(information, pull, joined, cameras)
        whole = scatter if before is None else max(2 * scatter - before, scatter)
        sure = sure or scatter > 1 + SURE * deviation
        if sure and whole > found.factor**2:
            found = BlockScatter(whole**0.5, size * joined)
        before, joined = scatter, 2 * joined
    return found


def _scatter(information: Tensor, pull: Tensor, joined: int, cameras: int) -> tuple[float, float]:
    """Squared changes of the parameters without each block over what independent noise makes them, averaged.

    Args:
        information: (B, D, D) of short blocks.
        pull: (B, D) of the same.
        joined: how many short blocks make a block; these overlap, and begin with each short one.
        cameras: number of the first parameters, those of the cameras, that are looked at.

    Returns:
        The average, and its standard deviation for independent noise.
    """
    total = information.sum(0)
    total.diagonal().add_(1)
    rows = torch.arange(len(pull) - joined + 1)[:, None] + torch.arange(joined)
    change, expected, covariance = [], [], torch.linalg.inv(total)[:cameras, :cameras]
    for row in rows:
        without = torch.linalg.inv(total - information[row].sum(0))[:cameras]
        change.append(without @ pull[row].sum(0))
        expected.append(without[:, :cameras] - covariance)
    variance = torch.stack([block.diagonal() for block in expected]).sum(0)
    known = variance > LEAST_SAID
    if not bool(known.any()):
        return 1.0, 1.0
    scale = torch.where(known, variance.clamp_min(LEAST_SAID).rsqrt(), 0.0) / known.sum() ** 0.5
    average = float((torch.stack(change) * scale).square().sum())
    squares = sum(float((block * scale[:, None] * scale).square().sum()) for block in expected)
    return average, (2 * max(OVERLAP * joined, 1.0) * squares) ** 0.5


def _evidence(problem: Problem, state: State, first: int, last: int, loss: NamedLoss) -> tuple[Tensor, Tensor]:
    """What snapshots `first` to `last` (excluded) say about the whitened parameters of cameras and object, D in all.

    Returns:
        (D, D) information and (D,) pull, their poses marginalized, without the prior.
    """
    part = replace(problem, uv=problem.uv[:, first:last], root_weight=problem.root_weight[:, first:last])
    there = replace(state, rotation=state.rotation[:, first:last], centre=state.centre[:, first:last])
    equations = equations_at(part, there, loss)
    own, coupling = equations.object, equations.coupling[0].permute(0, 3, 1, 2).flatten(2)  # (S, 6, K C)
    information = torch.block_diag(*equations.camera[0])
    pull = (state.offset - equations.camera_gradient)[0].flatten()
    if own is not None and state.object_offset is not None:
        across = own.camera[0].flatten(0, 1)
        information = torch.cat((torch.cat((information, across), 1), torch.cat((across.mT, own.own[0]), 1)))
        pull = torch.cat((pull, (state.object_offset - own.gradient)[0]))
        coupling = torch.cat((coupling, own.pose[0]), 2)
    factor = torch.linalg.cholesky(equations.pose[0])
    taken = torch.linalg.solve_triangular(factor, coupling, upper=False).flatten(0, 1)
    residue = torch.linalg.solve_triangular(factor, equations.pose_gradient[0, ..., None], upper=False).flatten()
    information = information - torch.eye(len(pull), dtype=pull.dtype, device=pull.device) - taken.mT @ taken
    return information, pull + taken.mT @ residue
