"""Score tests for a camera that has moved: at which snapshot does it stop agreeing with the rest of the rig?

For a camera and a snapshot the question is whether a step of the camera's values from that snapshot on would explain
the residuals better. All other unknowns, the cameras' values and the poses, are free to change with it: they are
eliminated from the normal equations, so that no estimate has to be made again for any of the candidates. Residuals are
clipped, as Huber's loss clips them: a few wrong labels cannot make up a step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from imgcal.estimation.linearization import Problem, State, linearize
from imgcal.estimation.robust_losses import huber, squared
from imgcal.types import PARAMETERS

STEP = 8
"""Values of a camera that may step: rotation, position, focal lengths."""
WIDEST_STEP = 10.0
"""Standard deviation of a step, in those of the factory values."""
CLIP = 5.0
"""Standard deviations beyond which a residual counts no more."""
LEAST_SNAPSHOTS = 2
"""On either side of a step: one snapshot alone may be a slip of another kind."""
MOST_TIMES = 128
"""Places of a step that are tried in one pass; longer captures are searched in two."""
CHUNK = 256  # snapshots that are linearized at once

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Step:
    """The likeliest place of a step, and how likely."""

    camera: int
    row: int  # first snapshot after it
    statistic: float  # chi-squared of `STEP` degrees of freedom where there is none
    rivals: Array  # (C,) the largest statistic of each camera


@dataclass(frozen=True)
class Blocks:
    """Normal equations snapshot by snapshot, poses eliminated: whitened values of V cameras."""

    camera: Array  # (S, V, 15, 15) information of the labels
    gradient: Array  # (S, V, 15) with clipped residuals
    coupling: Array  # (S, V, 15, 6) with the pose, which is whitened
    pull: Array  # (S, 6) gradient of the whitened pose
    prior: Array  # (V, 15) offsets: the prior's gradient

    @cached_property
    def information(self) -> Array:
        """Of all cameras together, poses eliminated: (15 V, 15 V)."""
        size = self.prior.size
        wide = self.coupling.transpose(1, 2, 0, 3).reshape(size, -1)
        total = np.eye(size) - wide @ wide.T
        blocks = total.reshape(*self.prior.shape, *self.prior.shape)
        for camera, block in enumerate(self.camera.sum(0)):
            blocks[camera, :, camera, :] += block
        return total

    @cached_property
    def covariance(self) -> Array:
        """Of all cameras' whitened values: (15 V, 15 V)."""
        return np.asarray(np.linalg.inv(self.information), dtype=np.float64)

    @cached_property
    def downhill(self) -> Array:
        """Newton's step of all cameras' values: (15 V,)."""
        gradient = self.gradient.sum(0) + self.prior - np.einsum("svij,sj->vi", self.coupling, self.pull)
        return self.covariance @ gradient.reshape(-1)

    def statistics(self, camera: int, rows: NDArray[np.int64]) -> Array:
        """Score statistic of a step of one camera before each of some snapshots, in increasing order: (R,)."""
        own, coupling = self.camera[:, camera, :STEP], self.coupling[:, camera, :STEP]  # (S, 8, 15), (S, 8, 6)
        cross = -np.einsum("saj,svij->savi", coupling, self.coupling)  # (S, 8, V, 15)
        cross[:, :, camera] += own
        score = self.gradient[:, camera, :STEP] - np.einsum("saj,sj->sa", coupling, self.pull)
        cross, score = (_from(part, rows) for part in (cross.reshape(len(own), STEP, -1), score))  # from each row on
        inner = _from(own[..., :STEP] - coupling @ coupling.transpose(0, 2, 1), rows)
        information = inner - cross @ self.covariance @ cross.transpose(0, 2, 1)
        gradient = score - cross @ self.downhill
        information += np.eye(STEP) / WIDEST_STEP**2
        return np.einsum("ra,ra->r", gradient, np.linalg.solve(information, gradient[..., None])[..., 0])


def _from(parts: Array, rows: NDArray[np.int64]) -> Array:
    """Sum of parts (S, ...) from each of some rows on: (R, ...)."""
    return np.cumsum(np.add.reduceat(parts, rows)[::-1], axis=0)[::-1]


