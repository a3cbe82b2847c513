"""Does a camera that stands where it was see the object at moments of its own? Then it sees it elsewhere each time.

A camera whose clock is off by more than anybody can say how the object moves, or whose snapshots are too far apart for
that, is supposed to be where it was, and to see the object in a pose of its own in every snapshot. One change of the
camera explains one such pose as well, and not several: two or three snapshots tell, at any rate and for any slip.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from imgcal.monitoring.case import Case, Explanation, Finding, Start, Variant
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.types import Observations

ELSEWHERE = (0.2,) * 3 + (50.0,) * 3
"""Standard deviations of the pose (rad, mm) in which such a camera sees the object, about that of the others."""
NUDGE = (1e-5,) * 3 + (1e-3,) * 3
"""By which a pose is changed for derivatives (rad, mm)."""
LEAST_SNAPSHOTS = 2
"""Snapshots that tell a camera that has moved from one with moments of its own: one explains any pose of the object."""


class Unsynchronized(Explanation):
    """The suspected cameras, or the surest alone, see the object at moments of their own."""

    name = "unsynchronized"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Let the cameras see the object in poses of their own."""
        case.require_body()
        if case.count < LEAST_SNAPSHOTS:
            raise RefusedError("a single snapshot is explained by a move as well")
        return [partial(_unsynchronize, case, start, cameras) for start in case.starts for cameras in case.camera_sets]


def _unsynchronize(case: Case, start: Start, cameras: tuple[int, ...]) -> Variant:
    """Suppose that some cameras see the object at moments of their own."""
    snapshots = [(drop_cameras(one, cameras), pose) for one, pose in start.snapshots]
    own = partial(_evidence_of_own_poses, stack_snapshots(start.snapshots)[0], cameras, case.options)
    return Variant(start.before, snapshots, start.log_prior, own, lambda _: Finding(unsynchronized=cameras))


def unsynchronized_evidence(
    before: RigBelief,
    observations: Observations,
    rig_from_object: RigidTransform,
    cameras: Collection[int],
    options: EstimationOptions,
) -> float:
    """Log probability of snapshots in which some cameras see the object at moments of their own.

    Args:
        before: what was believed before them.
        observations: (S, C, N).
        rig_from_object: (S,) poses of the object, as most cameras see it.
        cameras: those with moments of their own, each.
        options: how to minimize.

    Returns:
        What is comparable with `MeasurementUpdate.evidence` of the same snapshots.

    Raises:
        RefusedError: the other cameras do not determine poses.
    """
    result = absorb(before, drop_cameras(observations, cameras), rig_from_object, options)
    return result.evidence + _evidence_of_own_poses(observations, cameras, options, result)


def _evidence_of_own_poses(
    observations: Observations, cameras: Collection[int], options: EstimationOptions, result: MeasurementUpdate
) -> float:
    """Log probability of what cameras with moments of their own see, given what the others taught.

    Args:
        observations: (S, C, N).
        cameras: those with moments of their own, each.
        options: how to minimize.
        result: the same snapshots without these cameras, absorbed.

    Raises:
        RefusedError: the other cameras do not determine poses.
    """
    poses, evidence = result.rig_from_object, 0.0
    others = _pose_information(result.belief, drop_cameras(observations, cameras), poses)
    every = _pose_information(result.belief, observations, poses)
    evidence += 0.5 * float((torch.logdet(every) - torch.logdet(others)).sum())  # `absorb` leaves out what all share
    for camera in cameras:
        rest = [other for other in range(observations.seen.shape[1]) if other != camera]
        alone = drop_cameras(observations, rest)
        rows = alone.seen[:, camera].any(-1).nonzero()[:, 0]
        if not len(rows):
            continue
        sure = _are_determined(_pose_information(result.belief, alone.of_snapshots(rows), poses[rows]))
        for part, evidence_of in ((rows[sure], _evidence_of_sure_poses), (rows[~sure], _evidence_of_few_labels)):
            if len(part):
                evidence += evidence_of(alone.of_snapshots(part), options, result.belief, poses[part])
    return evidence


