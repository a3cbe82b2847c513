"""Has a camera changed since a belief was held? What has been learnt since is tested, kind of change by kind of change.

Between a belief and a later one about the same rig lie snapshots. If nothing changed, the later one differs from the
earlier one by no more than what was learnt: its difference has the covariance P_before - P_after, and the pull of the
snapshots on each parameter the covariance G = A - A S^-1 A, where A is the information that they brought and S that of
the later belief. A jump d of one camera's parameters before the first of these snapshots adds G d. The score test of
each kind of change of each camera asks whether that is there (a generalized likelihood ratio with the jump estimated);
nothing but the two beliefs is needed.

Source: Hausman, "Specification Tests in Econometrics", 1978; Willsky and Jones, "A Generalized Likelihood Ratio
Approach to the Detection and Estimation of Jumps in Linear Systems", 1976.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from imgcal.estimation.rig_error import error_between, step_by_error
from imgcal.estimation.rig_filter import RigBelief
from imgcal.types import PARAMETERS

CHANGES: Mapping[str, slice] = {
    "rotation": slice(0, 3),
    "position": slice(3, 6),
    "focal_length": slice(6, 8),
    "principal_point": slice(8, 10),
}
"""Kinds of change, and where they stand among a camera's parameters."""
LEAST_LEARNT = 1e-6
"""Directions of which less was learnt than this share of the most of their kind do not take part."""


def change_scores(before: RigBelief, after: RigBelief) -> dict[str, Tensor]:
    """Test each camera for each kind of change between two beliefs.

    Args:
        before: the earlier belief, aged to the time of the later one.
        after: the later one, which has learnt more.

    Returns:
        For each of `CHANGES` (C,): chi-squared, where nothing has changed, with as many degrees of freedom as the kind
        has parameters.
    """
    wide = before.rig.num_cameras * PARAMETERS
    cameras = (error_between(after.rig, before.rig) / before.unit).flatten()
    difference = torch.cat((cameras, after.object_offset - before.object_offset))
    pull = (before.information @ difference)[:wide].unflatten(0, (-1, PARAMETERS))
    change = _own_change(before)
    pull = (change.mT @ pull[..., None])[..., 0]
    learnt = change.mT @ _learnt(before.information, after.factor, before.rig.num_cameras) @ change
    return {kind: _score(pull[:, part], learnt[:, part, part]) for kind, part in CHANGES.items()}


def jump(before: RigBelief, let_free: RigBelief, after: RigBelief, camera: int, kind: str) -> tuple[Tensor, Tensor]:
    """Estimate a change of one camera of one kind, were there no other change.

    Args:
        before: what was believed before it.
        let_free: the same, the camera widened: what the later snapshots were absorbed into.
        after: what came of that.
        camera: its number.
        kind: of `CHANGES`, K numbers.

    Returns:
        The most probable change (K,) and its covariance (K, K).
    """
    part, cameras = CHANGES[kind], before.rig.num_cameras
    wide = cameras * PARAMETERS
    brought = after.information - let_free.information
    difference = torch.cat(((error_between(after.rig, before.rig) / before.unit).flatten(),
                            after.object_offset - before.object_offset))  # fmt: skip
    pull = after.information @ difference  # of the snapshots, at what was believed before
    factor = torch.linalg.cholesky(before.information + brought)
    pull = pull - brought @ torch.cholesky_solve(pull[:, None], factor)[:, 0]
    change = _own_change(before)
    learnt = change.mT @ _learnt(before.information, factor, cameras) @ change
    covariance = torch.linalg.pinv(learnt[camera, part, part], hermitian=True)
    own = (change.mT @ pull[:wide].unflatten(0, (cameras, PARAMETERS))[..., None])[camera, part, 0]
    return covariance @ own, covariance


def _own_change(belief: RigBelief) -> Tensor:
    """Error in units by a change of a camera's own parameters: (C, 15, 15); a turn about its centre shifts nothing."""
    return torch.linalg.inv(step_by_error(belief.rig)) / belief.unit[:, :, None]


def _learnt(before: Tensor, after: Tensor, cameras: int) -> Tensor:
    """Diagonal blocks (C, 15, 15) of G, by the information before (D, D) and the factor (D, D) of that after."""
    wide = cameras * PARAMETERS
    half = torch.linalg.solve_triangular(after, before, upper=False)[:, :wide]
    blocks = before[:wide, :wide].unflatten(0, (-1, PARAMETERS)).unflatten(-1, (-1, PARAMETERS))
    columns = half.unflatten(-1, (-1, PARAMETERS)).movedim(1, 0)
    return blocks.diagonal(dim1=0, dim2=2).movedim(-1, 0) - columns.mT @ columns


def _score(pull: Tensor, variance: Tensor) -> Tensor:
    """Squares of (C, K) in units of their covariance (C, K, K), along what is known of it: (C,)."""
    scale = variance.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).sqrt()
    values, vectors = torch.linalg.eigh(variance / (scale[:, :, None] * scale[:, None, :]))
    along = (vectors.mT @ (pull / scale)[..., None])[..., 0].square()
    return torch.where(values > LEAST_LEARNT, along / values.clamp_min(LEAST_LEARNT), 0.0).sum(-1)
