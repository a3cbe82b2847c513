"""MAP refinement after the network: the rig that best explains labelled points, from a network's first guess."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.estimation import Estimate, EstimationOptions, estimate
from imgcal.types import CalibrationObject, CameraRig, Observations, Prediction, Views

# From a start this near, it is best to reject gross outliers (swapped labels, false blobs) at once.
ROBUST = EstimationOptions(loss="cauchy")


def refine_points(
    prediction: Prediction,
    views: Views,
    factory: CameraRig,
    obj: CalibrationObject,
    prior_std: Tensor,
    sigma: Tensor | float,
    options: EstimationOptions = ROBUST,
) -> Estimate:
    """Refine a network's prediction on its input points.

    Computes in float64 whatever the network's precision. Differentiable in uv, sigma (per-observation weights), the
    factory rig and the prior's standard deviations by the implicit function theorem. No gradient reaches the
    prediction, which only starts the search.

    Args:
        prediction: (B,) first guess.
        views: (B, C, N) points in pixels; `seen` None = all.
        factory: the factory rig, the centre of the prior.
        obj: N fiducials.
        prior_std: (C, K) or (B, C, K) standard deviation of each factory value.
        sigma: pixels, a number or broadcastable to (B, C, N): one standard deviation of each axis.
        options: how to minimize.

    Returns:
        The estimate, one snapshot per rig; `converged` tells which ones to trust.

    Raises:
        ValueError: views without points.
        InputError: inconsistent shapes.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import RelativeDrift, synthesize
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
        >>> drawn = synthesize(factory, obj, 3, torch.Generator().manual_seed(0))
        >>> views = Views(drawn.projection.uv, torch.ones(drawn.projection.uv.shape[:-1], dtype=torch.bool))
        >>> start = Prediction(factory.expand(3), drawn.rig_from_object)  # as from a network
        >>> refined = refine_points(start, views, factory, obj, RelativeDrift().std(factory), sigma=0.1)
        >>> bool(refined.converged.all()), float(refined.rms.max()) < 0.1
        (True, True)
    """
    if views.uv is None:
        raise ValueError("refine_points needs views with points")
    uv = views.uv.double()
    seen = torch.ones_like(uv[..., 0], dtype=torch.bool) if views.seen is None else views.seen
    guess = prediction.detach().to(torch.float64)
    return estimate(
        make_observations(uv, seen, sigma),
        factory.to(torch.float64),
        obj,
        guess.rig_from_object.reshape(len(uv), 1),
        prior_std=prior_std.double(),
        initial_rig=guess.rig,
        options=options,
    )


def make_observations(uv: Tensor, seen: Tensor, sigma: Tensor | float) -> Observations:
    """Convert one snapshot per rig, uv (B, C, N, 2), seen and sigma (B, C, N), to observations (B, 1, C, N)."""
    sigmas = torch.as_tensor(sigma, dtype=uv.dtype, device=uv.device).expand(seen.shape)
    return Observations(uv[:, None], sigmas[:, None], seen[:, None])


def make_prediction(estimate: Estimate) -> Prediction:
    """Convert an estimate of one snapshot per rig, (B,) and (B, 1) poses, to a prediction."""
    return Prediction(estimate.rig, estimate.rig_from_object[:, 0])
