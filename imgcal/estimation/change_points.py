"""Score tests for a camera that has moved: at which snapshot does it stop agreeing with the rest of the rig?

For a camera and a snapshot, the test asks whether a step of the camera's values from that snapshot on would explain the
residuals better. All other unknowns, the other cameras' values and the poses, may change with it. They are eliminated
from the normal equations, so no candidate needs a new estimate. Residuals are clipped, as Huber's loss clips them, so
that a few wrong labels cannot mimic a step.

The search runs once over a whole capture, offline, and finds steps as small as all of its data can show: all values of
the rig are free, lens parameters included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.special import chdtrc, chdtri

from imgcal.estimation.linearization import Problem, State
from imgcal.estimation.map_estimate import equations_by_snapshot
from imgcal.estimation.robust_losses import NamedLoss
from imgcal.medians import median

STEP = 8
"""Values of a camera that can step: rotation, position, focal lengths."""
WIDEST_STEP = 10.0
"""Standard deviation of a step, in prior standard deviations of the factory values."""
CLIP = 5.0
"""Standard deviations at which a residual is clipped."""
LEAST_SNAPSHOTS = 2
"""On either side of a step: one snapshot alone may be an outlier of another kind."""
MOST_TIMES = 128
"""Candidate snapshots that are tested in one pass; longer captures are searched in two."""
GROWTH = 1.5
"""Ratio between successive candidates of the first screening, in snapshots from the nearer end."""
NEARBY = 0.5
"""Smallest share of a step's statistic that remains at the nearest of these candidates; four fifths are expected."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Step:
    """The most likely step and its statistic."""

    camera: int
    row: int  # first snapshot after it
    statistic: float  # chi-squared with `STEP` degrees of freedom if there is no step
    rivals: Array  # (C,) the largest statistic of each camera


@dataclass(frozen=True)
class Blocks:
    """Normal equations of each snapshot, poses eliminated, for the whitened values of V cameras."""

    camera: Array  # (S, V, K, K) information of the labels
    gradient: Array  # (S, V, K) with clipped residuals
    coupling: Array  # (S, P, K V) with the whitened pose: six values, three of a single point
    pull: Array  # (S, P) gradient by the whitened pose
    prior: Array  # (V, K) offsets, which are the prior's gradient

    @cached_property
    def information(self) -> Array:
        """Information of all cameras together, poses eliminated: (K V, K V)."""
        tall = self.coupling.reshape(-1, self.prior.size)
        total = np.eye(self.prior.size) - tall.T @ tall
        blocks = total.reshape(*self.prior.shape, *self.prior.shape)
        for camera, block in enumerate(self.camera.sum(0)):
            blocks[camera, :, camera, :] += block
        return total

    @cached_property
    def _factor(self) -> Array:
        """Lower Cholesky factor of the information."""
        return np.asarray(np.linalg.cholesky(self.information))

    @cached_property
    def covariance(self) -> Array:
        """Covariance of all cameras' whitened values: (K V, K V)."""
        return np.asarray(np.linalg.inv(self.information), dtype=np.float64)

    @cached_property
    def downhill(self) -> Array:
        """Newton's step of all cameras' values: (K V,)."""
        gradient = self.gradient.sum(0) + self.prior
        tall = self.coupling.reshape(-1, self.prior.size)
        right = gradient.ravel() - self.pull.ravel() @ tall
        return np.asarray(cho_solve((self._factor, True), right, check_finite=False))

    def statistics(self, cameras: Sequence[int], rows: NDArray[np.int64]) -> Array:
        """Score statistics of steps at each of some snapshots (increasing), for each of some cameras: (R, K)."""
        chosen, size = np.asarray(cameras), self.prior.size
        width = self.prior.shape[1]
        stepping = (width * chosen[:, None] + np.arange(STEP)).ravel()
        mine = self.coupling[:, :, stepping]  # (S, 6, 8 K)
        ends = [*rows[1:], len(mine)]
        cross = np.empty((len(rows), len(stepping), size))
        for part, first, end in zip(cross, rows, ends, strict=True):
            part[:] = -mine[first:end].reshape(-1, len(stepping)).T @ self.coupling[first:end].reshape(-1, size)
        blocks = cross.reshape(len(rows), len(chosen), STEP, -1, width)
        number = np.arange(len(chosen))
        blocks[:, number, :, chosen] += np.add.reduceat(self.camera[:, chosen, :STEP], rows).swapaxes(0, 1)
        score = self.gradient[:, chosen, :STEP].reshape(len(mine), -1) - (self.pull[:, None] @ mine)[:, 0]
        cross, score = (_reverse_cumsum(part) for part in (cross, np.add.reduceat(score, rows)))
        blocks = cross.reshape(blocks.shape)
        inner = blocks[:, number, :, chosen, :STEP].swapaxes(0, 1)  # (R, K, 8, 8)
        gradient = (score - cross @ self.downhill).reshape(*inner.shape[:3], 1)
        half = solve_triangular(self._factor, cross.reshape(-1, size).T, lower=True, check_finite=False)
        known = half.T.reshape(*inner.shape[:3], size)
        information = inner - known @ known.swapaxes(-1, -2)
        information += np.eye(STEP) / WIDEST_STEP**2
        return (gradient * np.linalg.solve(information, gradient)).sum((-2, -1))


def _reverse_cumsum(parts: Array) -> Array:
    """Replace parts (R, ...) by their sums from each part to the end."""
    for row in range(len(parts) - 2, -1, -1):  # four times as fast as `cumsum` along the first axis
        parts[row] += parts[row + 1]
    return parts


