"""Calibration without a factory calibration: a first rig from the data, then the usual estimate.

If the input has no labels, the first ones come from single images: in most of them, a camera's view of the object alone
shows which blob is which fiducial. Cameras placed by these labels then vote on all the rest.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import (
    Associations,
    PipelineOptions,
    Progress,
    associate,
    identify,
    is_small_planar,
    label_by_shape,
    to_observations,
)
from imgcal.detection import DetectionOptions
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import K3, ColdStart, cold_start, ordinary_lens
from imgcal.messages import list_names, plural
from imgcal.pipeline.board_turns import require_one_turn
from imgcal.pipeline.calibration import Calibration
from imgcal.pipeline.fitting import fit_since_last_move
from imgcal.pipeline.late_cameras import find_late_cameras, require_same_moments
from imgcal.pipeline.lights_from_scratch import calibrate_lights_from_scratch, place_by_stick
from imgcal.pipeline.partial_labels import name_missing_labels
from imgcal.pipeline.recalibration import fit_with_timing, label_again
from imgcal.pipeline.repeats import drop_repeats, name_repeats
from imgcal.pipeline.sources import Frames, as_unknown_marker, find_blobs
from imgcal.pipeline.units import UNSOLVABLE, require_solvable, require_units
from imgcal.types import CalibrationObject, CameraRig, ConvexVolume, Detections, RigPrior

ALONE = RigPrior(focal_length=0.05, principal_point=10.0, distortion=0.02, rotation=0.01, position=10.0)
"""How far a camera may be off while its images are labelled one by one, as far as this distorts the object's shape."""
LEAST_BLOBS = 4
LABELLED_ALONE = 12
"""Number of snapshots per camera that are labelled image by image."""
MOST_ODD, LIKELY_ODD = 8, 1
"""Difference between the numbers of blobs and fiducials: where to clip it, and up to which an image is easy."""
PLACED = RigPrior(focal_length=0.005, principal_point=5.0, distortion=0.02, rotation=0.004, position=10.0)
"""Prior of a rig made from these labels, for labelling all the others."""
WIDE_ROTATION = 0.05  # rad: prior about the first rig, which came from the same data: nearly flat
WIDE_POSITION = 0.05  # the same as a share of the largest distance between cameras
FARTHEST_CENTRE = 5.0
"""Maximum offset of a lens's principal point, in prior standard deviations."""
LARGEST_FOCAL_STD = 0.02  # relative
LARGEST_ROTATION_STD = 0.01  # rad
LARGEST_POSITION_STD = 0.02  # share of the largest distance between cameras
LARGEST_SPREAD = 2.0  # px, robust, of the first rig's residuals


