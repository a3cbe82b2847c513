"""Fit the object's pose in every snapshot on its own, with a fixed rig."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.association.series import Associations, refuse_snapshots
from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, Observations

NO_POSE = "no pose of the object fits what the cameras see"


def fit_snapshot_poses(
    observations: Observations,
    rig: CameraRig,
    obj: CalibrationObject,
    poses: RigidTransform | None,
    options: EstimationOptions,
) -> tuple[RigidTransform, Tensor]:
    """Fit the object's pose in every snapshot; with a fixed rig, each is a problem of its own.

    Args:
        observations: (S, C, N) of the snapshots.
        rig: stays fixed.
        obj: the object.
        poses: (S,) to start from; None = found from the labels.
        options: of the solver.

    Returns:
        Poses (S,), and whether each fits (S,) bool.
    """
    each = Observations(observations.uv[:, None], observations.sigma[:, None], observations.seen[:, None])
    fixed = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=rig.distortion.dtype)
    start = None if poses is None else poses.reshape(-1, 1)
    rigs = rig.expand(len(each.seen))
    fit = estimate(each, rigs, obj.as_exact(), start, prior_std=fixed, options=options)
    return fit.rig_from_object.reshape(-1), fit.converged


def refuse_unfit(labelled: Associations, fits: Tensor, command: str) -> Associations:
    """Refuse the snapshots that no pose of the object fits.

    Args:
        labelled: what was identified.
        fits: (U,) bool, of the snapshots in use.
        command: the command that a refusal names.

    Raises:
        RefusedError: these are more than half of them.
    """
    count = int((~fits).sum())
    if 2 * count > len(fits):
        raise RefusedError(
            f"{command}: {NO_POSE} in {count} of {len(fits)} snapshots: "
            "the rig or the object is not the one in the images"
        )
    return refuse_snapshots(labelled, (~fits).nonzero().flatten().tolist(), NO_POSE)
