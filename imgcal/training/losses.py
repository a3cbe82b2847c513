"""Training losses: stateless functions of predicted and true cameras; the projection goes through kornia.

Everything is computed in float32 or better even under autocast: bf16 would round a coordinate of 1234.567 to 1232.

Source: paper section 4.3, its supplementary section "Less Effective Strategies", and our own robust preset.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor

from imgcal.geometry import geodesic_angle
from imgcal.io import StrictModel
from imgcal.nn import project_fiducials, rms_per_axis
from imgcal.types import CalibrationObject, CameraRig, Prediction, pack21

# Parameters of smaller prior standard deviation (rad, mm, pixels, pixels) count as fixed, because of float32 rounding.
LEAST_SPREAD = (1e-6,) * 3 + (1e-3,) * 3 + (1e-3,) * 2 + (1e-3,) * 2
LEAST_SPREAD_OF_LENS = 1e-7  # for each lens coefficient

Weight = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e9)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e9)]


class RobustLoss(StrictModel):
    """Weights of our own preset: log(1 + RE) for small errors, the clamped RE for medium, rotations for large ones."""

    gamma: Annotated[float, Field(gt=0, le=1)] = 0.7  # weight of pass t of T: gamma^(T - 1 - t)
    log_re: Weight = 1.0  # of log(1 + RE / 1 px)
    re: Weight = 0.02  # of the RE, per pixel
    re_limit: Positive = 200.0  # pixels: limit of the RE
    geodesic: Weight = 1.0  # of the cameras' rotation error, per rad
    offsets: Weight = 0.1  # of the mean squared error of the rig's parameters, in units of the drift's spread
    offsets_limit: Positive = 10.0  # in units of the spread: limit of an offset's error


class PaperLoss(StrictModel):
    """Weights of the paper's compound loss."""

    lambda1: Weight = 100.0  # of L_diff and L_geo
    lambda2: Weight = 0.01  # of the reprojection RMSE
    lambda_scale: Positive = 1000.0  # of rotation and distortion within L_diff; 1 = value scaling off
    reprojection_from: Annotated[int, Field(ge=0)] = 10_000  # the step at which the second stage begins


class ExtraLoss(StrictModel):
    """Weights of losses that the paper tried and found less effective; 0 = off."""

    log_cosh: Weight = 0.0  # of log cosh of the differences of a camera's numbers
    distortion: Weight = 0.0  # of the absolute distortion coefficients
    focal_ratio: Weight = 0.0  # of the squared difference of fx and fy
    principal_point: Weight = 0.0  # of the squared distance of the principal point from the image's centre
    large_focal: Weight = 0.0  # of 1 / (fx + fy)
    l1: Weight = 0.0  # of the network's absolute parameters


class RefinedLoss(StrictModel):
    """End-to-end training: the RE after MAP refinement is differentiated to train the weights of the fiducials."""

    weight: Weight = 0.0  # of log(1 + RE of the refined rig / 1 px); 0 = off
    sigma: Positive = 0.1  # pixels, noise of a fiducial with full weight


class LossConfig(StrictModel):
    """The block `loss` of an experiment file."""

    kind: Literal["robust", "paper"] = "robust"  # our own preset, or the paper's
    robust: RobustLoss = RobustLoss()
    paper: PaperLoss = PaperLoss()
    extra: ExtraLoss = ExtraLoss()
    refined: RefinedLoss = RefinedLoss()


@dataclass(frozen=True)
class LossTerms:
    """The quantity to minimize, and errors for the log."""

    total: Tensor  # () with its graph
    passes: Tensor  # (T,) pixels, mean RE of each pass, without graph


