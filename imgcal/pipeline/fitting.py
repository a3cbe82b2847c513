"""Estimate a rig from all labelled snapshots, and check the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.association import Associations, PipelineOptions
from imgcal.errors import RefusedError
from imgcal.estimation import (
    BlockScatter,
    ObjectQuestion,
    Solution,
    Start,
    UndeterminedPosesError,
    block_scatter,
    estimate_variance_components,
    initial_state,
    make_estimate,
    make_loss,
    make_problem,
    object_prior_std,
)
from imgcal.pipeline.board_turns import settle_bend
from imgcal.pipeline.calibration import Calibration
from imgcal.pipeline.initialization import Initialization, Initializer, prediction_residual
from imgcal.pipeline.label_counts import count_labels
from imgcal.pipeline.labelled_capture import LabelledCapture, arrange_labels
from imgcal.pipeline.light_motion import require_steady_cameras
from imgcal.pipeline.lights import FoundLights
from imgcal.pipeline.motion_check import steady_part
from imgcal.pipeline.object_checks import object_offsets
from imgcal.pipeline.object_exchange import require_one_size
from imgcal.pipeline.refusals import (
    require_cameras,
    require_fit,
    require_most_labels,
    require_near_prior,
    require_same_residuals,
    require_views,
)
from imgcal.pipeline.scale import finite
from imgcal.types import (
    CalibrationObject,
    CameraRig,
    Detections,
    MovedError,
    Observations,
    Prediction,
    RigPrior,
)

LEAST_KEPT = 0.8
"""Share of the snapshots that must keep a pose after outliers have been left out."""


def fit_steady(
    labelled: Associations,
    given: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    initializer: Initializer | None = None,
    prior_std: Tensor | None = None,
) -> Calibration:
    """Do what `calibrate` does with labelled blobs: select steady snapshots, fit, run all checks.

    Args:
        labelled: all snapshots.
        given: the same data as given, with the labels of the input only.
        rig: what is known before, float64.
        obj: the calibration object.
        options: how certain the result must be.
        initializer: network whose first guess starts the estimate.
        prior_std: (C, K) standard deviations of the factory values once cameras are known to be steady; None = as in
            the rig.

    Raises:
        RefusedError: the data are not sufficient.
    """
    arranged = arrange_labels(labelled, rig, obj)
    _require_any_view(arranged, rig, obj)
    steady = steady_part(arranged, given, rig, obj, options)
    fits = steady.fits if prior_std is None else ()  # they use the rig's prior
    fit = _fit(steady.arranged, rig, obj, options, _Known(initializer, prior_std=prior_std, fits=fits))
    fit = replace(fit, moved=steady.moved)  # before its tally is computed and cached
    require_views(fit.tally, rig)
    return fit


def fit_lights(
    lights: FoundLights,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    prior_std: Tensor | None = None,
) -> Calibration:
    """Do what `fit_steady` does with unknown markers, and check that every camera shows them in place to the end.

    Raises:
        RefusedError: the data are not sufficient.
        MovedError: a camera shows the markers elsewhere before or after some moment.
    """
    labelled = lights.labelled
    fit = fit_steady(labelled, labelled.detections, rig, obj, options, prior_std=prior_std)
    moment, points = fit.labelled.moments[fit.labelled.used], fit.rig_from_object.translation.numpy()
    moving = lights.detections.select(~lights.background)
    require_steady_cameras(moving, moment, points, fit.observations.seen[:, :, 0].numpy(), fit.estimate.rig)
    return replace(fit, lights=lights)


def fit_since_last_move(
    fit: Callable[[Detections], Calibration], detections: Detections, options: PipelineOptions
) -> Calibration:
    """Fit unknown markers; if a camera has moved and the options allow it, those after its move.

    Raises:
        RefusedError: the data are not sufficient, or a camera has moved.
    """
    try:
        return fit(detections)
    except MovedError as error:
        if not (options.after_last_move and error.explained):
            raise
        first = len(detections.snapshot_names) - error.since
        found = fit_since_last_move(fit, detections.select(detections.snapshot >= first), options)
        return replace(found, moved=(*error.moved, *found.moved))


def fit_labelled(
    labelled: Associations,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    initializer: Initializer | None = None,
    *,
    latest: Calibration | None = None,
    prior_std: Tensor | None = None,
) -> Calibration:
    """Estimate the rig from all labelled snapshots without outliers, and check that the rest fits.

    Args:
        labelled: from `label`.
        rig: the factory calibration.
        obj: the calibration object.
        options: how certain the result must be.
        initializer: network whose first guess is the start if it fits the images better than the factory rig.
        latest: result for the previous snapshot, from the same factory calibration: a start that saves time.
        prior_std: (C, K) standard deviations of the factory values; None = as in the rig.

    Raises:
        RefusedError: a camera saw nothing, the estimate has no minimum, or the residuals do not fit.
    """
    rig = rig.as_constant()
    return _fit(arrange_labels(labelled, rig, obj), rig, obj, options, _Known(initializer, latest, prior_std))


@dataclass(frozen=True)
class _Known:
    """What is known before a fit; see `fit_labelled`."""

    initializer: Initializer | None = None
    latest: Calibration | None = None
    prior_std: Tensor | None = None
    fits: tuple[Solution, ...] = ()  # fits of all labels, if already made; see `SteadyPart`


def _fit(
    given: LabelledCapture, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions, known: _Known
) -> Calibration:
    """Do the work of `fit_labelled` for snapshots that all have a pose."""
    arranged = given
    while True:
        try:
            return _fit_once(arranged, rig, obj, options, known)
        except UndeterminedPosesError as error:
            arranged, known = arranged.drop_snapshots(error.rows, rig, obj, error.reason), replace(known, fits=())
            left, count = len(arranged.labelled.used), len(given.labelled.used)
            if left < LEAST_KEPT * count:
                raise RefusedError(
                    f"{error} (found {count - left} of {count} such snapshots): some fiducial is not where the object "
                    "file says"
                ) from error


def _fit_once(
    arranged: LabelledCapture, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions, known: _Known
) -> Calibration:
    """Fit, unless some snapshots do not determine the object's pose without outliers."""
    latest = known.latest
    require_cameras(arranged.observations.seen.numpy(), rig, options)
    prior = (rig.prior or RigPrior()).std(rig) if known.prior_std is None else known.prior_std
    if latest is None and (settled := settle_bend(arranged, rig, obj, prior, options)) is not arranged:
        arranged, known = settled, replace(known, fits=())
    labelled, observations = arranged.labelled, arranged.observations
    variance, labels = observations.sigma.numpy() ** 2, observations.seen.numpy()
    alike = labelled.identity == "ambiguous" and len(labelled.used) > 1
    if alike and bool(object_prior_std(obj)[:-1].any()):
        raise RefusedError(
            "object: it is symmetric, and snapshots may be labelled in different orientations: the places of its "
            "fiducials within their tolerances cannot be estimated",
            python="give labels (Detections.fiducial), use an object without symmetry, or one without tolerances",
            command="give labels (a column `fiducial`), use an object without symmetry, or one without tolerances",
        )
    problem = make_problem(observations, rig, _adopt_tolerances(obj, latest), prior)
    guess = None if known.initializer is None else known.initializer.guess(observations, rig, obj)
    guess_used = guess is not None and _is_nearer(guess, Prediction(rig, arranged.poses), observations, obj)
    first = Start(initial_state(problem, arranged.poses, labelled.rig), options.identity_error)
    if known.fits:
        first = replace(first, solution=known.fits[0], nearer=known.fits[-1].state)
    if guess is not None and guess_used:
        first = Start(initial_state(problem, guess.rig_from_object, guess.rig), options.identity_error)
    starts = [first]
    if latest is not None and not latest.prior_scale:
        change = latest.estimate.problem.prior_std * latest.estimate.solution.state.offset
        offset = torch.where(prior > 0, change / prior.clamp_min(1e-30), 0.0)
        starts.insert(0, Start(replace(first.state, offset=offset), latest.additive_noise))
    question = ObjectQuestion.NONE
    if latest is None:
        question = ObjectQuestion.SHAPE_OF_TURNS if alike else ObjectQuestion.SHAPE
    found = estimate_variance_components(problem, starts, variance, labels, options, question)
    loss = make_loss(options.estimation)
    fit = replace(make_estimate(found.problem, found.solution, found.solution.state, loss), modes=found.modes)
    if latest is None:
        require_one_size(fit, tuple(labelled.snapshots[s].name for s in labelled.used))
    require_same_residuals(fit, observations, found.seen, obj)
    shape = object_offsets(fit, found.shape, obj)
    scatter = BlockScatter()
    if latest is None:
        scatter = block_scatter(found.problem, found.solution, loss)
        fit = replace(fit, inflation=scatter.factor)
    outliers = int(labels.sum() - found.seen.sum())
    require_cameras(found.seen, rig, options)
    require_near_prior(fit, prior, rig, found.prior_scale, options)
    require_most_labels(labels, found.seen, rig)
    require_fit(found.additive_noise, outliers / max(int(labels.sum()), 1), float(fit.rms), options)
    return Calibration(
        estimate=fit,
        labelled=labelled,
        observations=Observations(
            observations.uv, torch.from_numpy(found.sigma).to(observations.sigma), torch.from_numpy(found.seen)
        ),
        additive_noise=found.additive_noise,
        outliers=outliers,
        prior_scale=found.prior_scale,
        factory=rig,
        obj=obj,
        shape=shape,
        scale_sigma=None if found.shape is None else finite(found.shape.scale_error[1]),
        bent_sigma=None if found.shape is None else found.shape.bent_sigma(),
        block_length=scatter.length,
        initialization=guess,
        guess_used=guess_used,
    )


def _adopt_tolerances(obj: CalibrationObject, latest: Calibration | None) -> CalibrationObject:
    """The object with the tolerances that the latest result has found necessary."""
    learnt = None if latest is None else latest.estimate.problem.object_prior_std
    return obj if learnt is None else replace(obj, tolerance=learnt[0, :-1:3])


def _require_any_view(arranged: LabelledCapture, rig: CameraRig, obj: CalibrationObject) -> None:
    """Refuse if a camera sees the object, but none of it could be labelled: worse than seeing nothing."""
    labels = arranged.observations.seen.numpy()
    if labels.any((0, 2)).all():
        return
    require_views(count_labels(arranged.labelled, labels, arranged.poses, rig, obj), rig, least_share=0.0)


def _is_nearer(guess: Initialization, factory: Prediction, observations: Observations, obj: CalibrationObject) -> bool:
    """Tell whether a guess, as the mean rig, fits the images better than the factory calibration."""
    start = Prediction(guess.rig, guess.rig_from_object)
    return bool(
        prediction_residual(start, observations, obj).norm() < prediction_residual(factory, observations, obj).norm()
    )
