"""From blobs to a recalibrated rig: labels, then one estimate over all snapshots, then checks.

`calibrate` does what the command of that name does, on values in memory: it neither reads nor writes files.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np
from torch import Tensor

from imgcal.association import Associations, PipelineOptions, Progress, Sight, associate
from imgcal.detection import DetectionOptions
from imgcal.errors import InputError, RefusedError
from imgcal.pipeline.board_turns import settle_turns
from imgcal.pipeline.calibration import Calibration
from imgcal.pipeline.conventions import lines_of_sight_miss, require_conventions, require_meeting_rays
from imgcal.pipeline.exposure_delays import Delays, add_uncertainty, find_delays, has_odd_camera
from imgcal.pipeline.fitting import fit_lights, fit_since_last_move, fit_steady
from imgcal.pipeline.initialization import Initializer
from imgcal.pipeline.late_cameras import find_late_cameras, require_same_moments
from imgcal.pipeline.learned_measurer import LearnedMeasurer
from imgcal.pipeline.learned_proposer import LearnedProposer
from imgcal.pipeline.lights import add_lights, find_lights
from imgcal.pipeline.partial_labels import name_missing_labels
from imgcal.pipeline.repeats import Repeats, drop_repeats, hide_repeats, name_repeats
from imgcal.pipeline.sources import Detector, Frames, as_one, as_unknown_marker, check_frames, find_blobs, make_sight
from imgcal.pipeline.synchronization import NOTICEABLE, find_unsynchronized
from imgcal.pipeline.turned_images import require_matching_images
from imgcal.pipeline.units import UNSOLVABLE, is_solid, require_solvable, require_units
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior, check_rig

LEAST_USED, MOST_USED = 0.5, 0.75
"""Share of the snapshots below which images or rig may follow other conventions, and of those tried for one to fit."""
MOST_ODD = 0.03
"""Maximum share of the labels that may be outliers for delays to be believed."""
FOUND = RigPrior(focal_length=5e-4, principal_point=0.5, distortion=0.01, rotation=5e-4, position=0.5)
"""Prior of a rig that was just found, for completing the labels of sticks: about a pixel."""


def calibrate(
    source: Detections | Frames,
    rig: CameraRig,
    obj: CalibrationObject | Sequence[CalibrationObject],
    options: PipelineOptions = PipelineOptions(),
    *,
    detection: DetectionOptions = DetectionOptions(),
    initializer: Initializer | None = None,
    progress: Progress | None = None,
    detector: Detector = "classical",
    measurer: LearnedMeasurer | None = None,
) -> Calibration:
    """Recalibrate a rig from what its cameras saw.

    Args:
        source: blobs, labelled or not, or frames in memory (see `imgcal.detect`).
        rig: the factory calibration, without batch axes.
        obj: the calibration object; or several, any of which may be in view of any snapshot.
        options: how certain the result must be.
        detection: how blobs are found in frames.
        initializer: network whose first guess starts the estimate (`load_initializer`).
        progress: wraps the loop over snapshots, for a progress bar.
        detector: what finds the fiducials in frames: `classical` (blobs), `matched` (a matched filter for frames in
            which blobs fail), `auto` (the filter if blobs are not sufficient, or the calibration from them is
            refused), `learned` or another network (and where the calibration from it is refused, the filter), or a
            `Proposer`; a `Sight` brings frames that are not in memory. Blobs that contradict count, blobs decide if a
            proposer finds nothing, and identification and all checks apply as usual.
        measurer: measures the blobs of frames again (`LearnedMeasurer.load`): half-hidden and unevenly lit markers;
            also those that `learned` finds.

    Raises:
        RefusedError: the data are not sufficient; the message says why.
        InputError: the rig or the object is invalid, or the data do not belong to them: other cameras, frames of
            another size.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> result = imgcal.calibrate(true_detections(truth), factory, obj)
        >>> result.identity, result.rig.camera_names == factory.camera_names
        ('coded', True)
    """
    check_rig(rig)
    obj = as_one(obj)
    started, rig, options = time.perf_counter(), rig.as_constant(), options.of_object(obj)
    source = source if isinstance(source, Detections) else check_frames(source, rig)
    blobs = find_blobs(source, rig, obj, detection, measurer)
    detections, repeats = drop_repeats(settle_turns(blobs, rig, obj))
    found = time.perf_counter()
    obj = as_unknown_marker(obj, detections)
    if obj.unknown_markers and detector != "classical":
        raise InputError(f"detector {detector}: found unknown markers, expected an object with a pattern to look for")
    sight = make_sight(detector, source, detection, measurer)
    sight = sight and hide_repeats(sight, repeats)
    if obj.unknown_markers:
        return _calibrate_lights(detections, repeats, rig, obj, options, found - started)
    if obj.parts and (sight is not None or initializer is not None):
        obj.require_rigid("for detectors and networks that look for a pattern")
    case = _Case(detections, rig, obj, options, may_be_misread=is_solid(obj) and sight is None)
    if case.may_be_misread and not detections.labelled.any() and lines_of_sight_miss(detections, rig):
        # Identity takes minutes to find nothing in a long capture.
        case.try_conventions(RefusedError("identity: the cameras' lines of sight to the object do not meet"))
        case = replace(case, may_be_misread=False)  # images and rig follow our conventions
    try:
        with require_solvable():
            labelled = associate(detections, rig, obj, options, progress, sight)
    except RefusedError as error:
        case.explain(error, None)
    identified = time.perf_counter()
    try:
        fit = _fit_labels(labelled, detections if sight is None else _given_labels(labelled), case, initializer)
    except RefusedError as error:
        if sight is not None and (other := _next_sight(sight, labelled)) is not None:
            with contextlib.suppress(RefusedError):
                fit = calibrate(
                    detections, rig, obj, options, initializer=initializer, progress=progress, detector=other
                )
                return replace(fit, labelled=name_repeats(fit.labelled, repeats), repeats=repeats)
        case.explain(error, labelled)
    used, given = fit.labelled.moment_counts
    if case.may_be_misread and used < LEAST_USED * given:
        case.try_conventions(RefusedError(f"identity: only {used} of {given} snapshots could be used"))
    seconds = {
        "detection": found - started,
        "identity": identified - found,
        "estimation": time.perf_counter() - identified,
    }
    late = find_late_cameras(detections, fit.tally, rig, obj, options, labelled=fit.labelled)
    return replace(fit, labelled=name_repeats(fit.labelled, repeats), seconds=seconds, late=late, repeats=repeats)


@dataclass(frozen=True)
class _Case:
    """What is to be calibrated, and whether images or rig may follow other conventions than ours."""

    detections: Detections
    rig: CameraRig
    obj: CalibrationObject
    options: PipelineOptions
    may_be_misread: bool

    def explain(self, error: RefusedError, labelled: Associations | None) -> NoReturn:
        """Raise a refusal, with a cause if one can be named: other conventions, units or images, or late cameras.

        Args:
            error: the refusal.
            labelled: the labels, where the refusal is not about these.

        Raises:
            RefusedError: always.
        """
        with name_missing_labels(self.detections):
            with contextlib.suppress(*UNSOLVABLE):  # what cannot be solved explains nothing
                if self.may_be_misread:
                    self.try_conventions(error)
                # Labels show more than the sizes of images, which reflections distort.
                shown = self.detections if labelled is None else labelled.detections
                require_units(error, shown, self.rig, self.obj)
                if labelled is None or not is_solid(self.obj):
                    require_meeting_rays(error, self.detections, self.rig)
                if labelled is not None:
                    require_matching_images(error, self.detections, labelled, self.rig, self.obj)
                    require_same_moments(error, self.detections, labelled, self.rig, self.obj, self.options)
            raise error

    def try_conventions(self, error: RefusedError) -> None:
        """Replace a refusal if images or rig follow other conventions; see `require_conventions`."""
        options = replace(self.options, blind_cameras=True).begin_at(None)

        def fit(some: Detections, rig: CameraRig) -> float:
            with require_solvable():
                found = fit_steady(associate(some, rig, self.obj, options), some, rig, self.obj, options)
            used, given = found.labelled.moment_counts
            if used < MOST_USED * given:
                raise RefusedError("identity: the object was found in few of the snapshots")
            return float(found.rms)

        require_conventions(error, self.detections, self.rig, fit)


def _fit_labels(labelled: Associations, given: Detections, case: _Case, initializer: Initializer | None) -> Calibration:
    """Fit; with the rig that was found, label sticks once more and add lights, and fit again."""
    rig, obj, options = case.rig, case.obj, case.options
    with require_solvable():
        fit = fit_with_timing(labelled, given, rig, obj, options, initializer)
        has_stick = any(part.pose_rank == 5 for part in obj.each)
        if has_stick and (again := label_again(fit, given, obj, options)) is not None:
            with contextlib.suppress(RefusedError), require_solvable():
                fit = fit_with_timing(again, given, rig, obj, options)
        is_steady = not fit.moved and fit.unsynchronized is None and fit.delays is None
        if obj.has_lights and is_steady and (lit := add_lights(fit.labelled, fit.estimate.rig, obj)) is not None:
            with contextlib.suppress(RefusedError), require_solvable():
                fit = fit_steady(lit, given, rig, obj, options)
    return fit


def _calibrate_lights(
    detections: Detections,
    repeats: Repeats,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    detecting: float,
) -> Calibration:
    """Calibrate from unknown markers; `detecting`: seconds that detection took."""
    started, identified = time.perf_counter(), 0.0

    def fit_some(some: Detections) -> Calibration:
        nonlocal identified
        with require_solvable():
            lights = find_lights(some, rig, obj)
            identified = time.perf_counter()
            return fit_lights(lights, rig, obj, options)

    try:
        fit = fit_since_last_move(fit_some, detections, options)
    except RefusedError as error:
        require_units(error, detections, rig, obj)
        with contextlib.suppress(*UNSOLVABLE):
            require_meeting_rays(error, detections, rig)
        raise
    seconds = {
        "detection": detecting,
        "identity": identified - started,
        "estimation": time.perf_counter() - identified,
    }
    return replace(fit, seconds=seconds, repeats=repeats)


def label_again(
    fit: Calibration, given: Detections, obj: CalibrationObject, options: PipelineOptions
) -> Associations | None:
    """Label once more with the rig that was found; None = that gives no more labels.

    A camera shows little of a stick: a marker with a hidden neighbour can be labelled only if the rig is known.
    """
    if fit.labelled.identity == "coded" or fit.moved or fit.unsynchronized is not None:
        return None
    with contextlib.suppress(RefusedError), require_solvable():
        again = associate(given, replace(fit.estimate.rig, prior=FOUND), obj, options)
        if int((again.detections.fiducial >= 0).sum()) > int((fit.labelled.detections.fiducial >= 0).sum()):
            return again
    return None


def fit_with_timing(
    labelled: Associations,
    given: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    initializer: Initializer | None = None,
    prior_std: Tensor | None = None,
) -> Calibration:
    """Do what `fit_steady` does; if cameras expose at other times, with blobs moved back, or with additional noise.

    Raises:
        RefusedError: the data are not sufficient.
    """

    def fit_other(blobs: Detections, delays: Delays | None) -> Calibration:
        own = replace(given, uv=blobs.uv, sigma=blobs.sigma) if len(given) == len(blobs) else blobs
        fit = fit_steady(replace(labelled, detections=blobs), own, rig, obj, options, initializer, prior_std)
        return fit if delays is None else with_delays(fit, delays)

    fit: Calibration | None = None
    refusal: RefusedError | None = None
    try:
        fit = fit_steady(labelled, given, rig, obj, options, initializer, prior_std)
        if fit.additive_noise == 0 and not has_odd_camera(fit.residual, fit.observations, fit.labelled):
            return fit
    except RefusedError as error:
        refusal = error
    if (constant := find_delays(labelled, rig, obj)) is not None:
        delays, together = constant
        with contextlib.suppress(RefusedError):
            found = fit_other(together, delays)
            few = found.outliers <= MOST_ODD * int((labelled.detections.fiducial >= 0).sum())
            if few and (fit is None or _misfit(found) < _misfit(fit)):
                fit, labelled = found, replace(labelled, detections=together)
    if fit is not None and fit.additive_noise < NOTICEABLE:
        return fit
    if (changing := find_unsynchronized(labelled, rig, obj)) is not None:
        unsynchronized, noisy = changing
        with contextlib.suppress(RefusedError):
            found = fit_other(noisy, None if fit is None else fit.delays)
            return replace(found, unsynchronized=unsynchronized)
    if fit is None:
        assert refusal is not None
        raise refusal
    return fit


def with_delays(fit: Calibration, delays: Delays) -> Calibration:
    """Add delays and their uncertainty to a fit of blobs that were moved back."""
    return replace(fit, delays=delays, estimate=add_uncertainty(fit.estimate, delays, fit.labelled, fit.obj))


def _misfit(fit: Calibration) -> tuple[float, int, float]:
    """How badly labels fit: the smaller, the better."""
    return fit.additive_noise, fit.outliers, float(fit.rms)


def _next_sight(sight: Sight, labelled: Associations) -> Sight | None:
    """Return what to try if the calibration from these labels is refused: frames after blobs, a network's finder after
    the network; None = nothing else.
    """
    snapshots = [labelled.snapshots[number] for number in labelled.used]
    made_by = {snapshot.found_by for snapshot in snapshots if snapshot.status != "coded"}
    if sight.where_blobs_fail and "classical" in made_by:
        return replace(sight, where_blobs_fail=False)
    proposer = sight.proposer
    if isinstance(proposer, LearnedProposer) and proposer.finder is not None and proposer.name in made_by:
        return replace(sight, proposer=proposer.finder)
    return None


def _given_labels(labelled: Associations) -> Detections:
    """All blobs, also those measured by a proposer, with the labels of the input only."""
    coded = np.array([snapshot.status == "coded" for snapshot in labelled.snapshots])
    detections = labelled.detections
    return replace(detections, fiducial=np.where(coded[detections.snapshot], detections.fiducial, -1))
