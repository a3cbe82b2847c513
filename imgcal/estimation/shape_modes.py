"""The modes of an object's shape: a few displacements of all fiducials together, such as the bend of a printed board.

The modes are few and affect every fiducial, so they are not unknowns of the normal equations. Instead, the `points` of
the problem include the current estimate of each. A fit gives the gradient and the information of the modes with rig,
poses and tolerances marginalized. A Gauss-Newton step of the modes alone follows from that, and then the next fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation.levenberg_marquardt import Factorization, Solution
from imgcal.estimation.linearization import (
    POSE_PARAMETERS,
    Jacobian,
    Problem,
    State,
    Step,
    append_scale,
    jacobian_at,
    object_columns,
    robust_weight,
)
from imgcal.estimation.robust_losses import NamedLoss

POINTS_AT_ONCE = 2**16
"""Pixels whose derivatives are in memory at the same time."""
CONVERGED_STEP = 0.02
"""Largest step of a converged mode, in its posterior standard deviations."""


@dataclass(frozen=True)
class DirectionEvidence:
    """Information of a fit about common displacements of all fiducials along K directions."""

    information: Tensor  # (K, K), rig, poses and tolerances marginalized
    pull: Tensor  # (K,) information times the best-fitting displacement
    follow: Tensor  # (K, C, K) change of the cameras' whitened offsets per unit of each direction
    alone: float  # largest information of one coordinate of a fiducial, nothing marginalized, mm^-2


def direction_evidence(
    problem: Problem, solution: Solution, loss: NamedLoss, directions: Tensor
) -> DirectionEvidence | None:
    """Compute a fit's evidence on directions (K, N, 3) mm, one rig (B = 1), in time linear in the fiducials.

    Returns:
        The evidence; None where rig and poses are undetermined.
    """
    factorization, state = solution.factorization, solution.state
    if bool(factorization.reduced.failed.any()):
        return None
    count, prior_std = len(directions), problem.object_prior_std
    own, pull = problem.uv.new_zeros(count, count), problem.uv.new_zeros(count)
    each, camera, poses = problem.uv.new_zeros(len(problem.points), 3), [], []
    border = problem.uv.new_zeros(count, 3 * len(problem.points) + 1)
    for _, some, at, weight in by_parts(problem, state, loss):
        assert at.by_fiducial is not None
        along = _along(at, directions)
        heavy = along * weight
        own = own + torch.einsum("kscrn,lscrn->kl", heavy, along)
        pull = pull - (heavy * at.residual[0]).sum((1, 2, 3, 4))
        each = each + (at.by_fiducial[0].square() * weight.unsqueeze(-3)).sum((0, 1, 3)).mT
        across = torch.einsum("scirn,kscrn->ksci", at.by_rig[0, ..., :-1, :, :], heavy)  # (K, S, C, K' + 6)
        camera.append(across[..., :-POSE_PARAMETERS].sum(1))
        poses.append(across[..., -POSE_PARAMETERS:].sum(2))
        if prior_std is not None:
            sums = torch.einsum("scirn,kscrn->kin", append_scale(some, at.by_fiducial)[0], heavy)
            border = border + object_columns(sums) * prior_std
    coupling = Coupling(torch.stack(camera).sum(0), torch.cat(poses, dim=1), None if prior_std is None else border)
    taken, follow = coupling.marginalize(factorization)
    return DirectionEvidence(own - taken, pull, follow, float(each.max()))


def evidence_by_snapshot(
    problem: Problem, state: State, loss: NamedLoss, directions: Tensor
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the evidence of each of S snapshots on directions (K, N, 3) mm, one rig (B = 1), which stays fixed.

    Returns:
        Information (S, K, K), with the pose marginalized, and pull (S, K); see `DirectionEvidence`.
    """
    information, pull = [], []
    for _, _, at, weight in by_parts(problem, state, loss):
        along = _along(at, directions)
        pose, residual = at.by_rig[0, :, :, -POSE_PARAMETERS - 1 : -1], at.residual[0]  # (S, C, 6, 2, N)
        heavy, heavy_pose = along * weight, pose * weight.unsqueeze(-3)
        across = torch.einsum("scirn,kscrn->ski", pose, heavy)
        taken = torch.linalg.solve(torch.einsum("scirn,scjrn->sij", heavy_pose, pose), across.mT).mT  # (S, K, 6)
        own = torch.einsum("kscrn,lscrn->skl", heavy, along)
        information.append(own - taken @ across.mT)
        gradient = torch.einsum("scirn,scrn->si", heavy_pose, residual)
        pull.append((taken @ gradient[..., None])[..., 0] - torch.einsum("kscrn,scrn->sk", heavy, residual))
    return torch.cat(information).numpy(), torch.cat(pull).numpy()


