"""Robust MAP refinement of points after the network: outliers lose their influence and exchanged labels are corrected.

Plain least squares on all points comes first. Where the residuals agree with the noise and the prior, that is the
answer. The other rigs go through graduated non-convexity: a bounded loss (Geman and McClure) whose threshold shrinks
from the error of the first guess to the noise, so that outliers lose their influence before they can mislead. Then the
inliers are selected again among all points, exchanged labels are corrected, and a least-squares fit to the inliers
follows.

Source: graduated non-convexity as in Yang et al., RA-L 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.estimation import Estimate, EstimationOptions, initial_pose
from imgcal.refinement.points import make_observations, make_prediction, refine_points
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views

SQUARED = EstimationOptions(loss="squared")
AT_FIRST = EstimationOptions(loss="squared", max_iterations=15)  # outliers can keep it from converging
FAR = 100.0  # pixels; larger distances count as this one


@dataclass(frozen=True)
class RobustOptions:
    """What counts as an outlier. Values without a unit are in standard deviations or are ratios."""

    thresholds: tuple[float, ...] = (64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1.0, 0.5)  # pixels, one per round, decreasing
    last_threshold: float = 3.0  # sigma, in the last round
    begin: float = 0.25  # smallest first threshold, as a fraction of the first guess's median residual
    mending: float = 16.0  # times a round's threshold: points farther off may belong to another fiducial
    gate: float = 8.0  # sigma: points farther off are excluded from the final fit
    fits: float = 5.0  # standard deviations of chi2, and of a residual, beyond which outliers are suspected
    rounds: int = 2  # of inlier selection and least squares at the end


@dataclass(frozen=True)
class Target:
    """The measurements and the prior to which predictions are fitted."""

    uv: Tensor  # (B, C, N, 2) pixels
    seen: Tensor  # (B, C, N) bool
    factory: CameraRig  # without batch axes
    obj: CalibrationObject
    prior_std: Tensor  # (C, K) standard deviations of the factory values
    sigma: float  # pixels, noise of the points
    factor: Tensor | None = None  # (B, C, N) multiplies each fiducial's sigma, for instance from a network

    def __getitem__(self, rows: Tensor) -> Target:
        factor = None if self.factor is None else self.factor[rows]
        return Target(self.uv[rows], self.seen[rows], self.factory, self.obj, self.prior_std, self.sigma, factor)

    def fit(
        self,
        start: Prediction,
        options: EstimationOptions = SQUARED,
        uv: Tensor | None = None,
        seen: Tensor | None = None,
    ) -> Estimate:
        """Compute the MAP estimate from a start, for all points or the given ones."""
        views = Views(uv=self.uv if uv is None else uv, seen=self.seen if seen is None else seen)
        sigma = self.sigma if self.factor is None else self.sigma * self.factor
        return refine_points(start, views, self.factory, self.obj, self.prior_std, sigma, options)


def refine_robustly(
    prediction: Prediction,
    views: Views,
    factory: CameraRig,
    obj: CalibrationObject,
    prior_std: Tensor,
    *,
    sigma: float,
    options: RobustOptions = RobustOptions(),
) -> Prediction:
    """Refine predictions on the observed points.

    Args:
        prediction: (B,) first guesses, from a network or elsewhere; its `log_sigma` weights the points.
        views: (B,) uv and seen.
        factory: the factory rig, without batch axes.
        obj: N fiducials.
        prior_std: (C, K) standard deviation of each factory value (`Drift.std`).
        sigma: noise of the points, pixels.
        options: what counts as an outlier.

    Returns:
        (B,) refined, in float64. Each rig is refined independently of the rest of its batch.
    """
    if views.uv is None or views.seen is None:
        raise ValueError("views hold no points")
    guess = prediction.detach().to(torch.float64)
    trust = None if guess.log_sigma is None else guess.log_sigma.exp()
    target = Target(views.uv.double(), views.seen, factory.to(torch.float64), obj, prior_std.double(), sigma, trust)
    fit = target.fit(guess, AT_FIRST)
    suspect = (~fits(fit, sigma, options.fits)).nonzero().squeeze(-1)
    result = make_prediction(fit)
    if len(suspect):
        result = _replace_rigs(result, suspect, _refine_with_outliers(guess[suspect], target[suspect], options))
    return result


def fits(fit: Estimate, sigma: float, limit: float) -> Tensor:
    """Check which estimates explain all their points: (B,) bool."""
    dof = fit.dof.clamp_min(1).to(fit.chi2)
    whole = fit.chi2 <= dof + limit * (2 * dof).sqrt()
    each = fit.residual.norm(dim=-1).flatten(1).amax(-1) <= limit * sigma
    return whole & each & fit.converged


def _refine_with_outliers(guess: Prediction, target: Target, options: RobustOptions) -> Prediction:
    """Refine rigs that have outliers."""
    near = options.last_threshold
    limits = (*(limit for pixels in options.thresholds if (limit := pixels / target.sigma) > near), near)
    begin = _first_round(guess, target, limits, options.begin)
    result = guess
    for number, limit in enumerate(limits):
        rows = (begin <= number).nonzero().squeeze(-1)
        if len(rows):
            part, some = result[rows], target[rows]
            bounded = EstimationOptions(loss="geman_mcclure", threshold=limit)
            points = undo_label_swaps(part, some, options.mending * limit)
            result = _replace_rigs(result, rows, make_prediction(some.fit(part, bounded, points.uv, points.seen)))
    for _ in range(options.rounds):
        points = undo_label_swaps(result, target, options.gate)
        result = make_prediction(target.fit(result, uv=points.uv, seen=points.fits))
    worse = ~(_misfit(result, target) < _misfit(guess, target))
    rows = worse.nonzero().squeeze(-1)
    return _replace_rigs(result, rows, guess[rows])


def _misfit(prediction: Prediction, target: Target) -> Tensor:
    """Mean distance of the points from their predicted positions, each clipped at `FAR`: (B,) pixels. After a fit that
    diverged from a bad start, the start itself has the smaller distance.
    """
    distance = (_predicted_uv(prediction, target) - target.uv).norm(dim=-1).nan_to_num(nan=FAR).clamp_max(FAR)
    return (distance * target.seen).sum((1, 2)) / target.seen.sum((1, 2)).clamp_min(1)


def _first_round(guess: Prediction, target: Target, limits: tuple[float, ...], share: float) -> Tensor:
    """Index of the first round, (B,): the narrowest threshold that is still wide enough for the guess."""
    distance = (_predicted_uv(guess, target) - target.uv).norm(dim=-1) / target.sigma
    typical = torch.where(target.seen, distance, torch.nan).flatten(1).nanmedian(-1).values.nan_to_num()
    wide_enough = torch.tensor(limits).to(typical) >= share * typical[:, None]
    return (wide_enough.sum(-1) - 1).clamp(0, max(len(limits) - 2, 0))


@dataclass(frozen=True)
class UnswappedPoints:
    """Points after label correction."""

    uv: Tensor  # (B, C, N, 2) pixels
    seen: Tensor  # (B, C, N) bool
    fits: Tensor  # (B, C, N) bool: seen, and near their predicted position


def undo_label_swaps(prediction: Prediction, target: Target, gate: float) -> UnswappedPoints:
    """Reassign points that do not fit to other fiducials of the same camera that have no fitting point.

    Args:
        prediction: (B,) gives the predicted positions of the points.
        target: the points with their original labels.
        gate: sigma within which a point fits. Point and fiducial must be mutual nearest neighbours.
    """
    expected, limit = _predicted_uv(prediction, target), gate * target.sigma
    fit = target.seen & ((expected - target.uv).norm(dim=-1) <= limit)
    lost = target.seen & ~fit
    distance = (target.uv.unsqueeze(-2) - expected.unsqueeze(-3)).norm(dim=-1)  # (B, C, N points, N fiducials)
    distance = torch.where(lost.unsqueeze(-1) & ~fit.unsqueeze(-2), distance, torch.inf)
    nearest, fiducial, mutual = mutual_nearest(distance)
    source = (mutual & (nearest <= limit)).nonzero(as_tuple=True)
    place = (*source[:2], fiducial[source])
    uv, seen = target.uv.clone(), target.seen.clone()
    seen[source] = False
    uv[place], seen[place], fit[place] = target.uv[source], True, True
    return UnswappedPoints(uv, seen, fit)


def mutual_nearest(distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the nearest column of each row of (*B, N, N), and whether the two are mutual nearest neighbours.

    Returns:
        Distance, column, and bool, each (*B, N).
    """
    nearest, column = distance.min(-1)
    rows = torch.arange(distance.shape[-2], device=distance.device)
    return nearest, column, distance.argmin(-2).gather(-1, column) == rows