def linearize_snapshots(problem: Problem, state: State) -> Blocks:
    """Linearize one rig's problem snapshot by snapshot at a state."""
    full = clipped = equations_by_snapshot(problem, state, NamedLoss("squared"))
    whitened = full.residual[:, 0] * problem.root_weight[0].unsqueeze(-2)
    if bool((whitened.square().sum(-2) > CLIP**2).any()):
        clipped = equations_by_snapshot(problem, state, NamedLoss("huber", CLIP))
    lower = torch.linalg.cholesky(full.pose[:, 0])
    coupling = torch.linalg.solve_triangular(lower, full.coupling[:, 0].flatten(1, 2).mT, upper=False)
    pull = torch.linalg.solve_triangular(lower, clipped.pose_gradient[:, 0, :, None], upper=False)[..., 0]
    observable = (coupling != 0).any(2).any(0)  # a single point has no visible rotation
    coupling, pull = coupling[:, observable], pull[:, observable]
    # Every snapshot's equations contain the prior; it must count only once.
    gradient = clipped.camera_gradient - state.offset
    camera = full.camera - torch.eye(full.camera.shape[-1], dtype=lower.dtype)
    return Blocks(
        camera.numpy(), gradient.numpy(), coupling.contiguous().numpy(), pull.numpy(), state.offset[0].numpy()
    )


def likeliest_step(blocks: Blocks, seen: NDArray[np.bool_], least: float = 0.0) -> Step | None:
    """Find the camera and the snapshot at which a step explains the most.

    Args:
        blocks: of S snapshots and V cameras.
        seen: (S, V) bool, snapshots in which a camera has labels.
        least: smallest statistic of interest; without a camera near it in the screening, the search ends early.

    Returns:
        The most likely step, or None where no camera has enough snapshots or no statistic reaches `least`.
    """
    places = {camera: rows for camera in range(seen.shape[1]) if len(rows := _places(seen[:, camera]))}
    first = [c for c, most in _screen(blocks, places).items() if most >= NEARBY * least] if least else list(places)
    found = {camera: _search(blocks, camera, places[camera]) for camera in first}
    if not found or max(statistic for statistic, _ in found.values()) < least:
        return None
    found |= {camera: _search(blocks, camera, places[camera]) for camera in places.keys() - found.keys()}
    rivals = np.zeros(seen.shape[1])
    for camera, (statistic, _) in found.items():
        rivals[camera] = statistic
    best = int(rivals.argmax())
    return Step(best, found[best][1], float(rivals[best]), rivals)


def _places(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Candidate snapshots for a step of a camera with labels in the snapshots `seen` (S,)."""
    shown = np.flatnonzero(seen)
    return shown[LEAST_SNAPSHOTS : len(shown) - LEAST_SNAPSHOTS + 1]


def _screen(blocks: Blocks, places: Mapping[int, NDArray[np.int64]]) -> dict[int, float]:
    """Screen all cameras at once: the largest statistic of each over a few candidates. Nearby steps show there, too."""
    few = {camera: rows[_sparse_indices(len(rows))] for camera, rows in places.items()}
    if not few:
        return {}
    rows = np.unique(np.concatenate(list(few.values())))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_TIMES)).astype(int))]
    statistics = blocks.statistics(list(few), rows)
    largest = {}
    for number, (camera, own) in enumerate(places.items()):
        inside = (rows >= own[0]) & (rows <= own[-1])
        largest[camera] = float(statistics[inside, number].max(initial=0.0))
    return largest


def _sparse_indices(count: int) -> NDArray[np.int64]:
    """Indices of a few of `count` candidates, denser towards either end, where the position matters more."""
    steps = LEAST_SNAPSHOTS * GROWTH ** np.arange(np.log(max(count, 2)) / np.log(GROWTH))
    near = np.unique(np.ceil(steps).astype(np.int64) - LEAST_SNAPSHOTS)
    near = near[near <= (count - 1) // 2]
    return np.unique(np.concatenate((near, count - 1 - near)))


def _search(blocks: Blocks, camera: int, rows: NDArray[np.int64]) -> tuple[float, int]:
    """Largest statistic of a camera over some candidates, and its snapshot."""
    tried = rows
    if len(rows) > MOST_TIMES:
        coarse = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_TIMES).astype(int))]
        place = int(blocks.statistics([camera], coarse).argmax())
        near = (rows >= coarse[max(place - 1, 0)]) & (rows <= coarse[min(place + 1, len(coarse) - 1)])
        tried = rows[near]
    statistics = blocks.statistics([camera], tried)[:, 0]
    best = int(statistics.argmax())
    return float(statistics[best]), int(tried[best])


def dispersion(blocks: Blocks, seen: NDArray[np.bool_]) -> float:
    """Factor by which statistics without a step exceed those of independent noise; at least one.

    Errors of lenses, of the object and of blob centres depend on where the object is, and so on time: each snapshot
    carries less information than independent noise would suggest.
    """
    found = []
    for camera in range(seen.shape[1]):
        rows = _places(seen[:, camera])
        if len(rows):
            few = rows[np.unique(np.linspace(0, len(rows) - 1, 16).astype(int))]
            found.append(blocks.statistics([camera], few))
    return max(1.0, median(np.concatenate(found)) / float(chdtri(STEP, 0.5))) if found else 1.0


def least_significant(candidates: int, error: float) -> float:
    """Smallest statistic for which `is_significant` holds."""
    return float(chdtri(STEP, error / max(candidates, 1)))


def is_significant(statistic: float, candidates: int, error: float) -> bool:
    """Test a statistic as the largest of `candidates`, at error probability `error`."""
    return candidates * float(chdtrc(STEP, statistic)) < error
