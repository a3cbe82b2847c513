"""Render-and-compare: the rig whose rendered colour-coded images match the given ones, without detected points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.estimation import Estimate, EstimationOptions, estimate, make_problem
from imgcal.refinement.graduated_non_convexity import mutual_nearest, refine_robustly
from imgcal.refinement.photometric import DotWindows, NearFit, ShiftPrior, profile_and_slope, take_blurred_step
from imgcal.refinement.points import make_prediction
from imgcal.synthesis import GREY_LEVELS, ImageOptions
from imgcal.types import CalibrationObject, CameraRig, Observations, Prediction, Views

PRESENT = 0.5  # amplitude above which a dot counts as present
FARTHEST = 1e3  # image widths; predicted positions are clamped here
# Floats in a chunk's largest temporary: what fits a processor's cache, or a GPU's memory.
CHUNK = {"cpu": 1_000_000, "cuda": 200_000_000}
FLOATS_A_PAIR = 52  # of that temporary, for each channel of each pair of dots: 4 products a row of 13


Attempt = Literal["relabel", "near", "far"]
"""What to try for rigs that the images do not confirm: reassign dots by their colours; take near steps from the current
rig, in case cameras confused neighbouring dots; or start again with blurred steps.
"""
RIDGE = 0.05  # relative to a dot's own weight: dots at the same place share the light there
MOST_DIFFERENCE = 0.3  # largest RGB distance between the colours of a dot and of a fiducial


@dataclass(frozen=True)
class ImageRefinementOptions:
    """How images are compared. Lengths in pixels of the image, brightness in grey levels of 8 bit."""

    image: ImageOptions = ImageOptions()
    blurs: tuple[float, ...] = (16.0, 8.0, 8.0, 4.0, 2.0, 1.0)  # standard deviations, one step each, far to near
    shift: ShiftPrior = ShiftPrior(together=8.0, alone=2.0)  # of the dots, in each blurred step
    trust: float = 0.1  # see `photometric.take_blurred_step`
    pooling: int = 4  # side of the square of pixels that is averaged before blurred steps
    steps: int = 3  # near steps
    attempts: tuple[Attempt, ...] = ("relabel", "near", "far", "near", "relabel")  # in turn, until a rig is confirmed
    noise: float = 12**-0.5  # grey levels, one standard deviation; that of rounding to 8 bit
    position_noise: float = 0.0  # sensor pixels: standard deviation of drawn dots about the fiducials' true images
    near: float = 3.0  # pixels: largest median error of the first guess at which labels are checked by colour
    gate: float = 8.0  # sigma, beyond which a dot does not match its assigned fiducial
    most_residual: float = 2.0  # grey levels, RMS in a dot's window, beyond which the dot is rejected
    most_chi2: float = 5.0  # per degree of freedom, beyond which a rig has not converged
    estimation: EstimationOptions = EstimationOptions()


@torch.no_grad()
def refine_images(
    prediction: Prediction,
    images: Tensor,
    factory: CameraRig,
    obj: CalibrationObject,
    prior_std: Tensor,
    options: ImageRefinementOptions = ImageRefinementOptions(),
) -> tuple[Estimate, Observations]:
    """Refine a network's prediction on its input images: photometric Gauss-Newton, then MAP.

    Each image is compared with rendered dots, blurred at first and sharp at the end, each camera independently. This
    gives the positions of the dots and their covariance; the MAP estimate of the rig follows from those. Rigs that the
    images do not confirm are tried again from there, and with exchanged labels corrected (`find_swapped_labels`).

    Args:
        prediction: (B,) first guess.
        images: (B, C, 3, size, size) in [0, 1] as `render_views` draws them.
        factory: the factory rig, the centre of the prior.
        obj: N fiducials in their colours.
        prior_std: (C, K) or (B, C, K) standard deviation of each factory value.
        options: how to compare.

    Returns:
        The estimate, one snapshot per rig, in float64 and in sensor pixels, and the dots that it was computed from.
        `converged` is false where the images are not explained: residuals too large, light that no dot explains, or
        `chi2_per_dof` too large.

    Raises:
        InputError: the shape of the images does not agree with the options and the rig.
    """
    _check(images, factory, options)
    problem = ImageProblem(factory.to(torch.float64), obj, prior_std.double(), options)
    return problem.on_sensor(*search(problem, prediction, images))


@torch.no_grad()
def search(problem: ImageProblem, prediction: Prediction, images: Tensor) -> tuple[Estimate, Dots]:
    """Do the work of `refine_images`; the returned estimate is in image pixels."""
    guess = prediction.detach().to(torch.float64)
    guess = Prediction(guess.rig.resized(problem.size), guess.rig_from_object)
    dots = problem.find_dots(images, guess)
    result = problem.solve(dots, guess)
    for attempt in problem.options.attempts:
        again = (~result.converged).nonzero().squeeze(-1)
        if len(again) == 0:
            break
        found = make_prediction(result)
        if attempt == "relabel":
            again = again[problem.is_near(guess[again], dots.select(again))]
            if len(again) == 0:
                continue
            new = problem.relabel(images[again], guess[again], dots.select(again))
            relabelled = problem.solve(new, found[again])
            better = problem.count_explained(relabelled, new) > problem.count_explained(result, dots)[again]
            again, new = again[better], new.select(better)
        else:
            new = problem.find_dots(images[again], found[again], dots.select(again) if attempt == "near" else None)
        dots = dots.update(again, new)
        result = problem.solve(dots, found)
    return result, dots


@dataclass(frozen=True)
class Dots:
    """Dots found in images, in pixels of the image."""

    uv: Tensor  # (B, C, N, 2)
    sigma: Tensor  # (B, C, N)
    believed: Tensor  # (B, C, N) bool
    light: Tensor  # (B, C) sum over all channels, in units of one dot's light in a channel of 1
    colour: Tensor  # (B, C, N) the fiducial whose colour the dot has; differs from its index where labels are exchanged

    def select(self, rows: Tensor) -> Dots:
        """Select some rigs."""
        return Dots(**{name: value[rows] for name, value in vars(self).items()})

    def update(self, rows: Tensor, new: Dots) -> Dots:
        """Replace some rigs."""
        return Dots(**{name: value.index_copy(0, rows, getattr(new, name)) for name, value in vars(self).items()})


class ImageProblem:
    """The refinement problem in image pixels: the factory rig is resized as if its sensors delivered the images.

    In image pixels, one standard deviation holds for both axes of a dot; in the pixels of a sensor that is not square
    it does not. The whitened parameters are the same in both, and so are the normal equations.
    """

    def __init__(
        self, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor, options: ImageRefinementOptions
    ) -> None:
        """Store float64 inputs. The predictions given to the other methods are in image pixels, too."""
        self.factory, self.obj, self.prior_std, self.options = factory, obj, prior_std, options
        self.size = torch.full((2,), options.image.size, device=prior_std.device)
        self.rig = factory.resized(self.size)
        self.scale = options.image.size / factory.image_size.to(prior_std)  # (C, 2) image pixels per sensor pixel
        self.unit = self.scale.prod(-1).sqrt()[:, None]  # (C, 1) geometric mean of both axes
        units = torch.ones_like(prior_std)
        units[..., 6:10] = torch.cat((self.scale, self.scale), -1)
        self.image_spread = prior_std * units
        self.points = obj.points.to(prior_std)
        self.colours = obj.colours.to(prior_std.device, torch.float32)

    def find_dots(self, images: Tensor, guess: Prediction, known: Dots | None = None) -> Dots:
        """Find the dots of images (B, C, 3, H, W) near their predicted or known positions."""
        options, flat, batch = self.options, images.flatten(0, 1), images.shape[:2]
        uv = self._places(guess)
        if known is None:
            blurs, steps = options.blurs, options.steps
        else:
            blurs, steps = options.blurs[-1:], 2 * options.steps
            uv = torch.where(known.believed[..., None], known.uv, uv)
        far, amplitude, light = (
            part.unflatten(0, batch) for part in self._take_blurred_steps(flat, uv.flatten(0, 1), blurs)
        )
        uv = far if known is None else uv  # for known dots, the blurred step only tests whether they are present
        own = torch.arange(self.obj.num_fiducials, device=uv.device).expand(uv.shape[:-1])
        return self.measure(images, uv, amplitude > PRESENT, own, light, steps)

    def is_near(self, guess: Prediction, dots: Dots) -> Tensor:
        """Check which guesses are close to most dots: (B,) bool."""
        offset = torch.where(dots.believed, (self._places(guess) - dots.uv).norm(dim=-1), torch.nan)
        return offset.flatten(1).nanmedian(-1).values < self.options.near

    def count_explained(self, result: Estimate, dots: Dots) -> Tensor:
        """Count the dots that rigs explain, (B,): 0 where they are inconsistent."""
        return dots.believed.sum((1, 2)) * (result.chi2_per_dof < self.options.most_chi2)

    def relabel(self, images: Tensor, guess: Prediction, dots: Dots) -> Dots:
        """Measure dots with exchanged colours again, starting from a robust fit to all dots.

        Args:
            images: (B, C, 3, H, W).
            guess: (B,) where to start.
            dots: as found; some may be at the place of another fiducial.
        """
        rig = self._fit_robustly(guess, dots)
        uv = self._places(rig)
        offset = (uv - dots.uv).norm(dim=-1)
        colour = colours_at(images.flatten(0, 1), uv.flatten(0, 1), self.options.image.dot)
        fits = dots.believed & (offset < self.options.gate * dots.sigma)
        taken = find_swapped_labels(colour.unflatten(0, uv.shape[:2]), self.colours, fits)
        return self.measure(images, uv, taken >= 0, taken.clamp_min(0), dots.light, 2 * self.options.steps)

    def _fit_robustly(self, guess: Prediction, dots: Dots) -> Prediction:
        """Estimate rigs robustly against mislabelled dots."""
        typical = float(dots.sigma[dots.believed].median()) if bool(dots.believed.any()) else 1.0
        factor = torch.where(dots.believed, dots.sigma / typical, 1.0)
        weighed = Prediction(guess.rig, guess.rig_from_object, factor.log())
        views = Views(uv=dots.uv, seen=dots.believed)
        return refine_robustly(weighed, views, self.rig, self.obj, self.image_spread, sigma=typical)

    def _places(self, guess: Prediction) -> Tensor:
        """Predicted positions of the dots: (B, C, N, 2), finite."""
        size = self.options.image.size
        radius = None if self.obj.radius is None else self.obj.radius.to(self.points)
        uv = guess.rig.project(guess.rig_from_object.apply(self.points), radius).uv
        return uv.nan_to_num(size / 2).clamp(-FARTHEST * size, FARTHEST * size)

    def measure(self, images: Tensor, uv: Tensor, present: Tensor, colour: Tensor, light: Tensor, steps: int) -> Dots:
        """Fit dots of given colours near given places, and flag the ones to believe.

        Args:
            images: (B, C, 3, H, W).
            uv: (B, C, N, 2) expected positions.
            present: (B, C, N) bool: dots that are present.
            colour: (B, C, N) the fiducial whose colour each has; unique among the present dots.
            light: (B, C), see `Dots`.
            steps: near steps.
        """
        options, size = self.options, self.options.image.size
        batch = uv.shape[:2]
        painted, there = uv.clone(), torch.zeros_like(present)  # in the order of the colours
        place = present.nonzero(as_tuple=True)
        paint = (*place[:2], colour[place])
        painted[paint], there[paint] = uv[place], True
        fit = self._take_near_steps(images.flatten(0, 1), painted.flatten(0, 1), there.flatten(0, 1), steps)
        uv, variance, mean_square = (
            part.unflatten(0, batch).gather(
                2, colour.view(*colour.shape, *[1] * (part.ndim - 2)).expand(*colour.shape, *part.shape[2:])
            )
            for part in (fit.uv, fit.variance, fit.mean_square)
        )
        noise = mean_square.clamp_min((options.noise / GREY_LEVELS) ** 2)
        sigma = (variance * noise + (options.position_noise * self.unit) ** 2).sqrt()
        inside = ((uv > -0.5) & (uv < size - 0.5)).all(-1)
        explained = mean_square < (options.most_residual / GREY_LEVELS) ** 2
        return Dots(uv, sigma, present & inside & explained & sigma.isfinite(), light, colour)

    def _take_blurred_steps(self, flat: Tensor, uv: Tensor, blurs: tuple[float, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """Take blurred steps: places (M, N, 2), amplitudes (M, N) and the light of each image (M,)."""
        options, pool = self.options, self.options.pooling
        pieces = flat.split(_chunk(flat, flat.shape[1:].numel()))
        pooled, dot = torch.cat([_pool(some, pool) for some in pieces]), options.image.dot / pool
        shift, amplitude = options.shift.scale(1 / pool), uv.new_ones(uv.shape[:-1])
        near = ((uv + 0.5) / pool - 0.5).to(self.colours)
        for blur in blurs:
            step, amplitude = take_blurred_step(pooled, near, self.colours, dot, blur / pool, shift, options.trust)
            near = near + step
        dark = (1 + options.noise) / GREY_LEVELS  # clipped noise is biased and adds up over a black image
        light = torch.where(pooled > dark, pooled, 0.0).sum((1, 2, 3))
        return (near.to(uv) + 0.5) * pool - 0.5, amplitude, light / (2 * math.pi * dot**2)

    def _take_near_steps(self, flat: Tensor, uv: Tensor, present: Tensor, steps: int) -> NearFit:
        """Take near steps, with as many images at a time as memory for their temporaries allows."""
        count = _chunk(flat, self.colours.numel() * len(self.colours) * FLOATS_A_PAIR)
        parts = zip(flat.split(count), uv.split(count), present.split(count), strict=True)
        dot = self.options.image.dot
        fits = [DotWindows(some, at, self.colours, dot).fit(at, there, steps) for some, at, there in parts]
        return fits[0] if len(fits) == 1 else NearFit(*(torch.cat(column) for column in zip(*fits, strict=True)))

    def solve(self, dots: Dots, guess: Prediction) -> Estimate:
        """Fit the rig (in image pixels) to the dots; `converged` where images and prior confirm it."""
        result = estimate(
            Observations(dots.uv.unsqueeze(1), dots.sigma.unsqueeze(1), dots.believed.unsqueeze(1)),
            self.rig,
            self.obj,
            guess.rig_from_object.reshape(-1, 1),
            prior_std=self.image_spread,
            initial_rig=guess.rig,
            options=self.options.estimation,
        )
        brightness = self.colours.sum(-1)
        # Saturation and borders can only reduce it.
        stray = dots.light - (dots.believed * brightness[dots.colour]).sum(-1)
        explained = (stray < PRESENT * brightness.min()).all(-1) & (result.chi2_per_dof < self.options.most_chi2)
        return replace(result, converged=result.converged & explained)

    def on_sensor(self, result: Estimate, dots: Dots) -> tuple[Estimate, Observations]:
        """Convert an estimate in image pixels, and its observations, to sensor pixels."""
        observations = Observations(
            self.options.image.to_sensor(dots.uv, self.factory.image_size).unsqueeze(1),
            (dots.sigma / self.unit).unsqueeze(1),
            dots.believed.unsqueeze(1),
        )
        sensor = replace(
            result,
            rig=result.rig.resized(self.factory.image_size),
            residual=result.residual / self.scale[:, None],
            problem=make_problem(observations, self.factory, self.obj, self.prior_std),
        )
        return sensor, observations


def _chunk(images: Tensor, floats: int) -> int:
    """Number of images to process at a time, where each needs `floats` floats."""
    return max(1, CHUNK.get(images.device.type, CHUNK["cuda"]) // floats)


def _pool(images: Tensor, pool: int) -> Tensor:
    """Mean over squares of pixels: (M, K, H, W) -> (M, K, H / pool, W / pool), float32."""
    rows = images[:, :, ::pool].float()
    for row in range(1, pool):  # slices: several times faster than a sum over a short axis
        rows = rows + images[:, :, row::pool].float()
    width = images.shape[-1]
    average = torch.eye(width // pool, device=images.device).repeat_interleave(pool, 0) / pool**2
    return rows @ average


def _check(images: Tensor, factory: CameraRig, options: ImageRefinementOptions) -> None:
    size = options.image.size
    if size % options.pooling:
        raise InputError(f"image size: found {size}, expected a multiple of the {options.pooling} pixels of pooling")
    if images.ndim != 5 or images.shape[1:] != (factory.num_cameras, 3, size, size):
        raise InputError(
            f"images: found shape {tuple(images.shape)}, expected (rigs, {factory.num_cameras}, 3, {size}, {size})"
        )


def colours_at(images: Tensor, uv: Tensor, dot: float) -> Tensor:
    """Solve for the colours of dots at given places that reproduce an image, by linear least squares.

    Args:
        images: (M, K, H, W), square.
        uv: (M, N, 2) pixels, finite.
        dot: standard deviation of a dot, pixels.

    Returns:
        (M, N, K), about 0 where the image has no dot.
    """
    size = images.shape[-1]
    value, _ = profile_and_slope(uv.mT, dot, size)  # (M, 2 axes, N, size)
    value = value.to(torch.float32)
    overlap = (value @ value.mT).prod(1)  # (M, N, N)
    across, down = value.unbind(1)  # (M, N, size)
    seen = torch.einsum("mkhn,mnh->mnk", images.float() @ across.mT[:, None], down)
    weight = overlap.diagonal(dim1=1, dim2=2)
    return torch.linalg.solve(overlap + torch.diag_embed(RIDGE * weight + (weight == 0)), (1 + RIDGE) * seen)


def find_swapped_labels(found: Tensor, colours: Tensor, fits: Tensor) -> Tensor:
    """Find the fiducial whose colour appears at each fiducial's place.

    Args:
        found: (*B, N, K) colours at the places.
        colours: (N, K) of the fiducials.
        fits: (*B, N) bool: places that are known to have their own colour; that colour is not assigned elsewhere.

    Returns:
        (*B, N) indices of fiducials, each at most once; -1 where no fiducial matches.
    """
    own = torch.arange(len(colours), device=found.device)
    difference = (found.unsqueeze(-2) - colours.to(found)).norm(dim=-1)  # (*B, N places, N colours)
    difference = difference.masked_fill(fits.unsqueeze(-1) | fits.unsqueeze(-2), torch.inf)
    nearest, colour, mutual = mutual_nearest(difference)
    named = torch.where(mutual & (nearest < MOST_DIFFERENCE), colour, -1)
    return torch.where(fits, own, named)
