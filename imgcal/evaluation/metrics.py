"""How far a prediction is from the truth, and how near physics lets any estimator come."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from imgcal.estimation import (
    POSE_PARAMETERS,
    Estimate,
    NormalEquations,
    Problem,
    linearize,
    relative_covariance,
    relative_difference,
    squared,
)
from imgcal.types import CalibrationObject, CameraRig, Prediction


@dataclass(frozen=True)
class Errors:
    """One number a rig for each kind of error, (B,): root mean square over cameras (and axes). Bounds have this form.

    Rotations and positions are relative to the first camera, which does not count: free of the gauge.
    """

    re: Tensor  # pixels
    held_out: Tensor  # pixels, RE on points that took no part: `held_out_points`
    focal_length: Tensor  # pixels
    focal_length_percent: Tensor  # of the true focal length
    principal_point: Tensor  # pixels
    distortion: Tensor  # all coefficients alike
    rotation_deg: Tensor  # angle
    position: Tensor  # mm, distance

    def __len__(self) -> int:
        return len(self.re)

    def __getitem__(self, rows: slice) -> Errors:
        return Errors(**{name: getattr(self, name)[rows] for name in KINDS})

    def where(self, found: Tensor) -> Errors:
        """Set every kind to nan where nothing was found, (B,) bool, or where RE is not finite."""
        there = found & self.re.isfinite()
        return Errors(**{name: torch.where(there, getattr(self, name), torch.nan) for name in KINDS})


KINDS = tuple(field.name for field in fields(Errors))
HELD_OUT = 32
"""Points on which `Errors.held_out` is measured."""


def concatenate(parts: Sequence[Errors]) -> Errors:
    """Join errors of several batches."""
    return Errors(**{name: torch.cat([getattr(part, name) for part in parts]) for name in KINDS})


@torch.no_grad()
def reprojection_error(predicted: CameraRig, truth: CameraRig, obj: CalibrationObject) -> Tensor:
    """RE, the paper's error: root mean square over cameras, fiducials and both axes of the pixel error.

    Args:
        predicted: (B,) cameras in the object's frame (`Prediction.cameras_from_object`).
        truth: (B,) likewise.
        obj: N fiducials, all of which count, seen or not.

    Returns:
        (B,) pixels. A fiducial behind a predicted camera counts with the finite, huge pixel that projection gives it.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import synthesize
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
        >>> drawn = synthesize(rig, obj, 2, torch.Generator().manual_seed(0))
        >>> cameras = drawn.rig.from_object(drawn.rig_from_object)
        >>> reprojection_error(cameras, cameras, obj)
        tensor([0., 0.], dtype=torch.float64)
    """
    return _rms_of_pixels(predicted, truth, obj.points, obj.radius)


def held_out_points(obj: CalibrationObject, count: int = HELD_OUT) -> Tensor:
    """Points of the working volume that took no part: (count, 3) mm in the object's frame, always the same ones.

    Even over the ball about the object's centroid that holds all its fiducials: what the fiducials sweep over when the
    object turns about its centre, as it does over the range of poses. A rig that fits its own eight points and bends
    the space between and around them has a larger error here.
    """
    generator = torch.Generator().manual_seed(0)
    points = obj.points.double()
    centre = points.mean(0)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=points.dtype), dim=-1)
    share = torch.rand(count, 1, generator=generator, dtype=points.dtype) ** (1 / 3)
    return centre + (points - centre).norm(dim=-1).max() * share * direction


@torch.no_grad()
def errors(predicted: Prediction, truth: Prediction, obj: CalibrationObject) -> Errors:
    """Compare predictions (B,) with the truth."""
    difference = relative_difference(predicted.rig, truth.rig)
    cameras, true_cameras = predicted.cameras_from_object, truth.cameras_from_object
    re = reprojection_error(cameras, true_cameras, obj)
    held_out = _rms_of_pixels(cameras, true_cameras, held_out_points(obj), None)
    return _summarize(difference.square(), re, held_out, truth.rig.focal_length)


@torch.no_grad()
def cramer_rao(estimate: Estimate, obj: CalibrationObject) -> Errors:
    """Posterior Cramer-Rao bound of every kind of error: root of the mean variance that the data and the prior leave.

    Evaluated at the MAP estimate from the true inliers, not at the truth: the two differ by less than the noise, and
    there the normal equations are at hand. Under the uniform drift of the paper the prior is a Gaussian of equal
    variance, so this is the bound of estimators that know the drift's spread and no more.

    Args:
        estimate: (B,) with one snapshot each, by the squared loss.
        obj: what was seen.
    """
    variance = relative_covariance(estimate).diagonal(dim1=-2, dim2=-1).unflatten(-1, (estimate.rig.num_cameras, -1))
    problem = estimate.problem
    held_out = held_out_points(obj).to(problem.points) - problem.centroid
    shape = (*problem.uv.shape[:-1], len(held_out))
    others = replace(problem, points=held_out, radius_squared=None, uv=problem.uv.new_zeros(shape))
    return _summarize(
        variance.clamp_min(0), _re_bound(estimate, problem), _re_bound(estimate, others), estimate.rig.focal_length
    )


def _rms_of_pixels(predicted: CameraRig, truth: CameraRig, points: Tensor, radius: Tensor | None) -> Tensor:
    """Root mean square pixel error over cameras, points (N, 3) and both axes: (B,)."""
    batch = torch.broadcast_shapes(predicted.batch_shape, truth.batch_shape)
    dtype = torch.promote_types(predicted.focal_length.dtype, truth.focal_length.dtype)
    device = truth.focal_length.device
    points = points.to(device, dtype).expand(*batch, -1, -1)
    radius = None if radius is None else radius.to(device, dtype)
    difference = predicted.to(dtype).project(points, radius).uv - truth.to(dtype).project(points, radius).uv
    return difference.square().mean((-1, -2, -3)).sqrt()


def _summarize(squares: Tensor, re: Tensor, held_out: Tensor, focal_length: Tensor) -> Errors:
    """Reduce squared errors or variances (B, C, K), extrinsics relative to the first camera."""
    others = squares[..., 1:, :] if squares.shape[-2] > 1 else squares
    focal = squares[..., 6:8]
    return Errors(
        re=re,
        held_out=held_out,
        focal_length=focal.mean((-1, -2)).sqrt(),
        focal_length_percent=100 * (focal / focal_length.square()).mean((-1, -2)).sqrt(),
        principal_point=squares[..., 8:10].mean((-1, -2)).sqrt(),
        distortion=squares[..., 10:].mean((-1, -2)).sqrt(),
        rotation_deg=others[..., 0:3].sum(-1).mean(-1).sqrt() * (180 / math.pi),
        position=others[..., 3:6].sum(-1).mean(-1).sqrt(),
    )


def _re_bound(estimate: Estimate, problem: Problem) -> Tensor:
    """Root of the mean variance of the pixels of a problem's points in all cameras, seen or not: (B,)."""
    solution = estimate.solution
    every = replace(problem, root_weight=torch.ones_like(problem.uv[..., 0, :]))
    full = linearize(every, solution.state, squared)
    information = _dense(full)
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    diagonal[:, : diagonal.shape[1] - POSE_PARAMETERS] -= 1  # the prior's unit matrix
    covariance = torch.cholesky_inverse(torch.linalg.cholesky(_dense(solution.equations)))
    variance = (information * covariance).sum((-1, -2)) / problem.uv[0].numel()
    return variance.clamp_min(0).sqrt()


def _dense(equations: NormalEquations) -> Tensor:
    """Normal matrix of one snapshot a rig: (B, K C + 6, K C + 6)."""
    batch, cameras = equations.camera.shape[:2]
    size = cameras * equations.camera.shape[-1]
    matrix = equations.camera.new_zeros(batch, size + POSE_PARAMETERS, size + POSE_PARAMETERS)
    blocks = matrix[:, :size, :size].unflatten(1, (cameras, -1)).unflatten(-1, (cameras, -1))
    blocks.diagonal(dim1=1, dim2=3).copy_(equations.camera.permute(0, 2, 3, 1))
    coupling = equations.coupling[:, 0].reshape(batch, size, POSE_PARAMETERS)
    matrix[:, :size, size:] = coupling
    matrix[:, size:, :size] = coupling.mT
    matrix[:, size:, size:] = equations.pose[:, 0]
    return matrix