def calibrate_from_scratch(
    source: Detections | Frames,
    cameras: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    *,
    detection: DetectionOptions = DetectionOptions(),
    progress: Progress | None = None,
    distance: tuple[str, str, float] | None = None,
) -> Calibration:
    """Calibrate cameras from images and rough focal lengths alone.

    The object is moved through the cameras' common view; its known size gives the scale, and the rig's frame is that of
    the first camera.

    Args:
        source: blobs, labelled or not, or frames in memory.
        cameras: from `imgcal.formats.load_cameras`; a rig's places and its prior for them are not looked at.
        obj: the calibration object: a body, a stick, or a light.
        options: how sure the result must be.
        detection: how blobs are found in frames.
        progress: wraps loops over snapshots.
        distance: of a light or unknown markers: names of two cameras and their distance, mm; None = the rig is known up
            to scale. Its frame has the first of these in the origin, and the second on the x axis.

    Returns:
        As for `calibrate`; its `factory` is the first rig made from the data.

    Raises:
        RefusedError: the data do not determine the cameras' poses, or say too little about the cameras.
        InputError: the data do not belong to these cameras or this object.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import simulate_volume, true_detections
        >>> rig, wand = imgcal.load_rig("room10").select([0, 2, 5]), imgcal.load_object("wand4")
        >>> seen = true_detections(simulate_volume(rig, wand, 40, torch.Generator().manual_seed(0), None))
        >>> found = calibrate_from_scratch(seen, rig, wand).rig
        >>> apart = (found.positions[1] - found.positions[0]).norm(), (rig.positions[1] - rig.positions[0]).norm()
        >>> abs(float(apart[0] - apart[1])) < 1  # mm
        True
    """
    if distance is not None and obj.pose_rank > 3:
        raise InputError("distance: found an object of known size, which sets the scale; expected unknown markers")
    if obj.parts:
        obj.require_rigid("to calibrate without a factory calibration")
    started, cameras, options = time.perf_counter(), _set_prior(cameras), options.of_object(obj)
    blobs = find_blobs(source, cameras, obj, detection)
    detections, repeats = drop_repeats(blobs)
    if obj.pose_rank == 3:
        detections, obj = _marker_alone(detections, obj)
        found = time.perf_counter()
        with require_solvable():
            fit = fit_since_last_move(
                lambda some: calibrate_lights_from_scratch(some, cameras, obj, options, distance), detections, options
            )
        seconds = {"detection": found - started, "estimation": time.perf_counter() - found}
        return _complete_rig(replace(fit, repeats=repeats), cameras, seconds)
    require_one_turn(cameras, obj)
    found = time.perf_counter()
    is_labelled, is_stick = (detections.fiducial >= 0).any(), obj.pose_rank == 5
    alone = detections if is_labelled or is_stick else label_images(detections, cameras, obj, options, progress)
    with name_missing_labels(detections):
        try:
            first = place_by_stick(detections, cameras, obj) if is_stick else _first_rig(alone, cameras, obj).rig
        except RefusedError as error:
            if not is_stick:
                _require_unmirrored(error, detections, cameras, obj, options)
            raise
    placed = replace(first, prior=PLACED)
    labelled: Associations | None = None
    try:
        with require_solvable():
            labelled = associate(detections, placed, obj, options, progress)
            identified = time.perf_counter()
            fit = _fit(labelled, first, cameras, obj, options)
            if is_stick and (again := label_again(fit, detections, obj, options)) is not None:
                with contextlib.suppress(RefusedError), require_solvable():
                    fit = _fit(again, first, cameras, obj, options)
    except RefusedError as error:
        with name_missing_labels(detections):
            with contextlib.suppress(*UNSOLVABLE):
                require_units(error, detections, placed, obj, from_scratch=True)
                if labelled is not None:
                    require_same_moments(error, alone, labelled, placed, obj, options)
            raise
    late = find_late_cameras(alone, fit.tally, placed, obj, options)
    seconds = {
        "detection": found - started,
        "identity": identified - found,
        "estimation": time.perf_counter() - identified,
    }
    fit = replace(fit, labelled=name_repeats(fit.labelled, repeats), repeats=repeats, late=late)
    return _complete_rig(fit, cameras, seconds)


def _marker_alone(detections: Detections, obj: CalibrationObject) -> tuple[Detections, CalibrationObject]:
    """Take an object of one marker for an unknown marker; where blobs have labels, leave out those that have none."""
    labelled = detections.fiducial >= 0
    if labelled.any():
        detections = detections.select(labelled)
        detections = replace(detections, fiducial=np.full(len(detections), -1))
    return detections, as_unknown_marker(obj, detections)


def _complete_rig(fit: Calibration, cameras: CameraRig, seconds: dict[str, float]) -> Calibration:
    """Give the rig a name, a volume and the default prior: the earlier prior does not apply to later calibrations."""
    volume = fit.predicted_error.volume
    box = ConvexVolume.box(_corner(volume.low), _corner(volume.high))
    rig = replace(fit.rig, name=cameras.name, prior=None, volume=box)
    estimate = replace(fit.estimate, rig=rig)
    # The object's size is in the first rig's places, too: they cannot contradict it.
    return replace(fit, estimate=estimate, seconds=seconds, from_scratch=True, scale_sigma=None)


