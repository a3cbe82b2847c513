"""Calibration without a factory calibration from one moving light, or from several unknown markers.

Images of a single moving blob place the cameras. With the resulting rig all other blobs are associated, and held-out
moments and cameras must agree, as with a factory calibration. The rig has no scale until the distance between two
cameras is given.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import PipelineOptions, associate_lights, background_rows
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import cold_start_from_points, move_to_pair_frame, prior_of_pair
from imgcal.geometry import RigidTransform
from imgcal.pipeline.calibration import Calibration
from imgcal.pipeline.fitting import fit_steady
from imgcal.pipeline.lights import (
    AFTER_ALIGNMENT,
    NOTHING,
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
"""Minimum number of moments at which two cameras see one moving blob each."""


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
    background = background_rows(detections)
    moving = detections.select(~background)
    learnt, tested = split_moments(moving)
    assert cameras.prior is not None
    start = cold_start_from_points(_pair_observations(learnt, cameras), cameras, pair)
    first, pair = start.rig, start.pair
    error = min(max(AFTER_ALIGNMENT * start.spread, 1.0), AFTER_ALIGNMENT)
    trial = narrow(learnt, first, _wide(first, pair, cameras.prior), first, obj, error, joined=0)
    if trial is None:
        raise RefusedError(NOTHING)
    agreement = measure_agreement(tested, trial)
    require_agreement(agreement, trial)
    if known is None:
        known = KnownDistance(names[pair[0]], names[pair[1]], 1000.0, is_given=False)
    first = _scale(move_to_pair_frame(trial, pair)[0], known.length / 1000.0)
    found = associate_lights(moving, first, even_error(first))
    lights = FoundLights(
        rows_of_lights(found, moving, first),
        detections,
        np.flatnonzero(~background)[found.row[found.row >= 0]],
        background,
        agreement,
        starts=1,
    )
    placed = replace(first, prior=_prior(first, cameras.prior))
    std = _wide(first, pair, cameras.prior)
    fit = fit_steady(lights.labelled, lights.labelled.detections, placed, obj, options, prior_std=std)
    fit = replace(fit, lights=lights, distance=known)
    _require_determined(fit, pair[0])
    return fit


def _pair_observations(detections: Detections, cameras: CameraRig) -> Observations:
    """Images with a single usable blob, for the moments that have two such images.

    Raises:
        RefusedError: there are too few.
    """
    moments, count = len(detections.snapshot_names), cameras.num_cameras
    rows = np.flatnonzero(detections.usable)
    image = detections.snapshot[rows] * count + detections.camera[rows]
    alone = rows[np.bincount(image, minlength=moments * count)[image] == 1]
    uv, sigma, seen = (
        np.zeros((moments, count, 1, 2)),
        np.ones((moments, count, 1)),
        np.zeros((moments, count, 1), bool),
    )
    at = detections.snapshot[alone], detections.camera[alone], np.zeros(len(alone), dtype=np.int64)
    uv[at], sigma[at], seen[at] = detections.uv[alone], detections.sigma[alone], True
    kept: NDArray[np.bool_] = seen.sum((1, 2)) >= 2
    if kept.sum() < LEAST_ALONE:
        raise RefusedError(
            f"start without a factory calibration: found {int(kept.sum())} snapshots in which two cameras see one "
            f"moving blob each, expected at least {LEAST_ALONE}: carry one light alone through what the cameras see"
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


def _wide(rig: CameraRig, pair: tuple[int, int], lenses: RigPrior) -> torch.Tensor:
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
