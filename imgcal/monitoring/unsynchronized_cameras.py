"""Unsynchronized cameras: one that has not moved sees the object at its own times, so in a different place each time.

If a clock is off by so much that the object's motion cannot be extrapolated, or if snapshots are too far apart for
that, assume that the camera has not moved and sees the object in an independent pose in every snapshot. A single change
of the camera also explains one such pose, but not several: two or three snapshots decide, at any rate and for any slip.
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
"""Standard deviations of the object's pose (rad, mm) as seen by such a camera, relative to the other cameras."""
NUDGE = (1e-5,) * 3 + (1e-3,) * 3
"""Steps of a pose for numerical derivatives (rad, mm)."""
LEAST_SNAPSHOTS = 2
"""Snapshots needed to tell an unsynchronized camera from a moved one: a move explains any single pose."""


class Unsynchronized(Explanation):
    """The suspected cameras, or the most likely one alone, are unsynchronized."""

    name = "unsynchronized"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Let the cameras see the object in their own poses."""
        case.require_body()
        if case.count < LEAST_SNAPSHOTS:
            raise RefusedError("a move explains a single snapshot equally well")
        return [partial(_unsynchronize, case, start, cameras) for start in case.starts for cameras in case.camera_sets]


def _unsynchronize(case: Case, start: Start, cameras: tuple[int, ...]) -> Variant:
    """Suppose that some cameras are unsynchronized."""
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
    """Log probability of snapshots with unsynchronized cameras.

    Args:
        before: the belief before them.
        observations: (S, C, N).
        rig_from_object: (S,) poses of the object, as most cameras see it.
        cameras: the unsynchronized cameras, each with its own times.
        options: how to minimize.

    Returns:
        Evidence, comparable with `MeasurementUpdate.evidence` of the same snapshots.

    Raises:
        RefusedError: the other cameras do not determine poses.
    """
    result = absorb(before, drop_cameras(observations, cameras), rig_from_object, options)
    return result.evidence + _evidence_of_own_poses(observations, cameras, options, result)


def _evidence_of_own_poses(
    observations: Observations, cameras: Collection[int], options: EstimationOptions, result: MeasurementUpdate
) -> float:
    """The part of `unsynchronized_evidence` that the cameras add to the update by the others."""
    poses = result.rig_from_object
    _, jacobian = _jacobian(result.belief, poses)
    others = _pose_information(jacobian, drop_cameras(observations, cameras))
    every = _pose_information(jacobian, observations)
    evidence = 0.5 * float((torch.logdet(every) - torch.logdet(others)).sum())  # `absorb` leaves out shared terms
    for camera in cameras:
        rest = [other for other in range(observations.seen.shape[1]) if other != camera]
        alone = drop_cameras(observations, rest)
        rows = alone.seen[:, camera].any(-1).nonzero()[:, 0]
        if not len(rows):
            continue
        sure = _are_determined(_pose_information(jacobian, alone)[rows])
        for part, evidence_of in ((rows[sure], _evidence_of_sure_poses), (rows[~sure], _evidence_of_few_labels)):
            if len(part):
                evidence += evidence_of(alone.of_snapshots(part), options, result.belief, poses[part])
    return evidence


def _are_determined(information: Tensor) -> Tensor:
    """Return which poses, with information (S, 6, 6), are known better than from the other cameras: (S,)."""
    spread = torch.tensor(ELSEWHERE, dtype=torch.float64)
    return torch.linalg.eigvalsh(spread[:, None] * information * spread)[:, 0] > 1


def _evidence_of_sure_poses(
    alone: Observations, options: EstimationOptions, belief: RigBelief, there: RigidTransform
) -> float:
    """Log probability of a camera's observations (S, C, N), with poses (S,) fitted around `there`."""
    own = absorb(belief, alone, there, options)
    information = _pose_information(_jacobian(own.belief, own.rig_from_object)[1], alone)
    turn = vector_from_rotation(own.rig_from_object.rotation @ there.rotation.mT)
    way = torch.cat((turn, own.rig_from_object.translation - there.translation), -1)
    spread = torch.tensor(ELSEWHERE, dtype=torch.float64)
    scatter = spread.square().diag() + torch.linalg.inv(information)  # of the pose relative to the other cameras' pose
    squared = (way * torch.linalg.solve(scatter, way[..., None])[..., 0]).sum(-1)
    return own.evidence - 0.5 * float((torch.logdet(scatter) + torch.logdet(information) + squared).sum())


def _evidence_of_few_labels(
    alone: Observations, options: EstimationOptions, belief: RigBelief, there: RigidTransform
) -> float:
    """The same if the camera sees too few fiducials for a pose: linearized at `there`, with the camera fixed."""
    image, jacobian = _jacobian(belief, there)
    jacobian = _weigh(jacobian, alone)
    residual = _weigh(alone.uv - image, alone)
    precision = torch.tensor(ELSEWHERE, dtype=torch.float64).pow(-2).diag()
    information = torch.einsum("scnij,scnik->sjk", jacobian, jacobian) + precision
    pull = torch.einsum("scnij,scni->sj", jacobian, residual)
    fitted = (pull * torch.linalg.solve(information, pull[..., None])[..., 0]).sum()
    occam = (torch.logdet(information) - torch.logdet(precision)).sum()
    return -0.5 * float(residual.square().sum() - fitted + occam)


def drop_cameras(observations: Observations, cameras: Collection[int]) -> Observations:
    """Remove the observations of some cameras."""
    seen = observations.seen.clone()
    seen[:, list(cameras)] = False
    return replace(observations, seen=seen)


def _pose_information(jacobian: Tensor, observations: Observations) -> Tensor:
    """Information (S, 6, 6) of snapshots about the object's poses, as left rotation and translation (rad, mm)."""
    weighted = _weigh(jacobian, observations)
    return torch.einsum("scnij,scnik->sjk", weighted, weighted)


def _weigh(values: Tensor, observations: Observations) -> Tensor:
    """Divide values (S, C, N, ...) by the sigmas; zero where nothing is seen."""
    weight = torch.where(observations.seen, 1 / observations.sigma, 0.0)
    return torch.nan_to_num(values * weight.reshape(*weight.shape, *(1,) * (values.ndim - 3)))


def _jacobian(belief: RigBelief, rig_from_object: RigidTransform) -> tuple[Tensor, Tensor]:
    """Images (S, C, N, 2) of the fiducials, and their derivatives (S, C, N, 2, 6) by the poses."""
    nudge = torch.tensor(NUDGE, dtype=torch.float64).diag()
    turned, shifted = rotation_from_vector(nudge[:, :3]), nudge[:, 3:]
    rotation, translation = rig_from_object.rotation, rig_from_object.translation
    poses = RigidTransform(
        torch.cat((rotation[None], turned[:, None] @ rotation)).flatten(0, 1),
        torch.cat((translation[None], translation + shifted[:, None])).flatten(0, 1),
    )
    points = poses.apply(belief.points_object)
    uv = belief.rig.expand(len(points)).project_values(points, belief.obj.radius).uv
    start, *after = uv.unflatten(0, (1 + len(NUDGE), -1))
    columns = [(image - start) / step for image, step in zip(after, NUDGE, strict=True)]
    return start, torch.stack(columns, -1)