def _are_determined(information: Tensor) -> Tensor:
    """Tell which poses, of information (S, 6, 6), are known better than from those of the other cameras: (S,)."""
    spread = torch.tensor(ELSEWHERE, dtype=torch.float64)
    return torch.linalg.eigvalsh(spread[:, None] * information * spread)[:, 0] > 1


def _evidence_of_sure_poses(
    alone: Observations, options: EstimationOptions, belief: RigBelief, there: RigidTransform
) -> float:
    """Log probability of what one camera sees (S, C, N), poses (S,) being fitted that lie about `there`."""
    own = absorb(belief, alone, there, options)
    information = _pose_information(own.belief, alone, own.rig_from_object)
    turn = vector_from_rotation(own.rig_from_object.rotation @ there.rotation.mT)
    way = torch.cat((turn, own.rig_from_object.translation - there.translation), -1)
    spread = torch.tensor(ELSEWHERE, dtype=torch.float64)
    scatter = spread.square().diag() + torch.linalg.inv(information)  # of the pose about that of the others
    squared = (way * torch.linalg.solve(scatter, way[..., None])[..., 0]).sum(-1)
    return own.evidence - 0.5 * float((torch.logdet(scatter) + torch.logdet(information) + squared).sum())


def _evidence_of_few_labels(
    alone: Observations, options: EstimationOptions, belief: RigBelief, there: RigidTransform
) -> float:
    """The same where the camera sees too few fiducials for a pose: linearized at `there`, the camera fixed."""
    image, jacobian = _weighted_jacobian(belief, alone, there)
    weight = torch.where(alone.seen, 1 / alone.sigma, 0.0)[..., None]
    residual = torch.nan_to_num((alone.uv - image) * weight)
    precision = torch.tensor(ELSEWHERE, dtype=torch.float64).pow(-2).diag()
    information = torch.einsum("scnij,scnik->sjk", jacobian, jacobian) + precision
    pull = torch.einsum("scnij,scni->sj", jacobian, residual)
    fitted = (pull * torch.linalg.solve(information, pull[..., None])[..., 0]).sum()
    occam = (torch.logdet(information) - torch.logdet(precision)).sum()
    return -0.5 * float(residual.square().sum() - fitted + occam)


def drop_cameras(observations: Observations, cameras: Collection[int]) -> Observations:
    """Drop what some cameras have seen."""
    seen = observations.seen.clone()
    seen[:, list(cameras)] = False
    return replace(observations, seen=seen)


def _pose_information(belief: RigBelief, observations: Observations, rig_from_object: RigidTransform) -> Tensor:
    """Information (S, 6, 6) of snapshots about the object's poses, as left rotation and translation (rad, mm)."""
    _, jacobian = _weighted_jacobian(belief, observations, rig_from_object)
    return torch.einsum("scnij,scnik->sjk", jacobian, jacobian)


def _weighted_jacobian(
    belief: RigBelief, observations: Observations, rig_from_object: RigidTransform
) -> tuple[Tensor, Tensor]:
    """Images (S, C, N, 2) of the fiducials; their derivatives (S, C, N, 2, 6) by the poses over the blobs' sigmas."""
    nudge = torch.tensor(NUDGE, dtype=torch.float64).diag()
    turned, shifted = rotation_from_vector(nudge[:, :3]), nudge[:, 3:]

    def image(rotation: Tensor, translation: Tensor) -> Tensor:
        pose = RigidTransform(rotation, translation)
        rig = belief.rig.expand(len(translation))
        return rig.project_values(pose.apply(belief.points_object), belief.obj.radius).uv

    start = image(rig_from_object.rotation, rig_from_object.translation)
    columns = [
        (image(turned[k] @ rig_from_object.rotation, rig_from_object.translation + shifted[k]) - start) / NUDGE[k]
        for k in range(len(NUDGE))
    ]
    weight = torch.where(observations.seen, 1 / observations.sigma, 0.0)[..., None, None]
    return start, torch.nan_to_num(torch.stack(columns, -1)) * weight
