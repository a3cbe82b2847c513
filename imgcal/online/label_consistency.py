"""Compare a snapshot's labels with the rig: single labels that do not fit are strays, most of a camera's mean a move.

A blob that may consist of two fiducials lies between them, unnoticeably; it loses its label, too.

If a camera rotates, shifts or zooms a little, its image of the object rotates, shifts or stretches as a whole. The
residuals left after removing such an image motion show the strays. The motion itself, relative to that of most cameras,
shows whether the camera has moved.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import PipelineOptions, find_merged, to_observations
from imgcal.estimation import EstimationOptions, fit_pose, pixel_jacobian
from imgcal.geometry import RigidTransform, cross_matrix, kernels
from imgcal.medians import median
from imgcal.monitoring import RigBelief
from imgcal.online.light_points import FoundLights
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations
from renderers.compiling import njit

MOST_APART = 5.0
"""Maximum error of a label, or of a camera's whole image, in multiples of the usual error in a snapshot."""
LEAST_LABELS = 3
"""Number of a camera's labels needed to tell whether they agree."""
LEAST_AGREEING = 0.5
"""Share of a camera's labels that must agree."""
DEPTH = 0.2
"""Contribution of the object's depth to single fiducials, as a share of the image motion."""
ROUNDS = 6


@dataclass(frozen=True)
class Checked:
    """Labels of a snapshot, and how they fit a rig."""

    blobs: Detections  # without the labels of strays and of blobs that may be two fiducials
    given: Detections  # the same, with all labels
    rig_from_object: RigidTransform  # (1,) most probable given the current rig
    off: NDArray[np.bool_]  # (C,) the labels agree with each other, but not with the rig
    usual: float  # px, median over all cameras of the error of the image
    labels: int
    lights: FoundLights | None = None  # all lights found, also those without numbers; None = an object is known


def check_labels(
    named: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    rig_from_object: RigidTransform,
    options: PipelineOptions,
) -> Checked:
    """Fit the object's pose with a known rig, and find the labels that do not fit.

    Args:
        named: blobs of one snapshot, labelled.
        rig: as currently estimated.
        obj: the calibration object, as currently estimated.
        rig_from_object: (1,) first guess of its pose.
        options: maximum error of blobs.

    Raises:
        RefusedError: the labels do not determine the pose.
    """
    seen = to_observations(named, rig, obj)
    even = Observations(seen.uv, seen.sigma.new_full(seen.sigma.shape, options.identity_error), seen.seen)
    fit = fit_pose(even, rig, obj.points, obj.radius, rig_from_object, EstimationOptions(loss="cauchy"))
    uv, there = seen.uv[0].numpy(), seen.seen[0].numpy()
    rest, moved = np.full(there.shape, np.nan), np.full(len(there), np.nan)
    _compare(uv, fit.residual, there, options.identity_error, rest, moved)
    usual_rest = median(rest[there]) if there.any() else 0.0
    measured = np.isfinite(moved)
    usual = median(moved[measured]) if measured.any() else 0.0
    least = options.identity_error + MOST_APART * usual_rest
    stray = there & (rest > least + DEPTH * np.nan_to_num(moved)[:, None])
    off = measured & (np.nan_to_num(moved) > options.identity_error + MOST_APART * usual)
    given, left = there.sum(1), (there & ~stray).sum(1)
    nonsense = off & ((left < LEAST_AGREEING * given) | (left < LEAST_LABELS))
    stray |= there & nonsense[:, None]
    off &= ~nonsense
    # Too few labels to agree with each other: compare them with the rig.
    distance = np.linalg.norm(fit.residual, axis=-1)
    limit = options.identity_error + MOST_APART * median(distance[there]) if there.any() else 0.0
    stray |= there & ~measured[:, None] & (distance > limit)
    image = rig.project_values(fit.rig_from_object[0].apply(obj.points), obj.radius)
    stray |= find_merged(named, there & ~stray, image.uv.numpy(), image.visible.numpy())
    rows = named.fiducial >= 0
    lost = stray[named.camera[rows], named.fiducial[rows]]
    fiducial = named.fiducial.copy()
    fiducial[rows] = np.where(lost, -1, fiducial[rows])
    blobs = replace(named, fiducial=fiducial)
    return Checked(blobs, named, fit.rig_from_object, off, usual, int((fiducial >= 0).sum()))


