"""From a calibration to what a running rig begins with: `make_posterior`, and back to a belief:
`belief_from_posterior`.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from imgcal.estimation import Estimate, joint_information, step_by_error
from imgcal.monitoring.rig_belief import RigBelief, cholesky_factor
from imgcal.types import CalibrationObject, CameraRig, RigPosterior

NEAR = 1e-3
"""Millimetres between fiducials that are the same ones, written with rounded digits."""


def make_posterior(estimate: Estimate, obj: CalibrationObject) -> RigPosterior:
    """Keep all that an estimate knows of a rig and of an object's shape, the poses let free.

    Args:
        estimate: without batch axes.
        obj: as it was given; its tolerances are those that the estimate granted.

    Raises:
        RefusedError: the observations do not determine the poses.
    """
    rig, problem = replace(estimate.rig.to(torch.float64), posterior=None), estimate.problem
    std, offset = problem.object_prior_std, estimate.solution.state.object_offset
    tolerance, own = (torch.zeros(count, dtype=torch.float64) for count in (obj.num_fiducials, 0))
    scale = 0.0
    if std is not None and offset is not None:
        tolerance, scale, own = std[0, :-1:3].double(), float(std[0, -1]), offset[0].detach().double()
    loose = replace(obj, tolerance=tolerance if len(own) else None, scale_tolerance=scale)
    unit = RigBelief.of_prior(rig, loose, problem.prior_std[0].detach()).unit
    information = joint_information(estimate).detach().double()
    wide = unit.numel()
    by_error = torch.eye(len(information), dtype=torch.float64)  # parameters by errors in units
    by_error[:wide, :wide] = torch.block_diag(*(step_by_error(rig) * unit[:, None, :]))
    information = by_error.mT @ information @ by_error
    factor = cholesky_factor(0.5 * (information + information.mT))
    snapshots = problem.uv.shape[1]
    return RigPosterior(rig, obj.points.double(), tolerance, scale, own, factor, unit, snapshots)


def belief_from_posterior(posterior: RigPosterior, obj: CalibrationObject) -> RigBelief:
    """Believe what a calibration has found; of another object than it saw, only what it says of the cameras.

    Args:
        posterior: of the calibration.
        obj: the object that is seen from now on.
    """
    own = posterior.object_offset
    if len(own):
        tolerance, scale = posterior.tolerance, posterior.scale_tolerance
        seen = replace(obj, points=posterior.points, tolerance=tolerance, scale_tolerance=scale)
        belief = RigBelief(posterior.rig, seen, own, posterior.factor, posterior.unit)
        if any(_same(points, obj.points) for points in (posterior.points, belief.points_object)):
            return belief
    elif _same(posterior.points, obj.points) and obj.exact:
        return RigBelief(posterior.rig, obj, own, posterior.factor, posterior.unit)
    return _about_cameras(posterior, obj)


def _about_cameras(posterior: RigPosterior, obj: CalibrationObject) -> RigBelief:
    """What it says of the cameras, beside an object of which only its file is known."""
    wide = posterior.unit.numel()
    covariance = torch.cholesky_inverse(posterior.factor)[:wide, :wide]
    prior = RigBelief.of_prior(posterior.rig, obj)
    size = len(prior.factor)
    information = torch.eye(size, dtype=torch.float64)
    information[:wide, :wide] = torch.cholesky_inverse(cholesky_factor(covariance))
    return replace(prior, factor=cholesky_factor(information), unit=posterior.unit)


def calibration_posterior(rig: CameraRig) -> RigPosterior | None:
    """The posterior of the calibration that made a rig; None = none did, or its values have been changed since.

    Raises:
        InputError: the posterior stands in a file that cannot be used.
    """
    if rig.posterior is None:
        return None
    posterior = rig.posterior()
    return posterior if posterior.belongs_to(rig) else None


def _same(points: torch.Tensor, others: torch.Tensor) -> bool:
    return points.shape == others.shape and bool((points - others).abs().max() < NEAR)
