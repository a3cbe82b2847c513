"""From blobs to a recalibrated rig: identity snapshot by snapshot, then one estimate over all of them.

`calibrate` and `score` are what the commands of the same names do, on values in memory. Neither reads nor writes files.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.detection import DetectionOptions, detect
from imgcal.detection.options import Frame
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import Estimate, EstimationOptions, camera_std, estimate
from imgcal.identity import Identity, IdentityOptions, identify
from imgcal.objects import CalibrationObject
from imgcal.observations import Detections, Observations
from imgcal.rig import PARAMETER_NAMES, CameraRig, RigPrior
from imgcal.transforms import RigidTransform

Frames = Mapping[str, Frame | Sequence[Frame | None] | None]
MOST_REMEMBERED = 64
"""Snapshots that take part in refits of the rig while identity goes on: later ones add little to it."""

Progress = Callable[[Iterable[int], int], Iterable[int]]


@dataclass(frozen=True)
class PipelineOptions:
    """How sure the pipeline must be before it gives an answer."""

    identity: IdentityOptions = IdentityOptions()
    estimation: EstimationOptions = EstimationOptions()
    identity_error: float = (
        0.3  # px: what a centre may be off beyond its own sigma (partly hidden markers) while blobs are told apart
    )
    least_fiducials: int = 4  # different fiducials that a snapshot must show, all cameras together
    outlier: float = 5.0  # standard deviations beyond which a labelled blob is left out
    most_outliers: float = 0.25  # share of left-out blobs above which the data do not fit the object
    largest_model_error: float = 1.0  # px: unexplained residual above which the data do not fit the camera model
    largest_drift: float = 10.0  # prior standard deviations that one factory value may be off
    widest_prior: float = 4.0  # factor by which a kind of factory values may have drifted more than the prior says
    blind_cameras: bool = False  # accept cameras that saw nothing; they keep their factory values


@dataclass(frozen=True)
class SnapshotIdentity:
    """What was decided about one snapshot."""

    name: str
    status: str  # coded | unique | by_prior | by_tracking | ambiguous | refused
    reason: str
    alternatives: int
    rig_from_object: RigidTransform | None


@dataclass(frozen=True)
class Labelled:
    """Detections with a fiducial for every blob that has one, and how that was decided."""

    detections: Detections  # `fiducial` filled in, -1 = not used
    snapshots: tuple[SnapshotIdentity, ...]  # S

    @property
    def used(self) -> list[int]:
        """Numbers of the snapshots that are not refused."""
        return [i for i, snapshot in enumerate(self.snapshots) if snapshot.status != "refused"]

    @property
    def identity(self) -> str:
        """How identity was decided as a whole: that of the first snapshot, which the others follow."""
        used = self.used
        return self.snapshots[used[0]].status if used else "refused"


@dataclass(frozen=True)
class Calibration(Estimate):
    """An `Estimate`, with what it was made from. Snapshots are those used, in order."""

    labelled: Labelled
    observations: Observations  # (S, C, N) as used: outliers not seen, sigma with the model error
    model_error: float  # px, what the residuals hold beyond the blobs' own sigma
    outliers: int  # labelled blobs left out
    widened: Mapping[str, float]  # by kind of value: factor by which the prior was too narrow, where it was
    factory: CameraRig
    obj: CalibrationObject
    seconds: Mapping[str, float] = field(default_factory=dict)  # by stage

    @cached_property
    def before(self) -> Estimate:
        """The factory rig as it stands on the same observations: only the poses are fitted."""
        return estimate(
            self.observations,
            self.factory,
            self.obj,
            self.rig_from_object,
            spread=torch.zeros_like(self.problem.spread[0]),
        )

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
    progress: Progress | None = None,
) -> Calibration:
    """Recalibrate a rig from what its cameras saw.

    Args:
        source: blobs, labelled or not, or frames in memory (see `imgcal.detect`).
        rig: the factory calibration, without batch axes.
        obj: the calibration object.
        options: how sure the result must be.
        detection: how blobs are found in frames.
        progress: wraps the loop over snapshots, for a progress bar.

    Raises:
        RefusedError: the data cannot decide; the message says why.
        InputError: the data do not belong to this rig or object.
    """
    started = time.perf_counter()
    detections = source if isinstance(source, Detections) else detect(source, detection)
    detections = matched_to_rig(detections, rig)
    found = time.perf_counter()
    labelled = label(detections, rig, obj, options, progress)
    identified = time.perf_counter()
    fit = fit_labelled(labelled, rig, obj, options)
    seconds = {
        "detection": found - started,
        "identity": identified - found,
        "estimation": time.perf_counter() - identified,
    }
    return replace(fit, seconds=seconds)


def label(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    progress: Progress | None = None,
) -> Labelled:
    """Decide which blob is which fiducial, snapshot by snapshot.

    Each accepted snapshot predicts the next one. What the accepted ones say about the rig narrows the search in the
    following; refused ones are tried once more at the end, with the rig that all the others gave.

    Raises:
        RefusedError: no snapshot could be decided.
    """
    count = len(detections.snapshot_names)
    coded = _coded_snapshots(detections, count)
    follower = Follower(rig, obj, options)
    results: dict[int, tuple[SnapshotIdentity, NDArray[np.int64]]] = {}
    rows = [np.flatnonzero((detections.snapshot == s) & detections.usable) for s in range(count)]

    def decide(s: int) -> None:
        labels = detections.fiducial[rows[s]] if coded[s] else None
        results[s] = follower.decide(detections.select(rows[s]), detections.snapshot_names[s], labels)

    order: Iterable[int] = range(count)
    for s in progress(order, count) if progress else order:
        decide(s)
    again = [s for s in range(count) if not coded[s] and _incomplete(*results[s], detections.camera[rows[s]])]
    if again and any(results[s][0].status != "refused" for s in range(count)):
        for s in again:
            decide(s)
    fiducial = np.full(len(detections), -1, dtype=np.int64)
    for s in range(count):
        if results[s][0].status != "refused":
            fiducial[rows[s]] = results[s][1]
    labelled = Labelled(replace(detections, fiducial=fiducial), tuple(results[s][0] for s in range(count)))
    if not labelled.used:
        reasons = Counter(snapshot.reason for snapshot in labelled.snapshots).most_common(1)
        why = f"{reasons[0][0]} ({reasons[0][1]} of {count} snapshots)" if count else "found no snapshot"
        raise RefusedError(f"identity: {why}")
    return labelled


def _incomplete(snapshot: SnapshotIdentity, labels: NDArray[np.int64], camera: NDArray[np.int64]) -> bool:
    """Tell whether another try may help: the snapshot was refused, or no blob of some camera (M,) has a label."""
    return snapshot.status == "refused" or not np.isin(camera, camera[labels >= 0]).all()


class Follower:
    """Carries what earlier snapshots say, the pose and the rig, to the next one."""

    def __init__(self, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions) -> None:
        self.factory, self.obj, self.options = rig, obj, options
        self.rig = rig
        self.spread = (rig.prior or RigPrior()).std(rig)
        # Many captures are taken with the object at the origin of the rig's frame; it costs little to look there first.
        self.pose = RigidTransform.identity(dtype=rig.focal_length.dtype)
        self.accepted: list[tuple[Detections, NDArray[np.int64], RigidTransform]] = []

    def decide(
        self, blobs: Detections, name: str, labels: NDArray[np.int64] | None
    ) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        """Label the blobs of one snapshot; `labels` are given when they are coded."""
        identity, status = None, "coded"
        if labels is None:
            identity = self._identify(blobs)
            labels, status = identity.labels, identity.status
        shown = len(np.unique(labels[labels >= 0]))
        if identity is not None and not identity.accepted:
            return SnapshotIdentity(name, "refused", identity.reason, identity.alternatives, None), labels
        if shown < self.options.least_fiducials:
            reason = f"too few fiducials: found {shown}, expected at least {self.options.least_fiducials}"
            return SnapshotIdentity(name, "refused", reason, 1, None), labels
        if identity is None:
            return SnapshotIdentity(name, status, "labelled in the input", 1, None), labels
        assert identity.rig_from_object is not None  # an accepted identity has a pose
        self._remember(blobs, labels, identity.rig_from_object)
        return SnapshotIdentity(name, status, identity.reason, identity.alternatives, identity.rig_from_object), labels

    def _identify(self, blobs: Detections) -> Identity:
        blobs = replace(blobs, sigma=np.hypot(blobs.sigma, self.options.identity_error))
        return identify(blobs, self.rig, self.obj, self.spread, [self.pose], self.options.identity)

    def _remember(self, blobs: Detections, labels: NDArray[np.int64], pose: RigidTransform) -> None:
        """Keep the pose; refit the rig after 1, 2, 4, 8, ... accepted snapshots."""
        self.pose = pose
        if len(self.accepted) == MOST_REMEMBERED:
            return
        self.accepted.append((blobs, labels, pose))
        count = len(self.accepted)
        if count & (count - 1):
            return
        parts = [to_observations(replace(b, fiducial=given), self.factory, self.obj) for b, given, _ in self.accepted]
        sigma = (torch.cat([p.sigma for p in parts]).square() + self.options.identity_error**2).sqrt()
        observations = Observations(torch.cat([p.uv for p in parts]), sigma, torch.cat([p.seen for p in parts]))
        poses = _stack([p for _, _, p in self.accepted])
        fit = estimate(observations, self.factory, self.obj, poses, options=self.options.estimation)
        if bool(fit.converged):
            prior = (self.factory.prior or RigPrior()).std(self.factory)
            self.rig, self.spread = fit.rig, torch.minimum(2 * camera_std(fit), prior)


def matched_to_rig(detections: Detections, rig: CameraRig) -> Detections:
    """Renumber the cameras of detections in the order of the rig.

    Raises:
        InputError: a camera that the rig does not have.
    """
    unknown = [name for name in detections.camera_names if name not in rig.camera_names]
    if unknown:
        raise InputError(
            f"detections: found camera {', '.join(unknown)}, expected cameras of rig {rig.name}: "
            f"{', '.join(rig.camera_names)}"
        )
    index = np.array([rig.camera_names.index(name) for name in detections.camera_names], dtype=np.int64)
    camera = index[detections.camera] if len(detections) else detections.camera
    return replace(detections, camera=camera, camera_names=rig.camera_names)


def to_observations(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Observations:
    """Arrange labelled blobs densely: (S, C, N). Of two blobs with one label in a camera the last one counts."""
    snapshots = np.unique(detections.snapshot) if len(detections) else np.empty(0, dtype=np.int64)
    shape = (max(len(snapshots), 1), rig.cameras, obj.fiducials)
    rows = np.flatnonzero(detections.fiducial >= 0)
    where = (np.searchsorted(snapshots, detections.snapshot[rows]), detections.camera[rows], detections.fiducial[rows])
    uv, sigma, seen = np.zeros((*shape, 2)), np.ones(shape), np.zeros(shape, dtype=bool)
    uv[where], sigma[where], seen[where] = detections.uv[rows], detections.sigma[rows], True
    dtype = rig.focal_length.dtype
    return Observations(torch.from_numpy(uv).to(dtype), torch.from_numpy(sigma).to(dtype), torch.from_numpy(seen))


def _coded_snapshots(detections: Detections, count: int) -> NDArray[np.bool_]:
    """Tell which snapshots come with labels."""
    coded = np.zeros(count, dtype=bool)
    coded[detections.snapshot[detections.fiducial >= 0]] = True
    return coded


def fit_labelled(
    labelled: Labelled,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
) -> Calibration:
    """Estimate the rig from all labelled snapshots, leaving out what does not fit, and check that the rest does.

    Args:
        labelled: from `label`.
        rig: the factory calibration.
        obj: the calibration object.
        options: how sure the result must be.

    Raises:
        RefusedError: a camera saw nothing, the estimate has no minimum, or the residuals do not fit.
    """
    observations, poses = _used(labelled, rig, obj)
    _require_cameras(observations, rig, options)
    raw, model_error, guess = observations, options.identity_error, None
    spread = (rig.prior or RigPrior()).std(rig)
    widened: dict[str, float] = {}
    for _ in range(8):
        previous = model_error
        weighted = replace(observations, sigma=(raw.sigma.square() + model_error**2).sqrt())
        fit = estimate(weighted, rig, obj, poses, spread=spread, first_guess=guess, options=options.estimation)
        if not bool(fit.converged):
            raise RefusedError(
                f"estimation: no minimum after {fit.iterations} iterations (RMS {2**0.5 * float(fit.rms):.3g} px)"
            )
        model_error, poses, guess = _model_error(fit, raw.sigma), fit.rig_from_object, fit.rig
        # Judged by the sigma of this fit: what a coarse fit leaves says little about fine outliers. Where a fiducial
        # was left out there is no residual: it stays out.
        distance = fit.residual.norm(dim=-1) / weighted.sigma
        keep = observations.seen & (distance <= options.outlier)
        settled = abs(model_error - previous) <= 0.02 * previous and bool((keep == observations.seen).all())
        if settled:
            too_narrow = _too_narrow(fit)
            widened = {kind: widened.get(kind, 1.0) * factor for kind, factor in too_narrow.items()} | {
                kind: factor for kind, factor in widened.items() if kind not in too_narrow
            }
            spread = _widen(spread, too_narrow)
            settled = not too_narrow or max(widened.values()) > options.widest_prior
        observations = replace(observations, seen=keep)
        if settled:
            break
    observations = weighted
    outliers = int(raw.seen.sum()) - int(observations.seen.sum())
    _require_cameras(observations, rig, options)
    _require_near_prior(fit, rig, widened, options)
    _require_most_labels(raw, observations, rig)
    _require_fit(model_error, outliers / max(int(raw.seen.sum()), 1), 2**0.5 * float(fit.rms), options)
    values = {name: getattr(fit, name) for name in Estimate.__dataclass_fields__}
    return Calibration(
        **values,
        labelled=labelled,
        observations=observations,
        model_error=model_error,
        outliers=outliers,
        widened=widened,
        factory=rig,
        obj=obj,
    )


def _used(labelled: Labelled, rig: CameraRig, obj: CalibrationObject) -> tuple[Observations, RigidTransform | None]:
    """Observations of the accepted snapshots, and their poses where identity found all of them."""
    used = labelled.used
    detections = labelled.detections
    observations = to_observations(
        detections.select(np.isin(detections.snapshot, used) & (detections.fiducial >= 0)), rig, obj
    )
    poses = [labelled.snapshots[s].rig_from_object for s in used]
    known = [pose for pose in poses if pose is not None]
    return observations, _stack(known) if len(known) == len(used) else None


def _stack(poses: Sequence[RigidTransform]) -> RigidTransform:
    return RigidTransform(torch.stack([p.rotation for p in poses]), torch.stack([p.translation for p in poses]))


def _require_cameras(observations: Observations, rig: CameraRig, options: PipelineOptions) -> None:
    seen = observations.seen.any(-1).any(0)
    blind = [name for name, sees in zip(rig.camera_names, seen.tolist(), strict=True) if not sees]
    if blind and (not options.blind_cameras or len(blind) == rig.cameras):
        raise RefusedError(
            f"camera {', '.join(blind)}: found no fiducial in any snapshot, expected some; nothing can be said of it "
            "(--without leaves a camera out, --blind-cameras keeps its factory values)"
        )


def _require_fit(model_error: float, outlier_share: float, rms: float, options: PipelineOptions) -> None:
    if model_error > options.largest_model_error:
        raise RefusedError(
            f"estimation: residuals of {rms:.2f} px RMS do not fit the noise: found an unexplained error "
            f"of {model_error:.2f} px, expected at most {options.largest_model_error:g}; the object, the labels or the "
            "camera model are not what they are said to be"
        )
    if outlier_share > options.most_outliers:
        raise RefusedError(
            f"estimation: {100 * outlier_share:.0f} % of the labelled blobs do not fit, expected at most "
            f"{100 * options.most_outliers:.0f} %"
        )


def _model_error(fit: Estimate, sigma: Tensor) -> float:
    """Standard deviation (px, each axis) that residuals hold beyond the blobs' own sigma (S, C, N); 0 = insignificant.

    The median of squared distances over two axes is 1.386 for unit noise, whatever a minority of outliers does.
    Residuals are smaller than the noise by what the parameters took: each takes the share of one observation that its
    prior left.
    """
    seen = fit.problem.root_weight.reshape(sigma.shape) > 0
    spread = fit.problem.spread.reshape(fit.rig.distortion.shape[0], -1)
    known = torch.where(spread > 0, (camera_std(fit) / spread.clamp_min(1e-30)).square().clamp_max(1), 1.0)
    count = 2 * int(seen.sum())
    free = max(count - 6 * sigma.shape[0] - float((1 - known).sum()), 1.0)
    squared = fit.residual.square().sum(-1)[seen] * (count / free)
    variance = sigma[seen].square()

    def excess(error: float) -> float:
        return float((squared / (variance + error**2)).median()) / 1.386

    # Six standard deviations of a chi-squared mean: below, the residuals fit the sigmas that the blobs have.
    if excess(0.0) <= 1 + 6 * (2 / free) ** 0.5:
        return 0.0
    low, high = 0.0, float(squared.max().sqrt())
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 1 else (low, middle)
    return high


KINDS = {
    "rotation": slice(0, 3),
    "position": slice(3, 6),
    "focal_length": slice(6, 8),
    "principal_point": slice(8, 10),
    "distortion": slice(10, 15),
}


def _too_narrow(fit: Estimate) -> dict[str, float]:
    """Kinds of values that have drifted more than their prior allows: factor by which the prior is too narrow.

    The whitened offsets of a kind should have a mean square of one, over as many values as the data determine.
    """
    offset, spread = fit.solution.state.offset[0], fit.problem.spread[0]
    determined = 1 - (camera_std(fit) / spread.clamp_min(1e-30)).square().clamp_max(1)
    determined = torch.where(spread > 0, determined, 0.0)
    factors = {}
    for kind, part in KINDS.items():
        freedom = float(determined[:, part].sum())
        if freedom > 1:
            excess = float(offset[:, part].square().sum()) / freedom
            if excess > 1 + 4 * (2 / freedom) ** 0.5:
                factors[kind] = excess**0.5
    return factors


def _widen(spread: Tensor, factors: Mapping[str, float]) -> Tensor:
    spread = spread.clone()
    for kind, factor in factors.items():
        spread[:, KINDS[kind]] *= factor
    return spread


def _require_near_prior(fit: Estimate, rig: CameraRig, widened: Mapping[str, float], options: PipelineOptions) -> None:
    prior = (rig.prior or RigPrior()).std(rig)
    drift = (fit.solution.state.offset[0] * fit.problem.spread[0] / prior.clamp_min(1e-30)).abs()
    drift = torch.where(prior > 0, drift, 0.0)
    camera, parameter = divmod(int(drift.argmax()), drift.shape[1])
    largest = float(drift[camera, parameter])
    wide = max(widened.values(), default=1.0)
    if largest > options.largest_drift or wide > options.widest_prior:
        raise RefusedError(
            f"estimation: camera {rig.camera_names[camera]}: {PARAMETER_NAMES[parameter]} is {largest:.1f} prior "
            f"standard deviations off its factory value, expected at most {options.largest_drift:g}, and "
            f"{options.widest_prior:g} for all of a kind; cameras may be swapped, labels wrong, or the prior in the "
            "rig file too narrow"
        )


def _require_most_labels(raw: Observations, kept: Observations, rig: CameraRig) -> None:
    """Refuse where most labels of one camera or one fiducial do not fit: they are not what they are said to be."""
    for name, axes, names in (("camera", (0, 2), rig.camera_names), ("fiducial", (0, 1), None)):
        before, after = raw.seen.sum(axes), kept.seen.sum(axes)
        bad = torch.nonzero((before >= 6) & (after < 0.5 * before)).flatten().tolist()
        if bad:
            which = ", ".join(str(i) if names is None else names[i] for i in bad)
            raise RefusedError(
                f"estimation: {name} {which}: most labels do not fit the rest (frames of another moment, swapped "
                "labels, or a fiducial that has moved)"
            )


@dataclass(frozen=True)
class Score:
    """Reprojection errors of a rig that is held fixed; only the object's poses are fitted."""

    labelled: Labelled
    residual: Tensor  # (S, C, N, 2) pixels
    seen: Tensor  # (S, C, N) bool

    @property
    def distances(self) -> Tensor:
        """Length of each residual: (M,) pixels."""
        return self.residual.norm(dim=-1)[self.seen]


def score(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    progress: Progress | None = None,
) -> Score:
    """Measure how well a rig explains what its cameras saw.

    Args:
        detections: blobs, labelled or not.
        rig: the rig to be scored; its prior is used for identity only.
        obj: the calibration object.
        options: how sure identity must be.
        progress: wraps the loop over snapshots.

    Raises:
        RefusedError: no snapshot could be decided.
    """
    detections = matched_to_rig(detections, rig)
    labelled = label(detections, rig, obj, options, progress)
    observations, poses = _used(labelled, rig, obj)
    fixed = torch.zeros(*rig.distortion.shape[:-1], 15, dtype=rig.distortion.dtype)
    # What is reported is an RMS in pixels: centres count alike, however well each was measured.
    even = replace(observations, sigma=torch.full_like(observations.sigma, options.identity_error))
    fit = estimate(even, rig, obj, poses, spread=fixed, options=options.estimation)
    if not bool(fit.converged):
        raise RefusedError(f"score: no pose of the object fits (RMS {2**0.5 * float(fit.rms):.3g} px)")
    return Score(labelled, fit.residual, observations.seen)