def blocks_of(problem: Problem, state: State) -> Blocks:
    """Linearize snapshot by snapshot, at a state of one rig."""
    count = problem.uv.shape[1]
    parts = [_linearized(problem, state, slice(first, first + CHUNK)) for first in range(0, count, CHUNK)]
    camera, gradient, coupling, pull = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Blocks(camera, gradient, coupling, pull, state.offset[0].numpy())


def _linearized(problem: Problem, state: State, rows: slice) -> tuple[Array, Array, Array, Array]:
    """Blocks of some snapshots, taken as rigs of one snapshot each."""
    uv, root_weight = problem.uv[0, rows, None], problem.root_weight[0, rows, None]
    same = torch.zeros(len(uv), dtype=torch.long)
    alone = replace(problem.select(same), uv=uv, root_weight=root_weight)
    shape = None if state.object_offset is None else state.object_offset[same]
    there = State(state.offset[same], state.rotation[0, rows, None], state.centre[0, rows, None], shape)
    full, clipped = (linearize(alone, there, loss) for loss in (squared, lambda r: huber(r, CLIP)))
    eye = torch.eye(PARAMETERS, dtype=uv.dtype)
    lower = torch.linalg.cholesky(full.pose[:, 0])
    coupling = torch.linalg.solve_triangular(lower[:, None], full.coupling[:, 0].mT, upper=False).mT
    pull = torch.linalg.solve_triangular(lower, clipped.pose_gradient[:, 0, :, None], upper=False)[..., 0]
    # The prior's pull is the same in each of them, and counts once.
    gradient = clipped.camera_gradient - there.offset
    return (full.camera - eye).numpy(), gradient.numpy(), coupling.numpy(), pull.numpy()


def likeliest_step(blocks: Blocks, seen: NDArray[np.bool_]) -> Step | None:
    """Find the camera and the snapshot at which a step explains most; None = nothing could be seen to step.

    Args:
        blocks: of S snapshots and V cameras.
        seen: (S, V) bool, snapshots in which a camera has labels.
    """
    best: Step | None = None
    rivals = np.zeros(seen.shape[1])
    for camera in range(seen.shape[1]):
        shown = np.flatnonzero(seen[:, camera])
        rows = shown[LEAST_SNAPSHOTS : len(shown) - LEAST_SNAPSHOTS + 1]
        if not len(rows):
            continue
        coarse = (
            rows[np.unique(np.linspace(0, len(rows) - 1, MOST_TIMES).astype(int))] if len(rows) > MOST_TIMES else rows
        )
        statistics = blocks.statistics(camera, coarse)
        if len(coarse) < len(rows):
            place = int(statistics.argmax())
            near = (rows >= coarse[max(place - 1, 0)]) & (rows <= coarse[min(place + 1, len(coarse) - 1)])
            coarse = rows[near]
            statistics = blocks.statistics(camera, coarse)
        rivals[camera] = statistics.max()
        if best is None or rivals[camera] > best.statistic:
            best = Step(camera, int(coarse[statistics.argmax()]), float(rivals[camera]), rivals)
    return best


def dispersion(blocks: Blocks, seen: NDArray[np.bool_]) -> float:
    """How many times larger statistics are than independent noise makes them, where nothing steps; at least one.

    Errors of lenses, of the object and of blob centres depend on where the object is, and so on time: each snapshot
    says less than it seems to.
    """
    found = []
    for camera in range(seen.shape[1]):
        shown = np.flatnonzero(seen[:, camera])
        rows = shown[LEAST_SNAPSHOTS : len(shown) - LEAST_SNAPSHOTS + 1]
        if len(rows):
            few = rows[np.unique(np.linspace(0, len(rows) - 1, 16).astype(int))]
            found.append(blocks.statistics(camera, few))
    return max(1.0, float(np.median(np.concatenate(found))) / float(chi2.median(STEP))) if found else 1.0


def is_significant(statistic: float, candidates: int, error: float) -> bool:
    """Tell whether a statistic is larger than chance makes the largest of so many, but for an error probability."""
    return candidates * float(chi2.sf(statistic, STEP)) < error