def _fit(
    labelled: Associations, first: CameraRig, cameras: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> Calibration:
    """Estimate everything from the first rig, which came from the same data, with a prior for the lenses only."""
    start = replace(first, prior=_wide_prior(first, cameras), distortion=first.distortion.clone())
    start.distortion[:, K3 - 10] = cameras.distortion[:, K3 - 10]  # the only coefficient with an informative prior
    std = ordinary_lens(_wide_prior(first, cameras).std(start))
    std[0, :6] = 0.0  # this camera defines the rig's frame
    fit = fit_with_timing(labelled, labelled.detections, start, obj, options, prior_std=std)
    require_central(fit, cameras)
    require_determined(fit)
    return fit


def label_images(
    detections: Detections,
    cameras: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    progress: Progress | None = None,
) -> Detections:
    """Label the blobs of single images by the object's own shape, as many images as are needed to place the cameras.

    Returns:
        The detections, with labels in images in which exactly one labelling fits (up to the object's own symmetry,
        which each image resolves independently).
    """
    snapshots, count = len(detections.snapshot_names), cameras.num_cameras
    rows = np.flatnonzero(detections.usable)
    image = detections.snapshot[rows] * count + detections.camera[rows]
    order = np.argsort(image, kind="stable")
    rows, blobs = rows[order], np.bincount(image, minlength=snapshots * count)
    ends = np.cumsum(blobs)
    fiducial = np.full(len(detections), -1)
    if is_small_planar(obj):
        images = np.split(rows, ends[:-1])
        for c in range(count):
            mine = images[c::count]
            blobs_uv, radii = ([column[those] for those in mine] for column in (detections.uv, detections.radius))
            found = label_by_shape(blobs_uv, cameras.select([c]), obj, radii)
            for those, labels in zip(mine, found, strict=True):
                fiducial[those] = -1 if labels is None else labels
        return replace(detections, fiducial=fiducial)
    chosen = _choose(blobs.reshape(snapshots, count), obj.num_fiducials)
    numbers = np.flatnonzero(chosen.any(1)).tolist()
    for s in progress(numbers, len(numbers)) if progress else numbers:
        for c in np.flatnonzero(chosen[s]).tolist():
            number = s * count + c
            those = rows[ends[number] - blobs[number] : ends[number]]
            fiducial[those] = _label_image(detections.select(those), cameras.select([c]), obj, options)
    return replace(detections, fiducial=fiducial)


def _label_image(
    blobs: Detections, camera: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> NDArray[np.int64]:
    """Label the blobs of one image, all or none."""
    zeros = np.zeros(len(blobs), dtype=np.int64)
    image = replace(blobs, camera=zeros, snapshot=zeros, camera_names=camera.camera_names, snapshot_names=("0",))
    sigma = np.hypot(image.sigma, options.identity_error)
    found = identify(replace(image, sigma=sigma), camera, obj, ALONE.std(camera), options=options.identity)
    return found.labels if found.accepted else zeros - 1


def _choose(blobs: NDArray[np.int64], fiducials: int) -> NDArray[np.bool_]:
    """Choose images (S, C) to label by their numbers of blobs: a number per camera, spread over the capture.

    Images with as many blobs as the object has fiducials come first, in snapshots that several cameras see.
    """
    enough = blobs >= LEAST_BLOBS
    together = enough & (enough.sum(1, keepdims=True) >= min(2, blobs.shape[1]))
    odd = np.abs(blobs - fiducials)
    chosen = np.zeros_like(enough)
    worth = np.where(together, odd, MOST_ODD).clip(max=MOST_ODD).mean(1)  # cost of a snapshot, the smaller the better
    stretches = np.array_split(np.arange(len(blobs)), LABELLED_ALONE)
    for camera in range(blobs.shape[1]):
        for stretch in stretches:
            there = stretch[together[stretch, camera]]
            if len(there):
                chosen[there[(worth + odd[:, camera])[there].argmin()], camera] = True
    # An image is useful together with others of the same moment, so add those that are easy to label.
    return chosen | (together & chosen.any(1, keepdims=True) & (odd <= LIKELY_ODD))


def _first_rig(labelled: Detections, cameras: CameraRig, obj: CalibrationObject) -> ColdStart:
    """Place the cameras by the labels."""
    if not (labelled.fiducial >= 0).any():
        raise RefusedError(
            f"identity: in no snapshot ({plural(len(labelled.snapshot_names), 'snapshot')} tried) can a single camera "
            "tell which blob is which fiducial: show the whole object and few other bright things, and check the field "
            "of view"
        )
    first = cold_start(to_observations(labelled, cameras, obj), cameras, obj)
    if first.spread > LARGEST_SPREAD:
        raise RefusedError(
            f"start without a factory calibration: the best rig misses the labelled blobs by {first.spread:.1f} px, "
            f"expected at most {LARGEST_SPREAD:g}: the object is not as its file says, labels are wrong, or the field "
            "of view is far from the truth"
        )
    return first


def _require_unmirrored(
    error: RefusedError, detections: Detections, cameras: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> None:
    """Replace a refusal if the cameras can be placed by the object's mirror image.

    Raises:
        RefusedError: says so.
    """
    mirrored = replace(obj, points=obj.points * obj.points.new_tensor([-1.0, 1.0, 1.0]))
    has_labels = bool((detections.fiducial >= 0).any())
    try:
        labelled = detections if has_labels else label_images(detections, cameras, mirrored, options)
        spread = _first_rig(labelled, cameras, mirrored).spread
    except (RefusedError, *UNSOLVABLE):
        return
    raise RefusedError(
        f"the object's mirror image fits the images, to {spread:.1g} px, and the object does not: a coordinate in its "
        f"file has the wrong sign, or all images are mirrored; so {error.reason}"
    ) from error


def _set_prior(cameras: CameraRig) -> CameraRig:
    cameras = cameras.as_constant()
    return cameras if cameras.prior is not None else replace(cameras, prior=RigPrior(0.15, 25.0, 0.1))


def _corner(values: Tensor) -> tuple[float, float, float]:
    """Round a corner of a volume to whole millimetres."""
    x, y, z = values.round().tolist()
    return x, y, z


def _extent(rig: CameraRig) -> float:
    """Largest distance between two cameras, mm."""
    return max(float(torch.cdist(rig.positions, rig.positions).max()), 1.0)


def _wide_prior(rig: CameraRig, cameras: CameraRig) -> RigPrior:
    assert cameras.prior is not None
    return replace(cameras.prior, rotation=WIDE_ROTATION, position=WIDE_POSITION * _extent(rig))


def require_central(fit: Calibration, cameras: CameraRig) -> None:
    """Raise `RefusedError` if lenses would have to compensate for an object that differs from its file."""
    assert cameras.prior is not None
    off = (fit.rig.principal_point - cameras.principal_point).norm(dim=-1)
    camera, usual = int(off.argmax()), cameras.prior.principal_point
    if float(off[camera]) > FARTHEST_CENTRE * usual:
        raise RefusedError(
            f"start without a factory calibration: the principal point of camera {cameras.camera_names[camera]} would "
            f"be {float(off[camera]):.0f} px from where it was expected, {float(off[camera]) / usual:.1f} times as far "
            "as usual: the object's coordinates are not exact, or the size of the image is wrong; measure the "
            "object again"
        )


def require_determined(fit: Calibration) -> None:
    """Raise `RefusedError` if a camera is known so badly that the result would be a guess."""
    rig = fit.rig
    std = fit.estimate.covariance(0).diagonal().clamp_min(0).sqrt().unflatten(0, (rig.num_cameras, -1))
    relative = torch.stack(
        (
            (std[:, 6:8] / rig.focal_length).amax(1) / LARGEST_FOCAL_STD,
            std[:, 0:3].amax(1) / LARGEST_ROTATION_STD,
            std[:, 3:6].amax(1) / (LARGEST_POSITION_STD * _extent(rig)),
        )
    )
    bad = ~(relative <= 1)
    if bool(bad.any()):
        kind, _ = bad.nonzero()[0].tolist()
        what = ("focal length", "direction", "position")[kind]
        which = list_names(rig.camera_names[c] for c in bad[kind].nonzero().flatten().tolist())
        raise RefusedError(
            f"start without a factory calibration: the data say too little about the {what} of camera {which}: carry "
            "the object through more of its view, nearer and farther, turned in all directions"
        )