def compound(
    predictions: Sequence[Prediction],
    truth: Prediction,
    obj: CalibrationObject,
    config: LossConfig,
    step: int,
    prior_std: Tensor,
    weights: Iterable[Tensor] = (),
) -> LossTerms:
    """Compare every pass of a network with the truth.

    Args:
        predictions: one (B,) prediction per pass, coarse to fine.
        truth: (B,).
        obj: the object whose fiducials are projected.
        config: terms and their weights.
        step: steps already taken, for the paper's two stages.
        prior_std: (C, K) prior standard deviation of each parameter (`Drift.std`); fixed parameters do not count.
        weights: parameters of the network, for the L1 regularizer.
    """
    with torch.autocast(truth.rig.focal_length.device.type, enabled=False):
        predicted = _stack_passes(predictions)  # (T, B)
        cameras, true_cameras = predicted.cameras_from_object, truth.cameras_from_object
        difference = project_fiducials(cameras, obj) - project_fiducials(true_cameras, obj)
        re = rms_per_axis(difference)  # (T, B)
        if config.kind == "robust":
            terms = _robust_terms(predicted, truth, re, config.robust, prior_std)
            gamma = config.robust.gamma
        else:
            terms = _paper_terms(cameras, true_cameras, difference, config.paper, step)
            gamma = 1.0
        terms = terms + _extra_terms(cameras, true_cameras, config)
        last = len(predictions) - 1
        total = sum((gamma ** (last - t) * terms[t] for t in range(last + 1)), start=terms.new_zeros(()))
        if config.extra.l1:
            total = total + config.extra.l1 * l1_norm(weights)
    return LossTerms(total, re.detach().mean(-1))


def reprojection_rmse(difference: Tensor) -> Tensor:
    """L_eps of the paper: one RMSE over all of (B, C, N, 2) pixels."""
    return rms_per_axis(difference.flatten(0, -3))


def parameter_rmse(predicted: CameraRig, truth: CameraRig, lambda_scale: float = 1000.0) -> Tensor:
    """L_diff: RMSE over the paper's 16 + D numbers per camera.

    Args:
        predicted: (B,) cameras in the object's frame.
        truth: (B,) cameras in the object's frame.
        lambda_scale: factor on rotation and distortion, whose numbers are small compared with mm and pixels.
    """
    return _root(_scaled_difference(predicted, truth, lambda_scale).square().mean())


def geodesic(predicted: CameraRig, truth: CameraRig) -> Tensor:
    """L_geo: angle between predicted and true rotation of each camera, (*B, C) rad."""
    return geodesic_angle(predicted.cam_from_rig.rotation, truth.cam_from_rig.rotation)


def offsets_error(predicted: CameraRig, truth: CameraRig, prior_std: Tensor, limit: float) -> Tensor:
    """Mean squared error of the rig's parameters in units of their prior standard deviations.

    Args:
        predicted: (*B) rigs.
        truth: (B,) rigs.
        prior_std: (C, K); parameters below `least_spread` do not count.
        limit: limit of an error, in these units.

    Returns:
        (*B); zero if all parameters are fixed.
    """
    free = prior_std > least_spread(prior_std)
    scale = torch.where(free, prior_std, torch.ones_like(prior_std)).reciprocal() * free
    squared = (predicted.local(truth) * scale).clamp(-limit, limit).square()
    return squared.sum((-2, -1)) / free.sum().clamp_min(1)


def least_spread(like: Tensor) -> Tensor:
    """Smallest prior standard deviation (K,) of a free parameter, for the (C, K) of a rig."""
    return like.new_tensor((*LEAST_SPREAD, *(LEAST_SPREAD_OF_LENS,) * (like.shape[-1] - len(LEAST_SPREAD))))


def log_cosh(predicted: CameraRig, truth: CameraRig, lambda_scale: float = 1000.0) -> Tensor:
    """Mean log cosh of the differences of these numbers: a smooth absolute value."""
    size = _scaled_difference(predicted, truth, lambda_scale).abs()
    return (size + torch.nn.functional.softplus(-2 * size) - math.log(2)).mean()


def distortion_size(cameras: CameraRig) -> Tensor:
    """Sum of the absolute distortion coefficients, mean over cameras."""
    return cameras.distortion.abs().sum(-1).mean()


