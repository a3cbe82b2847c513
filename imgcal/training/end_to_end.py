"""End-to-end training: the error after the refinement, differentiated through its solution."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.nn import project_fiducials, rms_per_axis
from imgcal.refinement import make_prediction, refine_points
from imgcal.training.data import RigBatch, Source
from imgcal.training.losses import RefinedLoss
from imgcal.types import Prediction

WORST = 200.0  # pixels: refined rigs with larger errors do not count


def end_to_end_loss(
    prediction: Prediction, batch: RigBatch, source: Source, prior_std: Tensor, config: RefinedLoss
) -> Tensor | float:
    """Weight every fiducial with the network's output, estimate the rig, and compare it with the truth.

    Args:
        prediction: (B,) last pass, with `log_sigma`.
        batch: the network's inputs, and the truth.
        source: the factory rig and the object.
        prior_std: (C, K) of the drift, the prior of the estimate.
        config: weight and noise; with weight zero, nothing is computed.

    Returns:
        Mean log(1 + RE) of the refined rigs times the weight; its gradient reaches `log_sigma` by the implicit function
        theorem. Rigs whose estimate did not converge do not count.

    Raises:
        InputError: the network predicts no weights of fiducials, or takes no points.
    """
    if not config.weight:
        return 0.0
    if prediction.log_sigma is None or batch.views.uv is None:
        raise InputError(
            "loss: refined: found a network that does not weight points, expected a point variant with "
            "`change: {trunk: {trust: true}}`"
        )
    with torch.autocast(batch.views.uv.device.type, enabled=False):
        sigma = config.sigma * prediction.log_sigma.double().exp()
        fit = refine_points(prediction, batch.views, source.factory, source.obj, prior_std, sigma)
        truth = project_fiducials(batch.truth.cameras_from_object, source.obj).double()
        re = rms_per_axis(project_fiducials(make_prediction(fit).cameras_from_object, source.obj) - truth)
        counts = fit.converged & (re < WORST)
        error = torch.where(counts, torch.log1p(torch.where(counts, re, 0.0)), 0.0)
        return config.weight * (error.sum() / counts.sum().clamp_min(1)).float()