def robust_pose(views: Views, factory: CameraRig, obj: CalibrationObject, sigma: float) -> Prediction:
    """Fit the object's poses with the factory rig fixed, robustly: a start without a network.

    Args:
        views: (B) with points.
        factory: without batch axes.
        obj: N fiducials.
        sigma: pixels, noise of the points.

    Returns:
        (B) rigs, all the factory's, and poses.

    Raises:
        ValueError: the views hold no points.
    """
    if views.uv is None or views.seen is None:
        raise ValueError("views hold no points")
    uv, rig = views.uv.double(), factory.to(torch.float64)
    fixed = torch.zeros_like(rig.distortion[..., :1]).expand(rig.num_cameras, rig.num_parameters)
    target = Target(uv, views.seen, rig, obj, fixed, sigma)
    pose = initial_pose(make_observations(uv, views.seen, sigma), rig, obj)[:, 0]
    result = Prediction(rig.expand(len(views)), pose)
    for pixels in (100.0, 30.0):
        bounded = EstimationOptions(loss="geman_mcclure", threshold=pixels / sigma)
        result = make_prediction(target.fit(result, bounded))
    return result


def _predicted_uv(prediction: Prediction, target: Target) -> Tensor:
    points = target.obj.points.to(target.uv).expand(len(target.uv), -1, -1)
    radius = None if target.obj.radius is None else target.obj.radius.to(target.uv)
    return prediction.cameras_from_object.project(points, radius).uv


def _replace_rigs(whole: Prediction, rows: Tensor, part: Prediction) -> Prediction:
    """Replace some rigs of a batch by `part`."""
    return Prediction.combine((whole, part), lambda pair: pair[0].index_copy(0, rows, pair[1]))