def focal_ratio(cameras: CameraRig) -> Tensor:
    """Squared difference of fx and fy, mean over cameras."""
    return (cameras.focal_length[..., 0] - cameras.focal_length[..., 1]).square().mean()


def principal_point_shift(cameras: CameraRig) -> Tensor:
    """Squared distance of the principal point from the image centre (pixels), mean over cameras."""
    centre = (cameras.image_size - 1).to(cameras.principal_point) / 2
    return (cameras.principal_point - centre).square().sum(-1).mean()


def inverse_focal(cameras: CameraRig) -> Tensor:
    """1 / (fx + fy), mean over cameras: small where focal lengths are large."""
    return cameras.focal_length.sum(-1).clamp_min(1.0).reciprocal().mean()


def l1_norm(weights: Iterable[Tensor]) -> Tensor:
    """Sum of the absolute values of a network's parameters."""
    return torch.stack([weight.float().abs().sum() for weight in weights]).sum()


def _robust_terms(
    predicted: Prediction, truth: Prediction, re: Tensor, config: RobustLoss, prior_std: Tensor
) -> Tensor:
    """(T,) losses."""
    angle = geodesic(predicted.cameras_from_object, truth.cameras_from_object).mean(-1)
    offsets = offsets_error(predicted.rig, truth.rig, prior_std, config.offsets_limit)
    pixels = config.log_re * re.log1p() + config.re * re.clamp_max(config.re_limit)
    return (pixels + config.geodesic * angle + config.offsets * offsets).mean(-1)


def _paper_terms(
    cameras: CameraRig, true_cameras: CameraRig, difference: Tensor, config: PaperLoss, step: int
) -> Tensor:
    """(T,) losses: L_diff and L_geo, from the second stage on also the reprojection RMSE."""
    losses = []
    for t in range(len(difference)):
        loss = parameter_rmse(cameras[t], true_cameras, config.lambda_scale) + geodesic(cameras[t], true_cameras).mean()
        loss = config.lambda1 * loss
        if step >= config.reprojection_from:
            loss = loss + config.lambda2 * reprojection_rmse(difference[t])
        losses.append(loss)
    return torch.stack(losses)


def _extra_terms(cameras: CameraRig, true_cameras: CameraRig, config: LossConfig) -> Tensor:
    """(T,) losses of the enabled regularizers."""
    extra = config.extra
    terms = cameras.focal_length.new_zeros(len(cameras.focal_length))
    if extra.log_cosh:
        scale = config.paper.lambda_scale
        each = [log_cosh(cameras[t], true_cameras, scale) for t in range(len(terms))]
        terms = terms + extra.log_cosh * torch.stack(each)
    for weight, function in (
        (extra.distortion, distortion_size),
        (extra.focal_ratio, focal_ratio),
        (extra.principal_point, principal_point_shift),
        (extra.large_focal, inverse_focal),
    ):
        if weight:
            terms = terms + weight * torch.stack([function(cameras[t]) for t in range(len(terms))])
    return terms


def _stack_passes(predictions: Sequence[Prediction]) -> Prediction:
    """Stack passes on an axis of their own, in float32 or better: (T, B)."""
    return Prediction.combine(predictions, _stack)


def _stack(tensors: list[Tensor]) -> Tensor:
    stacked = torch.stack(tensors)
    return stacked.float() if stacked.dtype in (torch.bfloat16, torch.float16) else stacked


def _scaled_difference(predicted: CameraRig, truth: CameraRig, lambda_scale: float) -> Tensor:
    """Differences of the 16 + D numbers per camera, (*B, C, 16 + D), rotation and distortion times `lambda_scale`."""
    difference = pack21(predicted) - pack21(truth)
    scale = difference.new_ones(difference.shape[-1])
    scale[:9] = scale[16:] = lambda_scale
    return difference * scale


def _root(mean_square: Tensor) -> Tensor:
    """Square root with zero gradient at zero instead of an infinite one."""
    return mean_square.clamp_min(1e-20).sqrt()