def _along(at: Jacobian, directions: Tensor) -> Tensor:
    """Derivatives of the pixels of S snapshots along directions (K, N, 3) mm: (K, S, C, 2, N)."""
    assert at.by_fiducial is not None
    return torch.einsum("scirn,kni->kscrn", at.by_fiducial[0], directions)


def by_parts(problem: Problem, state: State, loss: NamedLoss) -> Iterator[tuple[slice, Problem, Jacobian, Tensor]]:
    """Differentiate the pixels of a few snapshots at a time, by the fiducials as well.

    Yields:
        Which snapshots, their problem, the derivatives of its pixels, and their weights (S, C, 1, N) px^-2.
    """
    unit, prior_std = problem.uv.new_ones(1, 3 * len(problem.points) + 1), problem.object_prior_std
    together = max(1, POINTS_AT_ONCE // problem.uv[0, 0, :, 0].numel())
    for first in range(0, problem.uv.shape[1], together):
        rows = slice(first, first + together)
        std = unit if prior_std is None else prior_std
        some = replace(problem, uv=problem.uv[:, rows], root_weight=problem.root_weight[:, rows], object_prior_std=std)
        at = jacobian_at(some, replace(state, rotation=state.rotation[:, rows], centre=state.centre[:, rows]))
        yield rows, some, at, robust_weight(some, at, loss)[0].unsqueeze(-2)


@dataclass(frozen=True)
class Coupling:
    """Products, by the weighted derivatives of the pixels, of K modes with the unknowns of a fit."""

    camera: Tensor  # (K, C, K')
    pose: Tensor  # (K, S, 6)
    object: Tensor | None  # (K, M), of an object with tolerances

    def marginalize(self, factorization: Factorization) -> tuple[Tensor, Tensor]:
        """Let the unknowns follow the modes.

        Returns:
            The information that this takes from the modes (K, K), and the cameras' change by a unit of each (K, C, K').
        """
        steps = [
            factorization.solve(Step(camera[None], pose[None], None if self.object is None else self.object[k, None]))
            for k, (camera, pose) in enumerate(zip(self.camera, self.pose, strict=True))
        ]
        cameras, poses = torch.cat([step.camera for step in steps]), torch.cat([step.pose for step in steps])
        taken = self.camera.flatten(1) @ cameras.flatten(1).mT + self.pose.flatten(1) @ poses.flatten(1).mT
        if self.object is not None:
            taken = taken + self.object @ torch.cat([step.object for step in steps if step.object is not None]).mT
        return 0.5 * (taken + taken.mT), -cameras


@dataclass(frozen=True)
class ModeEvidence:
    """Estimate and uncertainty of the modes at a fit, in units of their prior standard deviations."""

    offset: NDArray[np.float64]  # (K,) as estimated
    covariance: NDArray[np.float64]  # (K, K)
    step: NDArray[np.float64]  # (K,) remaining Gauss-Newton step
    follow: Tensor  # (K, C, K) change of the cameras' whitened offsets per unit of each mode

    @property
    def at_rest(self) -> bool:
        """Whether the remaining step is negligible."""
        return bool((np.abs(self.step) <= CONVERGED_STEP * np.sqrt(self.covariance.diagonal())).all())


def mode_evidence(problem: Problem, solution: Solution, loss: NamedLoss) -> ModeEvidence | None:
    """Compute a fit's evidence on the object's modes; None without modes, or where rig or poses are undetermined."""
    if problem.modes is None:
        return None
    found = direction_evidence(problem, solution, loss, problem.modes)
    if found is None:
        return None
    offset = np.zeros(len(problem.modes)) if problem.mode_offset is None else problem.mode_offset.numpy()
    information = found.information.numpy() + np.eye(len(offset))
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return ModeEvidence(offset, covariance, covariance @ (found.pull.numpy() - offset), found.follow)


def bend_object(problem: Problem, evidence: ModeEvidence) -> Problem:
    """Apply the step of the modes to the problem's points."""
    assert problem.modes is not None
    step = torch.from_numpy(evidence.step).to(problem.points)
    points = problem.points + torch.einsum("k,kni->ni", step, problem.modes)
    return replace(problem, points=points, mode_offset=torch.from_numpy(evidence.offset).to(step) + step)
