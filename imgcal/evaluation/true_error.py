"""The errors of a rig whose true counterpart is known, not linearized: in px and mm, and in units of its covariance."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from imgcal.estimation import RigUncertainty, inverse_or_zero, pixel_jacobian, rigid_motion
from imgcal.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from imgcal.types import CameraRig

STEPS = 6
"""Gauss-Newton steps; each gains several digits here."""


def true_error(uncertainty: RigUncertainty, truth: CameraRig, points: Tensor) -> tuple[Tensor, Tensor]:
    """Compare an estimated rig with the true one, after the best rigid motion in the metrics of the prediction.

    Args:
        uncertainty: the estimated rig, and the points and weights by which rigs are aligned.
        truth: the true rig, in any frame.
        points: (P, 3) mm in the estimated rig's frame.

    Returns:
        (C, P) px and (P,) mm; what no camera, or fewer than two, see is nan.
    """
    rig, anchors = uncertainty.rig, uncertainty.points
    true_from_rig = _align(uncertainty, truth)
    projection = rig.project(points)
    pixels = truth.project(true_from_rig.apply(points)).uv - projection.uv
    seen_anchors = rig.project(anchors).visible
    anchored = _triangulate(rig, anchors, truth.project(true_from_rig.apply(anchors)).uv, seen_anchors)
    moved = _best_motion(anchors, anchored, uncertainty.mm_weight)
    found = _triangulate(rig, points, truth.project(true_from_rig.apply(points)).uv, projection.visible)
    distance = (found - moved.apply(points)).norm(dim=-1)
    twice = projection.visible.sum(0) >= 2
    return (
        torch.where(projection.visible, pixels.norm(dim=-1), torch.nan),
        torch.where(twice, distance, torch.nan),
    )


def normalized_error(uncertainty: RigUncertainty, truth: CameraRig) -> float:
    """Squared error of a rig per degree of freedom, in units of its covariance: 1 on average for an honest one.

    The motion of the whole rig, which no image shows and the prior alone limits, is no straight line in the parameters:
    a turn by w takes a camera at distance d off its tangent by d w^2 / 2, more than the cameras' places relative to
    each other are uncertain by. It is therefore told apart as the rigid motion that it is, and counts as its own
    coordinates; what is left is the difference of the parameters as usual.

    Args:
        uncertainty: the estimated rig, its covariance, and the points by which rigs are aligned.
        truth: the true rig, in the frame of the estimated one.

    Source: errors on the group of motions are what makes a filter's covariance consistent, Barrau and Bonnabel, "The
    invariant extended Kalman filter as a stable observer" (IEEE TAC 2017).
    """
    rig, centre = uncertainty.rig, uncertainty.points.mean(0)
    true_from_rig = _align(uncertainty, truth)
    laid_upon = replace(truth, cam_from_rig=truth.cam_from_rig @ true_from_rig[None])
    turn, shift = vector_from_rotation(true_from_rig.rotation), true_from_rig.apply(centre[None])[0] - centre
    error = rig.local(laid_upon).flatten() - rigid_motion(rig, centre) @ torch.cat((turn, shift))
    return float(error @ torch.linalg.solve(uncertainty.covariance, error)) / len(error)


def _align(uncertainty: RigUncertainty, truth: CameraRig) -> RigidTransform:
    """Motion that takes points of the estimated rig to where the true rig sees them at the same pixels."""
    points, weight = uncertainty.points, uncertainty.px_weight
    centre, target = points.mean(0), uncertainty.rig.project(points).uv
    rotation = truth.cam_from_rig.rotation.mT @ uncertainty.rig.cam_from_rig.rotation  # (C, 3, 3) of each camera
    u, _, vh = torch.linalg.svd(rotation.mean(0))
    turn = u @ torch.diag(torch.cat((u.new_ones(2), torch.det(u @ vh)[None]))) @ vh
    shift = truth.positions.mean(0) - turn @ uncertainty.rig.positions.mean(0)
    for _ in range(STEPS):
        moved = points @ turn.mT + shift
        by_point = -pixel_jacobian(truth, moved)[..., 3:6]
        lever = torch.linalg.cross(((points - centre) @ turn.mT).expand_as(moved)[None, :, None], by_point)
        rows = torch.cat((lever, by_point), -1)  # (C, P, 2, 6)
        off = truth.project(moved).uv - target
        normal = torch.einsum("cp,cpai,cpaj->ij", weight, rows, rows)
        step = torch.linalg.solve(normal, -torch.einsum("cp,cpai,cpa->i", weight, rows, off))
        middle = turn @ centre + shift + step[3:]
        turn = rotation_from_vector(step[:3]) @ turn
        shift = middle - turn @ centre
    return RigidTransform(turn, shift)


def _triangulate(rig: CameraRig, start: Tensor, uv: Tensor, seen: Tensor) -> Tensor:
    """Points (P, 3) whose pixels are nearest to uv (C, P, 2), each seeing camera alike."""
    points = start
    for _ in range(STEPS):
        rows = -pixel_jacobian(rig, points)[..., 3:6] * seen[..., None, None]
        off = uv - rig.project(points).uv
        normal = torch.einsum("cpai,cpaj->pij", rows, rows)
        right = torch.einsum("cpai,cpa->pi", rows, off)
        points = points + (inverse_or_zero(normal) @ right[..., None]).squeeze(-1)
    return points


def _best_motion(source: Tensor, destination: Tensor, weight: Tensor) -> RigidTransform:
    """Rigid motion nearest to taking weighted points (P, 3) to others.

    Source: Kabsch 1976.
    """
    share = (weight / weight.sum().clamp_min(1e-300))[:, None]
    destination = torch.where(share > 0, destination, 0.0)
    from_, to = (share * source).sum(0), (share * destination).sum(0)
    u, _, vh = torch.linalg.svd((share * (destination - to)).mT @ (source - from_))
    rotation = u @ torch.diag(torch.cat((u.new_ones(2), torch.det(u @ vh)[None]))) @ vh
    return RigidTransform(rotation, to - rotation @ from_)
