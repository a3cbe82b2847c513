"""Calibration without a factory calibration from one moving light, or from several unknown markers.

Images that show one moving blob place the cameras; with the rig that they give, all other blobs are put together, and
moments and cameras that took no part must agree, as with a factory calibration. The rig has no scale until somebody
gives the distance of two cameras.

A stick places cameras in the same way, by the middle of its markers in images that show nothing else: that is right to
some pixels. Its length gives the scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Lights, PipelineOptions, associate_lights, background_rows
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import cold_start_from_points, move_to_pair_frame, prior_of_pair
from imgcal.geometry import RigidTransform
from imgcal.messages import plural
from imgcal.pipeline.calibration import Calibration
from imgcal.pipeline.fitting import fit_lights
from imgcal.pipeline.lights import (
    AFTER_ALIGNMENT,
    NOTHING,
    Agreement,
    FoundLights,
    even_error,
    measure_agreement,
    narrow,
    require_agreement,
    rows_of_lights,
    split_moments,
)
from imgcal.pipeline.scale import KnownDistance
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, RigPrior

WIDE_ROTATION, WIDE_POSITION = 0.2, 0.2
"""Prior about a first rig that came from the same data: rad, and share of the largest distance."""
LARGEST_FOCAL_STD, LARGEST_ROTATION_STD, LARGEST_POSITION_STD = 0.08, 0.06, 0.1
"""Maximum uncertainty of a result: relative, rad, and share of the largest distance between cameras. The direction of a
long lens and its principal point are almost interchangeable: 30 px act like 0.025 rad."""
LEAST_ALONE = 24
"""Moments at which two cameras see the target alone."""
ALIKE = 0.02
"""Relative: by how much lengths of a stick may differ that give the same scale."""
LEAST_SHARE, LEAST_LEAD = 0.5, 1.3
"""Of the moments with two markers: those that must show the stick with the same scale, and how many times as many as
with the next best scale."""


@dataclass(frozen=True)
class PlacedCameras:
    """Cameras that blobs have placed, up to scale."""

    rig: CameraRig
    pair: tuple[int, int]  # cameras that are 1000 mm apart
    moving: Detections  # blobs that are no background
    background: NDArray[np.bool_]  # of all blobs: those that never move in their image
    agreement: Agreement  # of moments and cameras that took no part


def check_distance(distance: tuple[str, str, float], cameras: CameraRig) -> KnownDistance:
    """Validate a given distance between two cameras.

    Raises:
        InputError: an unknown camera, the same camera twice, or an invalid length.
    """
    first, second, length = distance
    for name in (first, second):
        if name not in cameras.camera_names:
            raise InputError(f"distance: found camera {name:.80}, expected one of {', '.join(cameras.camera_names)}")
    if first == second or not 1.0 <= length <= 1e6:
        raise InputError(
            f"distance: found {first} {second} {length:g}, expected two different cameras and their distance, 1 to "
            "1e6 mm"
        )
    return KnownDistance(first, second, float(length), is_given=True)


def calibrate_lights_from_scratch(
    detections: Detections,
    cameras: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    distance: tuple[str, str, float] | None = None,
) -> Calibration:
    """Do what `calibrate_from_scratch` does, for unknown markers.

    Args:
        detections: blobs; labels are ignored.
        cameras: images and rough lenses, with a prior, float64.
        obj: one point.
        options: how certain the result must be.
        distance: names of two cameras and their distance, mm; None = the rig is known up to scale.

    Returns:
        The rig in a frame with the first of the two cameras at the origin, and the second one on the x axis.

    Raises:
        RefusedError: the blobs are not sufficient.
        InputError: the distance is invalid.
    """
    known = None if distance is None else check_distance(distance, cameras)
    names = cameras.camera_names
    pair = None if known is None else (names.index(known.first), names.index(known.second))
    placed_cameras = place_cameras(detections, cameras, obj, pair)
    moving, background, pair = placed_cameras.moving, placed_cameras.background, placed_cameras.pair
    if known is None:
        known = KnownDistance(names[pair[0]], names[pair[1]], 1000.0, is_given=False)
    first = _scale(placed_cameras.rig, known.length / 1000.0)
    found = associate_lights(moving, first, even_error(first))
    lights = FoundLights(
        rows_of_lights(found, moving),
        detections,
        np.flatnonzero(~background)[found.row[found.row >= 0]],
        background,
        placed_cameras.agreement,
        starts=1,
    )
    assert cameras.prior is not None
    placed = replace(first, prior=_prior(first, cameras.prior))
    std = _wide_prior_std(first, pair, cameras.prior)
    fit = replace(fit_lights(lights, placed, obj, options, std), distance=known)
    _require_determined(fit, pair[0])
    return fit


def place_cameras(
    detections: Detections, cameras: CameraRig, obj: CalibrationObject, pair: tuple[int, int] | None = None
) -> PlacedCameras:
    """Place cameras by images that show the target alone, and prove the result by moments that took no part.

    Args:
        detections: blobs; labels are not looked at.
        cameras: images and rough lenses, with a prior, float64.
        obj: a light, or a stick.
        pair: the cameras that are put 1000 mm apart; None = the first, and the one that is farthest from it.

    Raises:
        RefusedError: the blobs cannot decide.
    """
    background = background_rows(detections)
    moving = detections.select(~background)
    learnt, tested = split_moments(moving)
    assert cameras.prior is not None
    start = cold_start_from_points(_pair_observations(learnt, cameras, obj.num_fiducials), cameras, pair)
    error = max(AFTER_ALIGNMENT * start.spread, 1.0)
    error = min(error, AFTER_ALIGNMENT) if obj.num_fiducials == 1 else error  # markers of a stick are far apart
    light, std = CalibrationObject.unknown(obj.name), _wide_prior_std(start.rig, start.pair, cameras.prior)
    trial = narrow(learnt, start.rig, std, start.rig, light, error, joined=0)
    if trial is None:
        raise RefusedError(NOTHING)
    agreement = measure_agreement(tested, trial)
    require_agreement(agreement, trial)
    return PlacedCameras(move_to_pair_frame(trial, start.pair)[0], start.pair, moving, background, agreement)


def place_by_stick(detections: Detections, cameras: CameraRig, obj: CalibrationObject) -> CameraRig:
    """Make a first rig from a stick that was moved around; its frame is that of the first camera.

    Args:
        detections: blobs; labels are not looked at.
        cameras: images and rough lenses, with a prior, float64.
        obj: two fiducials or more, on one line.

    Raises:
        RefusedError: the blobs cannot decide.
    """
    placed = place_cameras(detections, cameras, obj)
    found = associate_lights(placed.moving, placed.rig, even_error(placed.rig))
    rig = _scale(placed.rig, _scale_of_stick(found, obj))
    first = rig.cam_from_rig[0].inverse()
    return replace(rig, cam_from_rig=rig.cam_from_rig @ first)


def _scale_of_stick(lights: Lights, obj: CalibrationObject) -> float:
    """By how much places must grow for most moments to show markers at the stick's distances.

    Raises:
        RefusedError: two scales are as good, or none.
    """
    lengths = torch.pdist(obj.points.double()).numpy()
    order = np.argsort(lights.moment, kind="stable")
    logs, moments = [], 0
    for rows in np.split(order, np.flatnonzero(np.diff(lights.moment[order])) + 1):
        apart = [float(np.linalg.norm(lights.point[a] - lights.point[b])) for a, b in combinations(rows, 2)]
        logs += [np.log(length / distance) for distance in apart for length in lengths if distance > 0]
        moments += len(rows) > 1
    sizes = np.sort(np.array(logs))
    count = np.searchsorted(sizes, sizes + ALIKE) - np.arange(len(sizes))
    if moments:
        best = int(count.argmax())
        away = np.abs(sizes - sizes[best]) > 2 * ALIKE
        lead = count[best] / max(int(count[away].max(initial=0)), 1)
        if count[best] >= LEAST_SHARE * moments and lead >= LEAST_LEAD:
            return float(np.exp(np.median(sizes[best : best + count[best]])))
    raise RefusedError(
        f"start without a factory calibration: of {moments} snapshots with two markers, too few show them at the "
        f"distances of {obj.name}: is the object's file right, and does nothing else move?"
    )


def _pair_observations(detections: Detections, cameras: CameraRig, markers: int) -> Observations:
    """The middle of the blobs in images that show as many as the target has, where two cameras do.

    Raises:
        RefusedError: there are too few.
    """
    moments, count = len(detections.snapshot_names), cameras.num_cameras
    rows = np.flatnonzero(detections.usable)
    image = detections.snapshot[rows] * count + detections.camera[rows]
    alone = rows[np.bincount(image, minlength=moments * count)[image] == markers]
    uv, sigma, seen = (
        np.zeros((moments, count, 1, 2)),
        np.ones((moments, count, 1)),
        np.zeros((moments, count, 1), bool),
    )
    at = detections.snapshot[alone], detections.camera[alone], np.zeros(len(alone), dtype=np.int64)
    np.add.at(uv, at, detections.uv[alone] / markers)
    sigma[at], seen[at] = detections.sigma[alone], True
    kept: NDArray[np.bool_] = seen.sum((1, 2)) >= 2
    if kept.sum() < LEAST_ALONE:
        raise RefusedError(
            f"start without a factory calibration: found {plural(int(kept.sum()), 'snapshot')} in which two cameras "
            f"see {'one moving blob' if markers == 1 else f'{markers} moving blobs'} each, expected at least "
            f"{LEAST_ALONE}: carry one {'light' if markers == 1 else 'stick'} alone through what the cameras see"
        )
    return Observations(*(torch.from_numpy(column[kept]) for column in (uv, sigma, seen)))


def _scale(rig: CameraRig, factor: float) -> CameraRig:
    placed = RigidTransform(rig.cam_from_rig.rotation, factor * rig.cam_from_rig.translation)
    return replace(rig, cam_from_rig=placed)


def _rig_extent(rig: CameraRig) -> float:
    """Largest distance between two cameras, mm."""
    return float(torch.cdist(rig.positions, rig.positions).max())


def _prior(rig: CameraRig, lenses: RigPrior) -> RigPrior:
    return replace(lenses, rotation=WIDE_ROTATION, position=WIDE_POSITION * _rig_extent(rig))


def _wide_prior_std(rig: CameraRig, pair: tuple[int, int], lenses: RigPrior) -> torch.Tensor:
    return prior_of_pair(rig, pair, lenses, WIDE_ROTATION, WIDE_POSITION * _rig_extent(rig))


def _require_determined(fit: Calibration, reference: int) -> None:
    """Raise `RefusedError` if a camera is known so badly that the result would be a guess."""
    rig = fit.rig
    std = fit.estimate.covariance(reference).diagonal().clamp_min(0).sqrt().unflatten(0, (rig.num_cameras, -1))
    relative = torch.stack(
        (
            (std[:, 6:8] / rig.focal_length).amax(1) / LARGEST_FOCAL_STD,
            std[:, 0:3].amax(1) / LARGEST_ROTATION_STD,
            std[:, 3:6].amax(1) / (LARGEST_POSITION_STD * _rig_extent(rig)),
        )
    )
    if bool((relative <= 1).all()):
        return
    kind, camera = divmod(int(relative.nan_to_num(torch.inf).argmax()), rig.num_cameras)
    what = ("focal length", "direction", "position")[kind]
    raise RefusedError(
        f"start without a factory calibration: the data say too little about the {what} of camera "
        f"{rig.camera_names[camera]}: carry the light through more of its view, nearer and farther"
    )
