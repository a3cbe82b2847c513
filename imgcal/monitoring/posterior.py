"""Convert a calibration into a running rig's initial knowledge (`make_posterior`), and that back into a belief:
`belief_from_posterior`.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from imgcal.estimation import Estimate, joint_information, step_by_error
from imgcal.monitoring.rig_belief import RigBelief, cholesky_factor
from imgcal.types import CalibrationObject, CameraRig, RigPosterior

ROUNDING_MM = 1e-3
"""Millimetres between equal fiducials whose coordinates were rounded in a file."""


def make_posterior(estimate: Estimate, obj: CalibrationObject) -> RigPosterior:
    """Keep everything an estimate knows about a rig and an object's shape, with the poses marginalized.

    Args:
        estimate: without batch axes.
        obj: as given; its tolerances are those of the estimate.

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
    by_error = torch.eye(len(information), dtype=torch.float64)  # derivative of parameters by errors in units
    by_error[:wide, :wide] = torch.block_diag(*(step_by_error(rig) * unit[:, None, :]))
    information = by_error.mT @ information @ by_error
    factor = cholesky_factor(0.5 * (information + information.mT))
    snapshots = problem.uv.shape[1]
    return RigPosterior(rig, obj.points.double(), tolerance, scale, own, factor, unit, snapshots)


def belief_from_posterior(posterior: RigPosterior, obj: CalibrationObject) -> RigBelief:
    """Take a calibration's result as a belief; of a calibration with another object, take the cameras only.

    Args:
        posterior: of the calibration.
        obj: the object that is seen from now on.
    """
    own = posterior.object_offset
    if obj.unknown_markers:
        return _about_cameras(posterior, obj)
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
    """Take the cameras of a posterior, with an object known only from its file."""
    wide = posterior.unit.numel()
    covariance = torch.cholesky_inverse(posterior.factor)[:wide, :wide]
    prior = RigBelief.of_prior(posterior.rig, obj)
    size = len(prior.factor)
    information = torch.eye(size, dtype=torch.float64)
    information[:wide, :wide] = torch.cholesky_inverse(cholesky_factor(covariance))
    return replace(prior, factor=cholesky_factor(information), unit=posterior.unit)


def calibration_posterior(rig: CameraRig) -> RigPosterior | None:
    """Load the posterior of the calibration that made a rig, or these cameras of it.

    Returns:
        None = there is none, or values were changed since.

    Raises:
        InputError: the posterior's file cannot be used.
    """
    posterior = None if rig.posterior is None else rig.posterior().of_cameras(rig.camera_names)
    return posterior if posterior is not None and posterior.belongs_to(rig) else None


def _same(points: torch.Tensor, others: torch.Tensor) -> bool:
    return points.shape == others.shape and bool((points - others).abs().max() < ROUNDING_MM)
