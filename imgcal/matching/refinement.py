"""From a pose that agrees with the maps to measured fiducials: alternates fits of rig and pose with measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import lattice_shifts
from imgcal.detection import Frame
from imgcal.estimation import Estimate, EstimationOptions, estimate
from imgcal.geometry import RigidTransform
from imgcal.matching.camera_threads import each_camera
from imgcal.matching.correlation import BLIND, gain_at, gains
from imgcal.matching.maps import SIZES, Maps
from imgcal.matching.marker_fit import MISFIT, NEAR
from imgcal.matching.photometry import Measured, measure_markers
from imgcal.matching.poses import Ranked, Scene
from imgcal.types import CameraRig, Observations

ROBUST = EstimationOptions(loss="cauchy", threshold=2.0, max_iterations=30, tolerance=1e-2)
SURE = 6.0  # log odds from which a camera certainly shows the object where the maps suggest
SURPRISED = 4.0  # surprise from which a cell may be a marker
LEAST_IN_CAMERA = 3  # smallest number of fitting fiducials for a camera to count
OUTLIER = 5.0  # standard deviations beyond which a measured marker is an outlier
SHAPE_ERROR = 0.3  # px: error of a measured position beyond its own sigma
MOST_STEPS = 4  # most steps of a lattice by which a camera's image may be shifted
LEAST_FITTED = 6  # fiducials in all cameras together
GATES = (8.0, 2.5)  # px between a measurement and the fitted rig, in the first and second round
ITERATIONS = ((len(MISFIT), NEAR), (NEAR,))  # see `measure_markers`: fewer when positions are already close


@dataclass(frozen=True)
class Fitted:
    """Rig and pose, with the measurement of each fiducial."""

    rig: CameraRig
    rig_from_object: RigidTransform
    uv: NDArray[np.float64]  # (C, N, 2) pixels
    sigma: NDArray[np.float64]  # (C, N) pixels
    radius: NDArray[np.float64]  # (C, N) pixels
    seen: NDArray[np.bool_]  # (C, N)
    predicted: NDArray[np.float64]  # (C, N, 2) pixels, predicted by rig and pose

    def log_odds(self, scene: Scene, maps: Maps) -> float:
        """Log odds of the fiducials' predicted places in the maps, against no object.

        Images are no longer shifted. The fit costs the log of each camera's prior area of the image shift.
        """
        there = gain_at(maps, gains(maps), self.predicted)
        cost = np.log(np.maximum(2 * np.pi * (scene.drift / maps.factor) ** 2, 1.0))
        return float(np.log(BLIND + (1 - BLIND) * np.exp(there - cost)).sum())


def fit_and_measure(
    scene: Scene,
    found: Ranked,
    maps: Maps,
    response: NDArray[np.float32],
    frames: Sequence[Frame | None],
    dark: bool,
) -> Fitted | None:
    """Fit and measure, with increasing accuracy; None = too few markers are left.

    Args:
        scene: the inputs of the search.
        found: one pose.
        maps: the fine maps.
        response: (C, sizes, H, W) from `surprise_maps`.
        frames: of each camera.
        dark: markers are darker than their surroundings.
    """
    pose = found.poses[0]
    predicted = predictions(scene.rig, scene, pose) + found.scores.shift[0][:, None]
    sure = (found.scores.log_odds[0] > SURE)[:, None]
    reach = max(2, round(0.15 * spacing(predicted) / maps.factor))
    fit = _fit_peaks(scene, pose, maps, predicted, (reach, 2), sure)
    uv = np.full(predicted.shape, np.nan)
    for gate, iterations in zip(GATES, ITERATIONS, strict=True):
        fit = _align_lattice(scene, fit, maps)
        if fit is None:
            return None
        pose, predicted = fit.rig_from_object[0], predictions(fit.rig, scene, fit.rig_from_object[0])
        # A measurement that agrees with the fitted rig is a better start than the prediction.
        there = np.linalg.norm(uv - predicted, axis=-1, keepdims=True) < gate
        expected = np.where(there, uv, predicted)
        markers = _measure(scene, fit, expected, maps, response, frames, dark, iterations)
        uv, sigma = np.stack([m.uv for m in markers]), np.stack([m.sigma for m in markers])
        off = np.linalg.norm(np.nan_to_num(uv) - predicted, axis=-1)
        near = off < np.hypot(gate, OUTLIER * np.minimum(sigma, 3.0))
        seen = _drop_weak_cameras(np.stack([m.seen for m in markers]) & near)
        fit = _fit(scene, pose, uv, np.hypot(sigma, SHAPE_ERROR), seen)
    if fit is None:
        return None
    pose, predicted = fit.rig_from_object[0], predictions(fit.rig, scene, fit.rig_from_object[0])
    radius = np.stack([np.full(len(m.sigma), m.radius) for m in markers])
    off = np.linalg.norm(np.nan_to_num(uv) - predicted, axis=-1)
    seen = _drop_weak_cameras(seen & (off < OUTLIER * np.hypot(sigma, SHAPE_ERROR)))
    return Fitted(fit.rig, pose, uv, sigma, radius, seen, predicted)


def predictions(rig: CameraRig, scene: Scene, pose: RigidTransform) -> NDArray[np.float64]:
    """Pixels of all fiducials: (C, N, 2)."""
    points = pose.apply(scene.obj.points.to(rig.focal_length))
    return rig.project_values(points, scene.obj.radius).uv.numpy()


def spacing(uv: NDArray[np.float64]) -> float:
    """Median distance (px) from a fiducial's image (C, N, 2) to its nearest neighbour."""
    gaps = np.linalg.norm(uv[:, :, None] - uv[:, None], axis=-1)
    gaps[:, np.arange(uv.shape[1]), np.arange(uv.shape[1])] = np.inf
    return float(np.median(gaps.min(-1)))


