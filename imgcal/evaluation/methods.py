"""Everything that turns views into a prediction, as plain functions in a dict: `BASELINES`, and networks.

Each is given the same: views, the factory rig, the object, the spread of the drift and the noise. None knows the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from imgcal.estimation import Estimate, EstimationOptions, estimate, initial_pose
from imgcal.evaluation import classical
from imgcal.networks import ImageNetwork, Network, Positions
from imgcal.refinement import (
    ImageRefinementOptions,
    RobustOptions,
    make_observations,
    make_prediction,
    refine_images,
    refine_points,
    refine_robustly,
    robust_pose,
)
from imgcal.synthesis import Degradation, ImageOptions, render_views
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views

SIGHTED_SIGMA = 0.1  # pixels: what a position that an image network has found is off by at least
DRIFTED_SIGMA = 10.0  # pixels: what the points of a factory rig are off by


@dataclass(frozen=True)
class Given:
    """What a method may use. Double precision, on the CPU."""

    views: Views  # (B,) uv and seen
    factory: CameraRig  # without batch axes
    obj: CalibrationObject
    prior_std: Tensor  # (C, K) standard deviation of each factory value
    sigma: float  # pixels, noise of the points
    degradation: Degradation = Degradation()  # what happens to images, beside what has happened to the points
    seed: int = 0  # of that
    drawn: dict[ImageOptions, Tensor] = field(default_factory=dict)  # images that were asked for

    @property
    def uv(self) -> Tensor:
        """Pixels of the fiducials: (B, C, N, 2). Raises `ValueError` if the views hold no points."""
        if self.views.uv is None:
            raise ValueError("views hold no points")
        return self.views.uv

    @property
    def seen(self) -> Tensor:
        """Which fiducials are seen: (B, C, N) bool. Raises `ValueError` if the views hold no points."""
        if self.views.seen is None:
            raise ValueError("views hold no points")
        return self.views.seen

    def images(self, options: ImageOptions) -> Tensor:
        """Colour-coded images of the points, 8 bit a channel: (B, C, 3, size, size) float32; drawn once."""
        if options not in self.drawn:
            uv, size = self.uv.to(torch.float32), self.factory.image_size
            if self.degradation == Degradation():
                self.drawn[options] = render_views(uv, self.seen, size, self.obj, options, quantise=True)
            else:
                generator = torch.Generator().manual_seed(self.seed)
                views = Views(uv=uv, seen=self.seen)
                self.drawn[options], _ = self.degradation.draw(views, size, self.obj, options, generator)
        return self.drawn[options]


Predict = Callable[[Given], Prediction]
Passes = Callable[[Given], tuple[Prediction, ...]]


@dataclass(frozen=True)
class Refined:
    """The result of a refinement, and where it failed."""

    prediction: Prediction  # (B,)
    found: Tensor  # (B,) bool; False: what was seen contradicts the rig, or no minimum was found


Refine = Callable[[Prediction, Given], Refined]


@dataclass(frozen=True)
class Method:
    """A way to calibrate, with its refinement as a second column where it has one."""

    predict: Predict
    refine: Refine | None = None
    passes: Passes | None = None  # what it says pass by pass, coarse to fine; the last is what `predict` says
    most: int | None = None  # rigs of a trial that it is given: it is slow
    batch: int | None = None  # rigs at once at most: it needs much memory
    images: ImageOptions | None = None  # what it looks at, when not at points
    lens: str | None = None  # the one lens model that it knows; None = all

    def knows(self, rig: CameraRig) -> bool:
        """Tell whether it can calibrate cameras with these lenses."""
        return self.lens is None or set(rig.lens_models) == {self.lens}


def keep_factory_rig(given: Given) -> Prediction:
    """Keep the factory rig and fit only the object's pose: what a tracking system does that is not recalibrated.

    With the true pose, which is not known, RE would be larger. Least squares over all cameras, Huber's loss beyond what
    a drifted rig misses by.
    """
    observations = make_observations(given.uv, given.seen, max(given.sigma, DRIFTED_SIGMA))
    fixed = torch.zeros_like(given.prior_std)
    return make_prediction(estimate(observations, given.factory, given.obj, prior_std=fixed))


def map_from_pnp(given: Given, options: EstimationOptions = EstimationOptions()) -> Prediction:
    """MAP estimation of the whole rig from the factory rig and a pose by PnP over all cameras; Huber's loss."""
    observations = make_observations(given.uv, given.seen, given.sigma)
    return make_prediction(estimate(observations, given.factory, given.obj, prior_std=given.prior_std, options=options))


def factory_from_pnp(given: Given) -> Prediction:
    """Keep the factory rig and take the pose by PnP over all cameras: where `steps_from_factory` starts."""
    pose = initial_pose(make_observations(given.uv, given.seen, given.sigma), given.factory, given.obj)[:, 0]
    return Prediction(given.factory.expand(len(given.uv)), pose)


def steps_from_factory(count: int) -> Predict:
    """Make a method of `count` Levenberg-Marquardt steps of MAP estimation from the factory rig and a pose by PnP.

    The same compiled steps, loss and prior as in `map_from_pnp`, which continues until it has converged. What a network
    alone must be measured by: it, too, is given labelled points, the factory rig and the spread of its drift.
    """
    return partial(map_from_pnp, options=EstimationOptions(max_iterations=count))


def robust_from_pnp(given: Given) -> Prediction:
    """PnP in spite of outliers, then the same robust refinement that follows the networks."""
    start = robust_pose(given.views, given.factory, given.obj, given.sigma)
    return refine_by_points(start, given).prediction


