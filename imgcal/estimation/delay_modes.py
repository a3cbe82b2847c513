"""Delays of cameras, which take given courses over the snapshots, as modes of a fit.

A camera that exposes later shows everything where it will be by then. Delays are few and affect every pixel, like
the modes of an object's shape: a fit gives their gradient and information, with all other unknowns marginalized.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import POSE_PARAMETERS, Problem, append_scale, object_columns
from imgcal.estimation.robust_losses import NamedLoss
from imgcal.estimation.shape_modes import Coupling, ModeEvidence, by_parts


def delay_evidence(
    problem: Problem, solution: Solution, loss: NamedLoss, velocity: Tensor, courses: Tensor, delay: Tensor, std: Tensor
) -> ModeEvidence | None:
    """Compute a fit's evidence on delays of the cameras that take K given courses over the snapshots, one rig (B = 1).

    Args:
        problem: with pixels as if the cameras exposed together, by `delay`.
        solution: its minimum.
        loss: of the fit.
        velocity: (S, C, N, 2) px by which the fiducials move in a unit of time; zero where it is unknown.
        courses: (K, S) such as 1 in all snapshots for a constant delay.
        delay: (K, C) units of time.
        std: (K,) prior standard deviations of the same, which also decide what a delay of all cameras is.

    Returns:
        The evidence on K C modes, in units of `std`, camera after camera of the first course first; None where rig and
        poses are undetermined.
    """
    factorization, prior_std = solution.factorization, problem.object_prior_std
    if bool(factorization.reduced.failed.any()):
        return None
    size, (cameras, free) = len(courses), problem.prior_std[0].shape
    along, courses = velocity.mT, courses * std[:, None]
    own, pull = problem.uv.new_zeros(size, size, cameras), problem.uv.new_zeros(size, cameras)
    border = problem.uv.new_zeros(size, cameras, 3 * len(problem.points) + 1)
    camera, poses = problem.uv.new_zeros(size, cameras, free), []
    for rows, some, at, weight in by_parts(problem, solution.state, loss):
        assert at.by_fiducial is not None
        course, heavy = courses[:, rows], along[rows] * weight
        own = own + torch.einsum("ks,ls,sc->klc", course, course, (heavy * along[rows]).sum((2, 3)))
        pull = pull - course @ (heavy * at.residual[0]).sum((2, 3))
        across = torch.einsum("ks,scirn,scrn->kcsi", course, at.by_rig[0, ..., :-1, :, :], heavy)
        camera = camera + across[..., :-POSE_PARAMETERS].sum(2)
        poses.append(across[..., -POSE_PARAMETERS:])
        if prior_std is not None:
            sums = torch.einsum("ks,scirn,scrn->kcin", course, append_scale(some, at.by_fiducial)[0], heavy)
            border = border + object_columns(sums.flatten(0, 1)).unflatten(0, (size, cameras)) * prior_std
    each = torch.diag_embed(camera.mT).permute(0, 2, 3, 1)  # a delay moves what its own camera sees
    coupling = Coupling(
        each.flatten(0, 1), torch.cat(poses, dim=2).flatten(0, 1), None if prior_std is None else border.flatten(0, 1)
    )
    taken, follow = coupling.marginalize(factorization)
    information = torch.diag_embed(own).transpose(1, 2).flatten(2).flatten(0, 1) - taken
    offset = (delay / std[:, None]).flatten().numpy()
    covariance = np.asarray(np.linalg.inv(information.numpy() + np.eye(len(offset))), dtype=np.float64)
    return ModeEvidence(offset, covariance, covariance @ (pull.flatten().numpy() - offset), follow)