def _drop_weak_cameras(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop cameras in which only a few fiducials (C, N) fit, because that may be chance."""
    return seen & (seen.sum(1, keepdims=True) >= LEAST_IN_CAMERA)


def _peaks(maps: Maps, predicted: NDArray[np.float64], cells: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Find the most surprising place within `cells` cells of each prediction (C, N, 2), with subcell accuracy."""
    count, height, width = maps.surprise.shape
    middle = np.floor(maps.cells(predicted)).astype(np.int64)
    inside = ((middle >= 0) & (middle < maps.size[:, None])).all(-1)
    steps = np.arange(-cells, cells + 1)
    dv, du = (x.ravel() for x in np.meshgrid(steps, steps, indexing="ij"))
    near = np.hypot(du, dv) <= cells + 0.5
    du, dv = du[near], dv[near]
    columns = np.clip(middle[..., 0, None] + du, 0, width - 1)
    rows = np.clip(middle[..., 1, None] + dv, 0, height - 1)
    values = maps.surprise[np.arange(count)[:, None, None], rows, columns]  # (C, N, K)
    # Surprise is capped, so maps have plateaus: average over them, with weights that favour the prediction.
    peak = values.max(-1, keepdims=True)
    weight = np.exp(4 * (values - peak)) * np.exp(-(du**2 + dv**2) / (2 * cells**2))
    place = np.stack(((weight * columns).sum(-1), (weight * rows).sum(-1)), -1) / weight.sum(-1, keepdims=True)
    return maps.pixels(place + 0.5), inside & (peak[..., 0] > SURPRISED)


def _fit_peaks(
    scene: Scene,
    pose: RigidTransform,
    maps: Maps,
    predicted: NDArray[np.float64],
    reaches: Sequence[int],
    sure: NDArray[np.bool_],
) -> Estimate | None:
    """Fit to the most surprising places near predictions (C, N, 2), ever closer, first in `sure` (C, 1) cameras."""
    fit: Estimate | None = None
    for cells in reaches:
        uv, seen = _peaks(maps, predicted, cells)
        fit = _fit(scene, pose, uv, np.full(seen.shape, 0.4 * maps.factor * cells), seen & sure)
        if fit is None:
            break
        pose, predicted = fit.rig_from_object[0], predictions(fit.rig, scene, fit.rig_from_object[0])
        sure = np.ones_like(sure)
    return fit


def _align_lattice(scene: Scene, fit: Estimate | None, maps: Maps) -> Estimate | None:
    """Shift the pattern in each camera by lattice steps that match more of it, and fit again.

    A camera whose image is off by one dot matches all but the edge, until rig and pose are fitted.
    """
    motions = lattice_shifts(scene.obj)
    if not motions or fit is None:
        return fit
    steps = [RigidTransform(torch.from_numpy(m.rotation), torch.from_numpy(m.translation)) for m in motions]
    gain = gains(maps)
    for _ in range(MOST_STEPS):
        pose = fit.rig_from_object[0]
        shifted = np.stack([predictions(fit.rig, scene, at) for at in (pose, *(pose @ step for step in steps))])
        best = np.stack([gain_at(maps, gain, uv) for uv in shifted]).argmax(0)  # (C,)
        if not best.any():
            break
        predicted = shifted[best, np.arange(len(best))]
        again = _fit_peaks(scene, pose, maps, predicted, (2,), np.ones((len(best), 1), dtype=bool))
        if again is None:
            break
        fit = again
    return fit


def _fit(
    scene: Scene, pose: RigidTransform, uv: NDArray[np.float64], sigma: NDArray[np.float64], seen: NDArray[np.bool_]
) -> Estimate | None:
    """Fit rig and pose to places (C, N, 2); None = too few."""
    if seen.sum() < LEAST_FITTED:
        return None
    observations = Observations(
        torch.from_numpy(np.where(seen[..., None], uv, 0.0))[None],
        torch.from_numpy(np.where(seen, sigma, 1.0))[None],
        torch.from_numpy(seen)[None],
    )
    fit = estimate(observations, scene.rig, scene.obj.as_exact(), pose[None], prior_std=scene.std, options=ROBUST)
    return fit if bool(fit.rig_from_object.translation.isfinite().all()) else None


def _measure(
    scene: Scene,
    fit: Estimate,
    expected: NDArray[np.float64],
    maps: Maps,
    response: NDArray[np.float32],
    frames: Sequence[Frame | None],
    dark: bool,
    iterations: tuple[int, ...],
) -> list[Measured]:
    """Measure the markers of all cameras near their expected places (C, N, 2)."""
    points = fit.rig_from_object.apply(scene.obj.points.to(scene.rig.focal_length))  # (1, N, 3)
    depth = fit.rig.project_values(points[0]).depth.numpy()
    focal = scene.rig.focal_length.mean(-1).numpy()[:, None]
    per_mm = focal / np.maximum(depth, 1.0)
    given = scene.obj.radius
    high = np.array(response.shape[-1:-3:-1]) - 1
    cells = np.floor(maps.cells(expected)).clip(0, high).astype(np.int64)
    # Sizes as they appear: blur makes markers larger in the images.
    shown = response[np.arange(len(frames))[:, None], :, cells[..., 1], cells[..., 0]]  # (C, N, sizes)
    seen = np.maximum(0.5, 1.6 * np.array(SIZES)[np.median(shown, axis=1).argmax(-1)]) * maps.factor
    radius = per_mm * (np.ones(scene.obj.num_fiducials) if given is None else given.numpy())  # (C, N)
    usual = np.median(radius, axis=1)
    radius *= np.where((given is None) | (seen > usual), seen / usual, 1.0)[:, None]
    sure = np.ones(radius.shape[1], dtype=bool)

    def measure(camera: int) -> Measured:
        frame = frames[camera]
        if frame is None:
            none = np.zeros(len(sure))
            return Measured(np.full((len(sure), 2), np.nan), none + np.inf, none, none, 1.0, none)
        return measure_markers(frame, expected[camera], radius[camera], dark, sure, iterations)

    return each_camera(measure, range(len(frames)))