def predict_usual(checked: Checked, belief: RigBelief, least: float) -> float:
    """Predict `Checked.usual` (px) from the uncertainty of the rig: large where cameras see the object together that
    never have before.

    Args:
        checked: a snapshot.
        belief: about the rig.
        least: px, usual error of a well-known camera's image; the pose follows the best-known cameras.
    """
    given = checked.given
    seen = np.zeros((belief.rig.num_cameras, belief.obj.num_fiducials), np.bool_)
    rows = given.fiducial >= 0
    seen[given.camera[rows], given.fiducial[rows]] = True
    seen[seen.sum(1) < LEAST_LABELS] = False
    if not seen.any():
        return 0.0
    points = belief.points_at(checked.rig_from_object)[0]
    camera, fiducial = torch.from_numpy(seen).nonzero(as_tuple=True)
    own = pixel_jacobian(belief.rig, points)[camera, fiducial]  # (M, 2, K)
    covariance = belief.covariance().unflatten(0, (belief.rig.num_cameras, -1)).unflatten(2, (-1, own.shape[2]))
    # Covariance (M, 2, M, 2) of the images before the pose is fitted, and a weight for each of them.
    images = torch.einsum("aik,akbl,bjl->aibj", own, covariance[camera][:, :, camera], own)
    variance = images.flatten(2).flatten(0, 1).diagonal().view(-1, 2).mean(1)
    count = torch.bincount(camera, minlength=len(seen)).clamp_min(1)
    mean = variance.new_zeros(len(seen)).index_add(0, camera, variance) / count
    weight = (least**2 + mean).rsqrt()[camera].repeat_interleave(2)[:, None]
    arms = points - points.mean(0)
    motion = torch.cat((-cross_matrix(arms), torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3)), -1)
    by_pose = (-own[..., 3:6] @ motion[fiducial]).flatten(0, 1)  # (2 M, 6)
    basis = torch.linalg.qr(weight * by_pose).Q
    left = torch.eye(len(basis), dtype=points.dtype) - basis @ basis.mT
    spread = (left @ (weight * images.flatten(2).flatten(0, 1) * weight.mT) @ left).diagonal() / weight[:, 0].square()
    squared = mean.new_zeros(len(seen)).index_add(0, camera, spread.view(-1, 2).sum(1)) / count
    return median(squared.clamp_min(0).sqrt().numpy()[seen.any(1)])


@njit(cache=True, fastmath=kernels.FAST)
def _compare(uv, residual, seen, scale, rest, moved):
    """Write each label's residual without its camera's image motion, and the RMS of that motion.

    The motion is a shift; with four labels also a rotation and a scale, with six a linear map. It is fitted with Cauchy
    weights, starting from the median shift.
    """
    cameras, fiducials = seen.shape
    at, off, weight = np.empty((fiducials, 2)), np.empty((fiducials, 2)), np.empty(fiducials)
    number = np.empty(fiducials, np.int64)
    for c in range(cameras):
        count = 0
        for n in range(fiducials):
            if seen[c, n]:
                number[count] = n
                for i in range(2):
                    at[count, i], off[count, i] = uv[c, n, i] + residual[c, n, i], residual[c, n, i]
                count += 1
        if count < 3:
            for k in range(count):
                rest[c, number[k]] = 0.0
            continue
        shift_u, shift_v = np.median(off[:count, 0]), np.median(off[:count, 1])
        uu, uv_, vu, vv, middle_u, middle_v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for _ in range(ROUNDS):
            total, sum_u, sum_v, mean_u, mean_v = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                x, y = at[k, 0] - middle_u, at[k, 1] - middle_v
                u = off[k, 0] - shift_u - uu * x - uv_ * y
                v = off[k, 1] - shift_v - vu * x - vv * y
                weight[k] = 1 / (1 + (u * u + v * v) / (scale * scale))
                total += weight[k]
                mean_u += weight[k] * at[k, 0]
                mean_v += weight[k] * at[k, 1]
                sum_u += weight[k] * off[k, 0]
                sum_v += weight[k] * off[k, 1]
            middle_u, middle_v = mean_u / total, mean_v / total
            shift_u, shift_v = sum_u / total, sum_v / total
            if count >= 4:
                xx, xy, yy, xu, xv, yu, yv = 1e-9, 0.0, 1e-9, 0.0, 0.0, 0.0, 0.0
                for k in range(count):
                    x, y = at[k, 0] - middle_u, at[k, 1] - middle_v
                    u, v, w = off[k, 0] - shift_u, off[k, 1] - shift_v, weight[k]
                    xx, xy, yy = xx + w * x * x, xy + w * x * y, yy + w * y * y
                    xu, xv, yu, yv = xu + w * x * u, xv + w * x * v, yu + w * y * u, yv + w * y * v
                determinant = xx * yy - xy * xy
                if count >= 6 and determinant > 1e-4 * (xx + yy) ** 2:
                    uu, uv_ = (yy * xu - xy * yu) / determinant, (xx * yu - xy * xu) / determinant
                    vu, vv = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
                else:
                    uu, vu = (xu + yv) / (xx + yy), (xv - yu) / (xx + yy)
                    uv_, vv = -vu, uu
        total = 0.0
        for k in range(count):
            x, y = at[k, 0] - middle_u, at[k, 1] - middle_v
            u, v = shift_u + uu * x + uv_ * y, shift_v + vu * x + vv * y
            total += u * u + v * v
            rest[c, number[k]] = np.sqrt((off[k, 0] - u) ** 2 + (off[k, 1] - v) ** 2)
        moved[c] = np.sqrt(total / count)
