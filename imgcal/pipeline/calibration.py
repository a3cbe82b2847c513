"""From blobs to a recalibrated rig: labels, then one estimate over all snapshots, then the checks that it must pass.

`calibrate` is what the command of the same name does, on values in memory: it neither reads nor writes files.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from imgcal.association import Associations, PipelineOptions, Progress, associate
from imgcal.detection import DetectionOptions
from imgcal.errors import RefusedError
from imgcal.estimation import (
    BlockScatter,
    Estimate,
    FiducialOffset,
    ObjectQuestion,
    PredictedError,
    Solution,
    Start,
    UndeterminedPosesError,
    block_scatter,
    estimate,
    estimate_variance_components,
    initial_state,
    make_estimate,
    make_loss,
    make_problem,
    predicted_error,
)
from imgcal.geometry import RigidTransform
from imgcal.pipeline.arrangement import Arranged, arrange
from imgcal.pipeline.checks import (
    require_cameras,
    require_fit,
    require_most_labels,
    require_near_prior,
    require_same_residuals,
    require_views,
)
from imgcal.pipeline.initialization import Initialization, Initializer, residual_of
from imgcal.pipeline.lateness import LateCamera, late_camera, suspects
from imgcal.pipeline.measuring import LearnedMeasurer
from imgcal.pipeline.object_checks import displaced, lost_fiducials, object_offsets
from imgcal.pipeline.sources import Detector, Frames, blobs_of, checked_frames, sight_of
from imgcal.pipeline.steadiness import steady_part
from imgcal.pipeline.tally import Tally, tally
from imgcal.pipeline.units import unit_doubt
from imgcal.types import (
    BlobFlag,
    CalibrationObject,
    CameraRig,
    Detections,
    MovedCamera,
    MovedError,
    Observations,
    Prediction,
    RigPrior,
)

LEAST_KEPT = 0.8
"""Share of the snapshots that must keep a pose when outliers have been left out."""


@dataclass(frozen=True)
class Calibration:
    """A recalibrated rig, with what it was made from. Snapshots are those used, in order.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> result = imgcal.calibrate(true_detections(truth), factory, obj)
        >>> float(result.before.rms) > 5, float(result.rms) < 0.01
        (True, True)
        >>> result.outliers, result.displaced, result.moved
        (0, (), ())
    """

    estimate: Estimate  # without batch axes: the rig, the poses, and how well they are known
    labelled: Associations
    observations: Observations  # (S, C, N) as used: outliers not seen, sigma with the additive noise
    additive_noise: float  # px, what the residuals hold beyond the blobs' own sigma
    outliers: int  # labelled blobs left out
    prior_scale: Mapping[str, float]  # by kind of value: factor by which the prior was too narrow, where it was
    factory: CameraRig
    obj: CalibrationObject  # as it was given
    shape: tuple[FiducialOffset, ...] = ()  # where each fiducial is instead; empty = the object was taken as exact
    scale_sigma: float | None = None  # relative: an error of the object's scale four times as large would be noticed
    bent_sigma: float | None = None  # how sure it is that the object is not as estimated; None = not asked
    block_length: int = 0  # snapshots in the blocks whose scatter the covariance follows; 0 = that of the noise
    initialization: Initialization | None = None  # what a network said, where one was asked
    guess_used: bool = False  # its guess was nearer to the images than the factory calibration
    seconds: Mapping[str, float] = field(default_factory=dict)  # by stage
    moved: tuple[MovedCamera, ...] = ()  # during the capture; snapshots used are those since then
    from_scratch: bool = False  # there was no factory calibration: `factory` is a first rig made from the same data
    late: tuple[LateCamera, ...] = ()  # whose frames, from some snapshot on, are of other moments: these took no part

    def __repr__(self) -> str:
        """Say what was found: the rig, its error before and after, how the fiducials were identified."""
        before, after = (2**0.5 * float(rms) for rms in (self.before.rms, self.rms))
        used = f"{len(self.labelled.used)} of {len(self.labelled.snapshots)} snapshots"
        return (
            f"{type(self).__name__}({self.rig!r}, RMS {before:.4g} -> {after:.2g} px, chi2/dof "
            f"{float(self.chi2_per_dof):.2f}, identity {self.identity}, {used})"
        )

    @property
    def rig(self) -> CameraRig:
        """The recalibrated rig."""
        return self.estimate.rig

    @property
    def rig_from_object(self) -> RigidTransform:
        """The object's pose in each snapshot: (S,)."""
        return self.estimate.rig_from_object

    @property
    def points_object(self) -> Tensor:
        """The fiducials as estimated: (N, 3) mm; as given where the object is exact."""
        return self.estimate.points_object

    @property
    def residual(self) -> Tensor:
        """Predicted minus observed: (S, C, N, 2) pixels; zero where not seen."""
        return self.estimate.residual

    @property
    def rms(self) -> Tensor:
        """RMS reprojection error of the seen fiducials, over both axes: () pixels."""
        return self.estimate.rms

    @property
    def chi2_per_dof(self) -> Tensor:
        """About 1 where residuals fit the noise and the prior: ()."""
        return self.estimate.chi2_per_dof

    @cached_property
    def before(self) -> Estimate:
        """The factory rig as it stands on the same observations: only the poses are fitted."""
        return estimate(
            self.observations,
            self.factory,
            self.obj.taken_as_exact(),
            self.rig_from_object,
            prior_std=torch.zeros_like(self.estimate.problem.prior_std[0]),
        )

    @property
    def object(self) -> CalibrationObject:
        """The object as it was estimated: its fiducials in their estimated places, taken as exact."""
        return replace(self.obj.taken_as_exact(), points=self.points_object.detach())

    @property
    def displaced(self) -> tuple[FiducialOffset, ...]:
        """Fiducials that are surely not in their places; what is known of lost ones rests on a few odd labels."""
        return tuple(d for d in displaced(self.shape, self.obj) if d.fiducial not in self.lost)

    @cached_property
    def lost(self) -> tuple[int, ...]:
        """Fiducials that were hardly found where the others were."""
        points = self.rig_from_object.apply(self.points_object)
        visible = self.rig.expand(len(points)).project(points, self.obj.radius).visible
        return lost_fiducials(self.observations.seen.numpy(), visible.numpy())

    @cached_property
    def tally(self) -> Tally:
        """What each camera saw in each snapshot, and how much of it is explained."""
        return tally(self.labelled, self.observations.seen.numpy(), self.rig_from_object, self.factory, self.obj)

    @property
    def labelled_detections(self) -> Detections:
        """All blobs with the labels that they got; those left out as outliers have the flag `BlobFlag.OUTLIER`."""
        detections, used = self.labelled.detections, self.labelled.used
        row = np.full(len(self.labelled.snapshots), -1)
        row[used] = np.arange(len(used))
        s, c, n = row[detections.snapshot], detections.camera, detections.fiducial
        outlier = (s >= 0) & (n >= 0)
        outlier[outlier] = ~self.observations.seen.numpy()[s[outlier], c[outlier], n[outlier]]
        marked = detections.flags | np.where(outlier, int(BlobFlag.OUTLIER), 0).astype(np.uint8)
        return replace(detections, flags=marked)

    @cached_property
    def predicted_error(self) -> PredictedError:
        """How good the rig is over the working volume."""
        return predicted_error(self.estimate)

    @property
    def detectors(self) -> Mapping[str, int]:
        """Who found the fiducials, with the number of snapshots used: `classical` (blobs), or a proposer's name."""
        return Counter(self.labelled.snapshots[s].found_by for s in self.labelled.used)

    @property
    def identity(self) -> str:
        """coded | unique | by_prior | by_tracking | ambiguous."""
        return self.labelled.identity