def refine_by_points(prediction: Prediction, given: Given) -> Refined:
    """Refine robustly; it has failed where most points are outliers to the rig that it found."""
    options = RobustOptions()
    known, sigma = (given.factory, given.obj, given.prior_std), given.sigma
    result = refine_robustly(prediction, given.views, *known, sigma=sigma, options=options)
    uv = result.cameras_from_object.project(given.obj.points, given.obj.radius).uv
    fits = given.seen & ((uv - given.uv).norm(dim=-1) <= options.gate * sigma)
    return Refined(result, 2 * fits.sum((1, 2)) > given.seen.sum((1, 2)))


def pnp(given: Given) -> Prediction:
    """PnP for every camera on its own, with its factory intrinsics (OpenCV's solvePnP)."""
    return classical.pnp(given.uv, given.seen, given.factory, given.obj, keep_factory_rig(given))


def opencv_calibrate(given: Given) -> Prediction:
    """OpenCV's calibrateCamera for every camera on its own, starting from the factory intrinsics."""
    return classical.calibrate_cameras(given.uv, given.seen, given.factory, given.obj, keep_factory_rig(given))


def scipy_bundle_adjustment(given: Given) -> Prediction:
    """Minimize the cost of MAP estimation, squared loss, with scipy's least_squares from a pose by PnP."""
    observations = make_observations(given.uv, given.seen, given.sigma)
    return classical.bundle_adjustment(observations, given.factory, given.obj, given.prior_std)


STEPS = (1, 2, 3, 5)
"""Levenberg-Marquardt steps from the factory that every table has."""

QUICK_BASELINES: dict[str, Method] = {
    "factory, pose fitted": Method(keep_factory_rig),
    "factory, pose by PnP": Method(factory_from_pnp),
    **{f"{count} LM step{'s'[: count > 1]} from the factory": Method(steps_from_factory(count)) for count in STEPS},
    "MAP from PnP": Method(map_from_pnp),
}
"""What every network stands beside. All but the first begin with the same pose by PnP, whose time is in theirs."""

BASELINES: dict[str, Method] = QUICK_BASELINES | {
    "PnP per camera, factory intrinsics": Method(pnp, most=2000, lens=classical.LENS),
    "OpenCV calibrateCamera per camera": Method(opencv_calibrate, most=200, lens=classical.LENS),
    "scipy bundle adjustment": Method(scipy_bundle_adjustment, most=50),
    "PnP + robust bundle adjustment": Method(robust_from_pnp),
}
"""The competitors, by the name they have in tables. Slow ones get the first `most` rigs of every trial.

OpenCV's know one lens model alone (`Method.knows`)."""


def network_method(network: Network, batch: int | None = None) -> Method:
    """Make a method of a network in evaluation mode, on whatever device it is; refinement runs on the CPU.

    Args:
        network: takes `Views`, returns predictions coarse to fine (`imgcal.networks`).
        batch: rigs at once at most; None = 512 for points, 32 for images.
    """
    options = network.image_options
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))

    @torch.no_grad()
    def passes(given: Given) -> tuple[Prediction, ...]:
        if options is None:
            views = Views(uv=given.uv.to(device, torch.float32), seen=given.seen.to(device))
        else:
            views = Views(images=given.images(options).to(device))
        return tuple(prediction.to(torch.float64, "cpu") for prediction in network(views))

    def predict(given: Given) -> Prediction:
        return passes(given)[-1]

    if options is None:
        return Method(predict, refine_by_points, passes, batch=batch or 512)
    return Method(predict, _refine_by_images(network, options), passes, batch=batch or 32, images=options)


@torch.no_grad()
def refine_by_positions(
    prediction: Prediction, sightings: Positions, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor
) -> Prediction:
    """Refine (B) predictions on the positions of an image network with their predicted sigmas; prior_std (C, K)."""
    return make_prediction(_fit_to_positions(prediction, sightings, factory, obj, prior_std))


def _fit_to_positions(
    prediction: Prediction, sightings: Positions, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor
) -> Estimate:
    sigma = (sightings.sigma.square() + SIGHTED_SIGMA**2).sqrt().to("cpu", torch.float64)
    views = Views(*(None if part is None else part.cpu() for part in (sightings.views.uv, sightings.views.seen)))
    return refine_points(prediction, views, factory, obj, prior_std, sigma)


def _refine_by_images(network: Network, options: ImageOptions) -> Refine:
    """Render and compare; where images do not confirm the rig, the positions that the network has found decide."""

    @torch.no_grad()
    def refine(prediction: Prediction, given: Given) -> Refined:
        comparison = ImageRefinementOptions(image=options, position_noise=given.sigma)
        images = given.images(options)
        fit, _ = refine_images(prediction, images, given.factory, given.obj, given.prior_std, comparison)
        rows = (~fit.converged).nonzero().squeeze(-1)
        if not isinstance(network, ImageNetwork) or not len(rows):
            return Refined(make_prediction(fit), fit.converged)
        device = next(network.parameters()).device
        sightings = network.sight(images[rows].to(device))
        mended = _fit_to_positions(prediction[rows], sightings, given.factory, given.obj, given.prior_std)
        order = torch.arange(len(images)).index_copy(0, rows, len(images) + torch.arange(len(rows)))
        found = fit.converged.index_copy(0, rows, mended.converged)
        return Refined(Prediction.cat([make_prediction(fit), make_prediction(mended)])[order], found)

    return refine
