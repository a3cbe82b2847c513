"""Excess disagreement of the snapshots about the rig, beyond their noise.

Errors of lenses, centroids and the object are correlated in space and time, so many snapshots share the same error. The
inverse of the information, which assumes independent residuals, is then too small. The snapshots are divided into
consecutive blocks, long enough to be nearly independent, and the estimate without each block is compared with the
estimate from all. For independent residuals, the difference would have the covariance

    C_without - C,    C = (1 + sum H_b)^-1,    C_without = (1 + sum H_b - H_block)^-1,

where H_b is a block's information about the (whitened) parameters with its poses marginalized, and 1 that of the prior.
The squared differences over these variances, averaged over the parameters of a camera, are the factor by which the
noise part of its covariance is too small. One factor for all its parameters preserves their correlations. Cameras
differ widely, but few blocks determine a camera's own average only roughly. Where it is above the average of all
cameras, it is drawn towards that by half of its standard deviation; where it is below, most of the way, because errors
that last as long as the capture do not show. Leaving a block out, rather than summing the scores of the residuals,
accounts for the leverage of a block on the fit.

Source: the delete-block jackknife (Kunsch, Annals of Statistics 1989), studentized by its value for independent noise,
as the bias-reduced cluster-robust covariances are (Bell and McCaffrey, Survey Methodology 2002). Errors that are
correlated across the border between two blocks are added by the flat-top window of Politis and Romano (1995): twice the
scatter of the double blocks less that of the single ones.

To first order the difference is C times the block's score, and 1 - 1/blocks corrects for the block's leverage: to
within a twentieth where blocks are alike. That takes one inverse instead of one per block, and is enough to see that
there is no excess scatter to measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import NormalEquations, Problem, State
from imgcal.estimation.map_estimate import equations_at
from imgcal.estimation.robust_losses import NamedLoss

LEAST_BLOCKS = 6
"""Smallest number of blocks for a reliable scatter."""
MANY_BLOCKS = 32
"""Blocks at first (up to twice as many): each costs a factorization; they are then joined two by two."""
SCATTER_SIGMAS = 4.0
"""Standard deviations by which the scatter, of all cameras or of one, must exceed its value for independent noise."""
OWN, DRAWN = 0.3, 0.5
"""Weight of a camera's own scatter where it is below the average of all cameras, and standard deviations of it by which
it is drawn towards them where it is above. Chosen on calibrations with replayed noise (`replayed_gates` in
`scripts/benchmarks`: share beyond 3 sigma) and on blocks of a real recording (`real_blocks`: chi-squared of focal
lengths); half of both averages, and the camera's own alone, did worse."""
OVERLAP = 2 / 3
"""Variance of the average over heavily overlapping blocks, relative to that over disjoint ones."""
WORTH_MEASURING = 3.5
"""The same threshold of the first-order test, which needs no inverse per block and decides whether to measure. Near the
threshold its result is 0.2 below to 0.6 above the exact one (46 of 120 captures of 20 and 100 snapshots), so it misses
nothing; one in ten captures with white noise reaches it."""
LEAST_SAID = 1e-6
"""Smallest variance that leaving out a block must add to a parameter, in units of its prior, for it to be included."""


@dataclass(frozen=True)
class BlockScatter:
    """Scatter of the blocks' influences, relative to that of independent noise."""

    factor: Tensor | None = None  # (C,) on the standard deviations that noise gives a camera's parameters; at least 1
    length: int = 0  # snapshots in a block at the largest scatter of a camera; 0 = no excess over the noise