def calibrate(
    source: Detections | Frames,
    rig: CameraRig,
    obj: CalibrationObject,
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
        obj: the calibration object.
        options: how sure the result must be.
        detection: how blobs are found in frames.
        initializer: network whose first guess the estimate starts from (`load_initializer`).
        progress: wraps the loop over snapshots, for a progress bar.
        detector: who finds the fiducials in frames: `classical` (blobs), `matched` (a matched filter for frames in
            which blobs fail), `auto` (the filter where blobs decide nothing), or a `Proposer`; a `Sight` brings frames
            that are not in memory. Blobs that contradict count, and identity and all checks decide as ever.
        measurer: measures the blobs of frames again (`LearnedMeasurer.load`): half-hidden and unevenly lit markers.

    Raises:
        RefusedError: the data cannot decide; the message says why.
        InputError: the data do not belong to this rig or object: other cameras, frames of another size.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> result = imgcal.calibrate(true_detections(truth), factory, obj)
        >>> result.identity, result.rig.camera_names == factory.camera_names
        ('coded', True)
    """
    started, rig = time.perf_counter(), rig.to(torch.float64)
    source = source if isinstance(source, Detections) else checked_frames(source, rig)
    detections = blobs_of(source, rig, obj, detection, measurer)
    found = time.perf_counter()
    sight = sight_of(detector, source, detection)
    labelled: Associations | None = None
    try:
        labelled = associate(detections, rig, obj, options, progress, sight)
        identified = time.perf_counter()
        given = detections if sight is None else _as_given(labelled)
        fit = fit_steady(labelled, given, rig, obj, options, initializer)
    except RefusedError as error:
        if doubt := unit_doubt(rig, obj):
            raise RefusedError(f"{doubt}; so {error.reason}") from error
        if labelled is not None:
            arranged = arrange(labelled, rig, obj)
            labels = arranged.observations.seen.numpy()
            counts = tally(arranged.labelled, labels, arranged.poses, rig, obj)
            names = detections.snapshot_names
            moves = error.moved if isinstance(error, MovedError) else ()
            moved = tuple((move.camera, names.index(move.snapshot)) for move in moves)
            for slipped in _late(detections, counts, rig, obj, options, moved):
                raise RefusedError(
                    str(slipped),
                    python="give the frames of each moment, or leave the camera out (rig.select)",
                    command=f"export its frames anew, or leave it out: --without {slipped.camera}",
                ) from error
        raise
    seconds = {
        "detection": found - started,
        "identity": identified - found,
        "estimation": time.perf_counter() - identified,
    }
    late = _late(detections, fit.tally, rig, obj, options)
    return replace(fit, seconds=seconds, late=late)


def _late(
    detections: Detections,
    counts: Tally,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    moved: tuple[tuple[str, int], ...] = (),
) -> tuple[LateCamera, ...]:
    """Cameras that do not agree with the others because their frames are of other moments."""

    def others(blobs: Detections) -> tuple[list[int], RigidTransform]:
        labelled = associate(blobs, rig, obj, options)
        fit = _fitted(arrange(labelled, rig, obj), rig, obj, replace(options, blind_cameras=True), _Known())
        return fit.labelled.used, fit.rig_from_object

    asked = suspects(counts, rig.camera_names, moved)
    found = (late_camera(detections, rig, obj, camera, around, others) for camera, around in asked.items())
    return tuple(late for late in found if late is not None)


def fit_steady(
    labelled: Associations,
    given: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    initializer: Initializer | None = None,
    prior_std: Tensor | None = None,
) -> Calibration:
    """Do what `calibrate` does once blobs have labels: steady snapshots, the fit, all checks.

    Args:
        labelled: all snapshots.
        given: the same as they came in, with the labels of the input alone.
        rig: what is known before, float64.
        obj: the calibration object.
        options: how sure the result must be.
        initializer: network whose first guess the estimate starts from.
        prior_std: (C, 15) how far values may be off, once cameras are known to be steady; None = as the rig says.

    Raises:
        RefusedError: the data cannot decide.
    """
    arranged = arrange(labelled, rig, obj)
    _require_any_view(arranged, rig, obj)
    steady = steady_part(arranged, given, rig, obj, options)
    fits = steady.fits if prior_std is None else ()  # those have the rig's prior
    fit = _fitted(steady.arranged, rig, obj, options, _Known(initializer, prior_std=prior_std, fits=fits))
    require_views(fit.tally, rig)
    return replace(fit, moved=steady.moved)


def _as_given(labelled: Associations) -> Detections:
    """All blobs, also those that a proposer measured, with the labels of the input alone."""
    coded = np.array([snapshot.status == "coded" for snapshot in labelled.snapshots])
    detections = labelled.detections
    return replace(detections, fiducial=np.where(coded[detections.snapshot], detections.fiducial, -1))


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
    """Estimate the rig from all labelled snapshots, leaving out what does not fit, and check that the rest does.

    Args:
        labelled: from `label`.
        rig: the factory calibration.
        obj: the calibration object.
        options: how sure the result must be.
        initializer: network whose first guess is the start, where it is nearer to the images than the factory rig.
        latest: what the snapshot before gave, from the same factory calibration: a start that saves time.
        prior_std: (C, 15) how far the factory values may be off; None = as the rig says.

    Raises:
        RefusedError: a camera saw nothing, the estimate has no minimum, or the residuals do not fit.
    """
    rig = rig.to(torch.float64)
    return _fitted(arrange(labelled, rig, obj), rig, obj, options, _Known(initializer, latest, prior_std))


@dataclass(frozen=True)
class _Known:
    """What is known before a fit; see `fit_labelled`."""

    initializer: Initializer | None = None
    latest: Calibration | None = None
    prior_std: Tensor | None = None
    fits: tuple[Solution, ...] = ()  # of all labels, where they have been made already; see `SteadyPart`


def _fitted(
    given: Arranged, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions, known: _Known
) -> Calibration:
    """Do the work of `fit_labelled` for snapshots that all have a pose."""
    arranged = given
    while True:
        try:
            return _fitted_once(arranged, rig, obj, options, known)
        except UndeterminedPosesError as error:
            arranged, known = arranged.without(error.rows, rig, obj), replace(known, fits=())
            left, count = len(arranged.labelled.used), len(given.labelled.used)
            if left < LEAST_KEPT * count:
                raise RefusedError(
                    f"{error} (found {count - left} of {count} such snapshots): some fiducial is not where the object "
                    "file says"
                ) from error


def _fitted_once(
    arranged: Arranged, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions, known: _Known
) -> Calibration:
    """Fit, unless without outliers some snapshots do not say where the object is."""
    labelled, observations, latest = arranged.labelled, arranged.observations, known.latest
    variance, labels = observations.sigma.numpy() ** 2, observations.seen.numpy()
    require_cameras(labels, rig, options)
    alike = labelled.identity == "ambiguous" and len(labelled.used) > 1
    if alike and obj.tolerance is not None and bool(obj.tolerance.any()):
        raise RefusedError(
            "object: it can be turned into itself, and each snapshot may have the labels of another turn: where its "
            "fiducials are within their tolerances cannot be estimated",
            python="give labels (Detections.fiducial), use an object without symmetry, or one without tolerances",
            command="give labels (a column `fiducial`), use an object without symmetry, or one without tolerances",
        )
    prior = (rig.prior or RigPrior()).std(rig) if known.prior_std is None else known.prior_std
    problem = make_problem(observations, rig, _with_learnt(obj, latest), prior)
    guess = None if known.initializer is None else known.initializer.guess(observations, rig, obj)
    guess_used = guess is not None and _nearer(guess, Prediction(rig, arranged.poses), observations, obj)
    first = Start(initial_state(problem, arranged.poses, None), options.identity_error)
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
    fit = make_estimate(found.problem, found.solution, found.solution.state)
    require_same_residuals(fit, observations, found.seen, obj)
    shape = object_offsets(fit, found.shape, obj)
    scatter = BlockScatter()
    if latest is None:
        scatter = block_scatter(found.problem, found.solution, make_loss(options.estimation))
        fit = replace(fit, inflation=scatter.factor)
    outliers = int(labels.sum() - found.seen.sum())
    require_cameras(found.seen, rig, options)
    require_near_prior(fit, prior, rig, found.prior_scale, options)
    require_most_labels(labels, found.seen, rig)
    require_fit(found.additive_noise, outliers / max(int(labels.sum()), 1), 2**0.5 * float(fit.rms), options)
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


def _with_learnt(obj: CalibrationObject, latest: Calibration | None) -> CalibrationObject:
    """The object with the tolerances that the latest result has found necessary."""
    learnt = None if latest is None else latest.estimate.problem.object_prior_std
    return obj if learnt is None else replace(obj, tolerance=learnt[0, :-1:3])


def _require_any_view(arranged: Arranged, rig: CameraRig, obj: CalibrationObject) -> None:
    """Refuse where a camera sees the object, and identity could not label any of it: worse than seeing nothing."""
    labels = arranged.observations.seen.numpy()
    require_views(tally(arranged.labelled, labels, arranged.poses, rig, obj), rig, least_share=0.0)


def _nearer(guess: Initialization, factory: Prediction, observations: Observations, obj: CalibrationObject) -> bool:
    """Tell whether the start that a guess gives, its mean rig, is nearer to the images than the factory calibration."""
    start = Prediction(guess.rig, guess.rig_from_object)
    return bool(residual_of(start, observations, obj).norm() < residual_of(factory, observations, obj).norm())


def finite(value: float) -> float | None:
    """None for what is not known."""
    return value if np.isfinite(value) else None