def block_scatter(problem: Problem, solution: Solution, loss: NamedLoss) -> BlockScatter:
    """Measure the scatter for one rig, B = 1.

    Args:
        problem: the problem, with snapshots in temporal order.
        solution: the minimum.
        loss: of the fit.
    """
    snapshots = problem.uv.shape[1]
    size = 1
    while snapshots // (2 * size) >= MANY_BLOCKS:
        size *= 2
    if snapshots // size < LEAST_BLOCKS:
        return BlockScatter()
    parts = [linearize_blocks(problem, solution.state, size, loss)]
    if snapshots % size:
        parts.append(linearize_blocks(problem, solution.state, snapshots % size, loss, snapshots - snapshots % size))
    pull = torch.cat([part.pull for part in parts])
    cameras, lengths = problem.prior_std[0], _powers_of_two(snapshots // size // LEAST_BLOCKS)
    if not _is_worth_measuring(torch.stack([part.total() for part in parts]).sum(0), pull, lengths, cameras.shape):
        return BlockScatter()
    information = torch.cat([part.information() for part in parts])
    largest, length = torch.ones_like(cameras[:, 0]), 0
    sure = torch.zeros(len(cameras), dtype=torch.bool, device=pull.device)
    before: Scatter | None = None
    for joined in lengths:
        scatter = _scatter(information, pull, joined, cameras.shape)
        sure |= scatter.own > 1 + SCATTER_SIGMAS * scatter.own_deviation
        sure |= scatter.average > 1 + SCATTER_SIGMAS * scatter.deviation
        factor = torch.where(sure, scatter.by_camera(before), 1.0)
        length = size * joined if bool(factor.max() > largest.max()) else length
        largest, before = torch.maximum(largest, factor), scatter
    return BlockScatter(largest.sqrt(), length) if length else BlockScatter()


def _powers_of_two(most: int) -> list[int]:
    """Powers of two up to `most`."""
    return [2**power for power in range(most.bit_length())]


def _is_worth_measuring(total: Tensor, pull: Tensor, lengths: list[int], shape: torch.Size) -> bool:
    """Test to first order whether blocks of any length scatter more than noise would, in all cameras or in one.

    Args:
        total: (D, D) information of all blocks, without the prior.
        pull: (B, D) scores of the short blocks.
        lengths: numbers of short blocks in a block.
        shape: (C, K) of the cameras' parameters, which come first.
    """
    wide = shape.numel()
    total = total + torch.eye(len(total), dtype=total.dtype, device=total.device)
    covariance = torch.cholesky_inverse(torch.linalg.cholesky(total))
    noise = (covariance - covariance @ covariance)[:wide, :wide]  # due to noise; the rest is due to the prior
    known = noise.diagonal() > LEAST_SAID
    scale = torch.where(known, noise.diagonal().clamp_min(LEAST_SAID).rsqrt(), 0.0)
    camera = torch.arange(shape[0], device=pull.device).repeat_interleave(shape[1])
    of_cameras = torch.nn.functional.one_hot(camera, shape[0]).to(pull)
    groups = torch.cat((torch.ones_like(scale)[:, None], of_cameras), 1) * known[:, None]  # of all, and of each: (K, G)
    groups /= groups.sum(0).clamp_min(1.0)
    squares = (noise * scale[:, None] * scale).square()
    spread = (groups.mT @ squares * groups.mT).sum(1)
    reached = torch.zeros(len(pull) + 1, wide, dtype=pull.dtype, device=pull.device)
    reached[1:] = ((pull @ covariance)[:, :wide] * scale).cumsum(0)
    for joined in lengths:
        change, blocks = reached[joined:] - reached[:-joined], len(pull) / joined
        scatter = change.square().mean(0) @ groups * (blocks / (1 - 1 / blocks))
        deviation = (2 * max(OVERLAP * joined, 1.0) * spread / len(change)).sqrt()
        if bool((scatter > 1 + WORTH_MEASURING * deviation).any()):
            return True
    return False


class Scatter(NamedTuple):
    """Squared changes of the parameters without each block, relative to independent noise."""

    average: float  # over all cameras
    deviation: float  # standard deviation of the average, for independent noise
    own: Tensor  # (C,) average over the parameters of a camera
    own_deviation: Tensor  # (C,) its standard deviation, for independent noise; infinite where nothing is known

    def by_camera(self, shorter: Scatter | None) -> Tensor:
        """Estimate the scatter of each camera: (C,); `shorter`: of blocks half as long, if there are any."""
        average, own = self.average, self.own
        if shorter is not None:
            average = max(2 * average - shorter.average, average)
            own = torch.maximum(2 * own - shorter.own, own)
        apart = own - average
        return average + OWN * apart.clamp_max(0.0) + (apart - DRAWN * own * self.own_deviation).clamp_min(0.0)


def _scatter(information: Tensor, pull: Tensor, joined: int, shape: torch.Size) -> Scatter:
    """Average the squared changes of the parameters without each block, relative to independent noise.

    Args:
        information: (B, D, D) of short blocks.
        pull: (B, D) scores of the same.
        joined: number of short blocks in a block; the blocks overlap, one begins with each short block.
        shape: (C, K) of the cameras' parameters, which come first; only these are used.
    """
    wide = shape.numel()
    total = information.sum(0)
    total.diagonal().add_(1)
    summed = [torch.zeros_like(total), *accumulate(information)]
    covariance = torch.cholesky_inverse(torch.linalg.cholesky(total))[:wide, :wide]
    change: list[Tensor] = []
    variance, squares = torch.zeros_like(covariance[0]), torch.zeros_like(covariance)
    for first, last in zip(summed, summed[joined:], strict=False):
        remaining = torch.cholesky_inverse(torch.linalg.cholesky(total - (last - first)))[:wide]
        change.append(remaining @ pull[len(change) : len(change) + joined].sum(0))
        expected = remaining[:, :wide] - covariance
        variance += expected.diagonal()
        squares += expected.square()
    known = variance > LEAST_SAID
    if not bool(known.any()):
        own = torch.ones(shape[0], dtype=pull.dtype, device=pull.device)
        return Scatter(1.0, 1.0, own, torch.full_like(own, torch.inf))
    scale = torch.where(known, variance.clamp_min(LEAST_SAID).rsqrt(), 0.0) / known.sum() ** 0.5
    ratio = (torch.stack(change) * scale).square().sum(0)
    average, share = float(ratio.sum()), known.view(shape).sum(1) / known.sum()
    own = torch.where(share > 0, ratio.view(shape).sum(1) / share.clamp_min(1e-9), average)
    squares *= scale.square()[:, None] * scale.square()
    of_cameras = squares.view(*shape, *shape).sum((1, 3)).diagonal() / share.clamp_min(1e-9).square()
    doubled = 2 * max(OVERLAP * joined, 1.0)
    own_deviation = torch.where(share > 0, (doubled * of_cameras).sqrt(), torch.inf)
    return Scatter(average, float((doubled * squares.sum()).sqrt()), own, own_deviation)


@dataclass(frozen=True)
class Evidence:
    """Evidence of B blocks of snapshots about the whitened parameters of cameras and object, D in all.

    Poses are marginalized, and the prior is left out.
    """

    equations: NormalEquations  # of B rigs, each with the prior
    taken: Tensor  # (B, P, D) factor of the information that the poses take
    pull: Tensor  # (B, D) score

    def information(self) -> Tensor:
        """Information of each block: (B, D, D)."""
        own = self.equations.object
        parts = None if own is None else (own.camera.flatten(1, 2), own.own)
        return _without_prior_and_poses(self.equations.camera, parts, 1, self.taken)

    def total(self) -> Tensor:
        """Information of all blocks together, (D, D): faster than the sum of `information`."""
        own, count = self.equations.object, len(self.pull)
        parts = None if own is None else (own.camera.flatten(1, 2).sum(0, True), own.own.sum(0, True))
        camera = self.equations.camera.sum(0, True)
        return _without_prior_and_poses(camera, parts, count, self.taken.flatten(0, 1)[None])[0]


def _without_prior_and_poses(camera: Tensor, own: tuple[Tensor, Tensor] | None, priors: int, taken: Tensor) -> Tensor:
    """Join the parts of dense normal equations: (B, D, D).

    Args:
        camera: (B, C, K, K) blocks of the cameras.
        own: (B, K C, M) coupling of the cameras with the object and (B, M, M) the object's block; None = exact object.
        priors: how many times the parts contain the prior's unit information.
        taken: (B, P, D) factor of the information that the poses take.
    """
    cameras, free = camera.shape[1:3]
    wide = cameras * free
    information = taken.mT @ taken.neg()
    blocks = information[:, :wide, :wide].unflatten(1, (cameras, free)).unflatten(-1, (cameras, free))
    blocks.diagonal(dim1=1, dim2=3).add_(camera.permute(0, 2, 3, 1))
    if own is not None:
        across, square = own
        information[:, :wide, wide:] += across
        information[:, wide:, :wide] += across.mT
        information[:, wide:, wide:] += square
    information.diagonal(dim1=1, dim2=2).sub_(priors)
    return information


def linearize_blocks(problem: Problem, state: State, size: int, loss: NamedLoss, first: int = 0) -> Evidence:
    """Linearize blocks of snapshots.

    Args:
        problem: one rig.
        state: its minimum.
        size: snapshots in each of the B blocks; leftover snapshots are ignored.
        loss: of the fit.
        first: the first snapshot of the first block.

    """
    count = (problem.uv.shape[1] - first) // size
    rows = slice(first, first + count * size)

    def repeat(tensor: Tensor) -> Tensor:
        return tensor.expand(count, *tensor.shape[1:])

    def divide(tensor: Tensor) -> Tensor:
        return tensor[0, rows].unflatten(0, (count, size))

    own_std, own_offset = problem.object_prior_std, state.object_offset
    blocks = replace(
        problem,
        uv=divide(problem.uv),
        root_weight=divide(problem.root_weight),
        factory=problem.factory.map_tensors(lambda tensor, _: repeat(tensor)),
        prior_std=repeat(problem.prior_std),
        object_prior_std=None if own_std is None else repeat(own_std),
    )
    there = State(
        repeat(state.offset), divide(state.rotation), divide(state.centre),
        None if own_offset is None else repeat(own_offset),
    )  # fmt: skip
    equations = equations_at(blocks, there, loss)
    own, coupling = equations.object, equations.coupling.permute(0, 1, 4, 2, 3).flatten(3)  # (B, S, 6, K C)
    pull = (there.offset - equations.camera_gradient).flatten(1)
    if own is not None and there.object_offset is not None:
        pull = torch.cat((pull, there.object_offset - own.gradient), 1)
        coupling = torch.cat((coupling, own.pose), 3)
    factor = torch.linalg.cholesky(equations.pose)
    taken = torch.linalg.solve_triangular(factor, coupling, upper=False).flatten(1, 2)
    residue = torch.linalg.solve_triangular(factor, equations.pose_gradient[..., None], upper=False).flatten(1, 3)
    return Evidence(equations, taken, pull + (taken.mT @ residue[..., None])[..., 0])
