"""The paper's protocol: many random rigs, several trials, every method on the same rigs."""

from __future__ import annotations

import hashlib
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, TypedDict

import torch
from torch import Tensor

from imgcal.errors import InputError, RefusedError
from imgcal.estimation import Estimate
from imgcal.evaluation.methods import Given, Method
from imgcal.evaluation.metrics import KINDS, Errors, concatenate, cramer_rao, errors
from imgcal.io import rig_text
from imgcal.messages import shorten
from imgcal.refinement import SQUARED, make_prediction, refine_points
from imgcal.synthesis import LEVELS, Corrupted, Corruption, Degradation, Drift, PoseRange, RelativeDrift, synthesize
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views

REFERENCE = "MAP, true inliers"
LEAST_FIDUCIALS = 3  # different ones that a pose needs
LEAST_SIGMA = 0.02  # pixels: what exact points are believed to
STAGES = ("alone", "refined", "one_pass")

Progress = Callable[[int], None]
"""Called with the number of rigs that were just given to a method."""


@dataclass(frozen=True)
class Conditions:
    """What random rigs are drawn from, and what happens to their views."""

    rig: CameraRig  # factory, float64, without batch axes
    obj: CalibrationObject
    pose_range: PoseRange = PoseRange()
    drift: Drift = RelativeDrift()
    corruption: Corruption = Corruption()
    degradation: Degradation = Degradation()  # of images, beside what happens to the points that are drawn

    def at_level(self, level: int) -> Conditions:
        """Return these conditions with points and images as hard as one of `imgcal.synthesis.LEVELS`."""
        hard = LEVELS[level]
        return replace(self, corruption=hard.points, degradation=replace(hard, points=Corruption()))

    @property
    def sigma(self) -> float:
        """The noise that methods are given: pixels."""
        return max(self.corruption.noise, LEAST_SIGMA)


@dataclass(frozen=True)
class Protocol:
    """How much to evaluate."""

    count: int = 20_000  # rigs a trial
    trials: int = 3
    seed: int = 0
    batch: int = 512  # rigs at once at most
    bound_count: int = 512  # rigs of a trial whose Cramer-Rao bounds are evaluated, where there is noise

    @property
    def batches(self) -> int:
        """Batches of all trials: the work items of `evaluate`."""
        return self.trials * -(-self.count // self.batch)

    def __post_init__(self) -> None:
        for name, least, most in (
            ("count", 1, 10**7), ("trials", 1, 1000), ("batch", 1, 10**5), ("seed", 0, 2**47 - 1),
        ):  # fmt: skip
            if not least <= getattr(self, name) <= most:
                raise InputError(f"{name}: found {shorten(str(getattr(self, name)))}, expected {least} to {most}")


class Statistics(TypedDict):
    """An error in pixels, over all rigs of all trials; means and quantiles of those for which something was found."""

    rigs: int
    found: float  # share of the rigs for which something was found: a refinement may fail
    mean: float  # over rigs, averaged over trials
    spread: float | None  # standard deviation of the trials' means; None = one trial
    trial_means: tuple[float, ...]
    median: float
    p95: float
    p99: float
    share_under_half_px: float  # of all rigs
    share_under_one_px: float


@dataclass(frozen=True)
class Scores:
    """Errors of one column over all trials; nan where nothing was found."""

    trials: tuple[Errors, ...]
    bounds: tuple[Errors, ...]  # of the first rigs of each trial

    @property
    def re(self) -> Tensor:
        """RE of all rigs of all trials: (trials * rigs,) pixels."""
        return torch.cat([trial.re for trial in self.trials])

    def statistics(self, kind: Literal["re", "held_out"] = "re") -> Statistics:
        """Summarize RE, on the object's own points or on held-out ones."""
        values = [getattr(trial, kind) for trial in self.trials]
        means = [float(trial.nanmean()) for trial in values]
        re = torch.cat(values).double()
        median, p95, p99 = re.nanquantile(re.new_tensor((0.5, 0.95, 0.99))).tolist()
        there = [mean for mean in means if not math.isnan(mean)]
        return Statistics(
            rigs=len(re),
            found=1 - float(re.isnan().double().mean()),
            mean=statistics.fmean(there) if there else math.nan,
            spread=statistics.stdev(there) if len(there) > 1 else None,
            trial_means=tuple(means),
            median=median,
            p95=p95,
            p99=p99,
            share_under_half_px=float((re < 0.5).double().mean()),
            share_under_one_px=float((re < 1.0).double().mean()),
        )

    def parameters(self) -> dict[str, float]:
        """Root mean square over rigs of the errors of a rig's values."""
        joined = concatenate(self.trials)
        return {kind: _rms(getattr(joined, kind)) for kind in KINDS if kind not in ("re", "held_out")}

    def cramer_rao_ratios(self) -> dict[str, float | None]:
        """Root mean square error over root mean square bound, on the rigs that have a bound; None where it is zero."""
        if not self.bounds:
            return dict.fromkeys(KINDS)
        pairs = [(trial, bound) for trial, bound in zip(self.trials, self.bounds, strict=True)]
        shared = [min(len(trial), len(bound)) for trial, bound in pairs]
        found = concatenate([trial[:count] for (trial, _), count in zip(pairs, shared, strict=True)])
        bound = concatenate([bound[:count] for (_, bound), count in zip(pairs, shared, strict=True)])
        bound = bound.where(~found.re.isnan())
        limits = {kind: _rms(getattr(bound, kind)) for kind in KINDS}
        return {kind: _rms(getattr(found, kind)) / limit if limit > 0 else None for kind, limit in limits.items()}


@dataclass(frozen=True)
class Row:
    """One method: alone, refined where it has a refinement, and after the first of several passes."""

    alone: Scores
    refined: Scores | None = None
    one_pass: Scores | None = None
    passes: int = 1


@dataclass(frozen=True)
class Evaluation:
    """Every method on the same rigs, and what MAP estimation makes of the true inliers, from the truth."""

    conditions: Conditions
    protocol: Protocol
    rows: Mapping[str, Row]
    reference: Scores


@dataclass
class _Collected:
    """Errors of one trial, batch by batch."""

    alone: list[Errors] = field(default_factory=list)
    refined: list[Errors] = field(default_factory=list)
    one_pass: list[Errors] = field(default_factory=list)
    passes: int = 1

    def add(self, found: Mapping[str, Any]) -> None:
        """Add the errors of a batch."""
        for name in STAGES:
            if found[name]:
                getattr(self, name).append(Errors(**found[name]))
        self.passes = found["passes"] or self.passes


def evaluate(
    methods: Mapping[str, Method],
    conditions: Conditions,
    protocol: Protocol = Protocol(),
    progress: Progress = lambda rigs: None,
    mapped: Callable[..., Iterator[Any]] = map,
) -> Evaluation:
    """Measure methods on random rigs.

    Args:
        methods: by the name that they get in tables.
        conditions: what rigs are drawn from, and how their views are corrupted.
        protocol: how many rigs; the same seed gives the same rigs, whatever the methods are.
        progress: called after each batch.
        mapped: measures batches; called like `map`. Rigs are drawn here and sent along, so that the results do not
            depend on who measures (`imgcal.fleet.workers`).

    Raises:
        RefusedError: too few random rigs see the whole object.

    Examples:
        >>> import imgcal
        >>> from imgcal.evaluation import BASELINES
        >>> conditions = Conditions(imgcal.load_rig("T4"), imgcal.load_object("cube8"))
        >>> name = "factory, pose fitted"
        >>> evaluation = evaluate({name: BASELINES[name]}, conditions, Protocol(count=4, trials=1, bound_count=4))
        >>> list(evaluation.rows) == [name]
        True
    """
    done: dict[str, list[_Collected]] = {name: [_Collected() for _ in range(protocol.trials)] for name in methods}
    reference: list[list[Errors]] = [[] for _ in range(protocol.trials)]
    bounds: list[list[Errors]] = [[] for _ in range(protocol.trials)]
    for found in mapped(partial(_run_methods, dict(methods)), _draw_batches(methods, conditions, protocol)):
        trial = found["trial"]
        reference[trial].append(Errors(**found["reference"]))
        if found["bounds"]:
            bounds[trial].append(Errors(**found["bounds"]))
        for name, collected in done.items():
            collected[trial].add(found["rows"][name])
        progress(found["rigs"])
    limits = tuple(concatenate(parts) for parts in bounds if parts)
    rows = {name: _row(collected, limits) for name, collected in done.items()}
    exact = Scores(tuple(concatenate(parts) for parts in reference), limits)
    return Evaluation(conditions, protocol, rows, exact)


@dataclass(frozen=True)
class Sample:
    """Random rigs, the truth about them, and what methods are given."""

    truth: Prediction  # (B,)
    corrupted: Corrupted  # (B,)
    conditions: Conditions
    seed: int = 0  # of what happens to images

    def __len__(self) -> int:
        return len(self.corrupted.views)

    def given(self, rows: slice = slice(None)) -> Given:
        """What methods may use of some of the rigs."""
        views, known = self.corrupted.views, self.conditions
        assert views.uv is not None and views.seen is not None  # points are what is corrupted
        some = Views(uv=views.uv[rows], seen=views.seen[rows])
        # Methods that look at rigs in parts of the same size are given the same images.
        seed = self.seed + (rows.start or 0)
        return Given(some, known.rig, known.obj, known.drift.std(known.rig), known.sigma, known.degradation, seed)

    def reference(self) -> Estimate:
        """MAP estimate of the true inliers from the truth, squared loss."""
        given = self.given()
        inliers = Views(uv=given.uv, seen=self.corrupted.inlier)
        return refine_points(self.truth, inliers, given.factory, given.obj, given.prior_std, given.sigma, SQUARED)


def draw(conditions: Conditions, count: int, generator: torch.Generator) -> Sample:
    """Draw random rigs and corrupt what they see."""
    made = synthesize(
        conditions.rig, conditions.obj, count, generator, drift=conditions.drift, pose_range=conditions.pose_range
    )
    views = Views(uv=made.projection.uv, seen=made.projection.visible)
    corrupted = conditions.corruption.apply(views, conditions.rig.image_size, generator)
    seed = 0
    if conditions.degradation != Degradation():
        seed = int(torch.randint(2**40, (), generator=generator))
    return Sample(Prediction(made.rig, made.rig_from_object), corrupted, conditions, seed)


@dataclass(frozen=True)
class _Batch:
    """A batch of a trial: a work item."""

    trial: int
    first: int  # number of its first rig in the trial
    sample: Sample
    bounded: bool  # its Cramer-Rao bounds are wanted
    methods: tuple[str, ...]

    @property
    def key(self) -> str:
        """Digest of all that results depend on, apart from the methods."""
        known, given, truth = self.sample.conditions, self.sample.given(), self.sample.truth
        said = (self.trial, self.first, self.bounded, self.methods, given.seed, known.corruption, known.degradation)
        digest = hashlib.blake2b(f"{said}\n{known.obj.radius}\n{rig_text(known.rig)}".encode(), digest_size=16)
        pose, drawn = truth.rig_from_object, truth.rig
        for tensor in (
            given.prior_std, given.obj.points, given.uv, given.seen, self.sample.corrupted.inlier, pose.rotation,
            pose.translation, drawn.focal_length, drawn.principal_point, drawn.distortion, drawn.cam_from_rig.rotation,
            drawn.cam_from_rig.translation,
        ):  # fmt: skip
            digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()


def _draw_batches(methods: Mapping[str, Method], conditions: Conditions, protocol: Protocol) -> Iterator[_Batch]:
    """Draw all rigs, a batch at a time."""
    for trial in range(protocol.trials):
        generator = torch.Generator().manual_seed(protocol.seed * 65_536 + trial)
        for first in range(0, protocol.count, protocol.batch):
            sample = draw(conditions, min(protocol.batch, protocol.count - first), generator)
            bounded = first < protocol.bound_count and conditions.corruption.noise >= LEAST_SIGMA
            yield _Batch(trial, first, sample, bounded, tuple(methods))


def _run_methods(methods: Mapping[str, Method], batch: _Batch) -> dict[str, Any]:
    """Give a batch to all methods; what comes back is dicts of numbers and tensors."""
    sample = batch.sample
    fit = sample.reference()
    rows = {name: _measure(name, method, sample, batch.first) for name, method in methods.items()}
    return {
        "trial": batch.trial,
        "reference": vars(errors(make_prediction(fit), sample.truth, sample.conditions.obj)),
        "bounds": vars(cramer_rao(fit, sample.conditions.obj)) if batch.bounded else None,
        "rows": rows,
        "rigs": len(sample) + sum(row["rigs"] for row in rows.values()),
    }


def _measure(name: str, method: Method, batch: Sample, first: int) -> dict[str, Any]:
    """Give a method those rigs of a batch that are its share, a few at a time: errors of each stage, or None.

    Raises:
        InputError: a rig sees too few fiducials.
        RefusedError: the method has met a singular system for another reason.
    """
    count = len(batch) if method.most is None else max(0, min(len(batch), method.most - first))
    size = method.batch or max(count, 1)
    found: dict[str, list[Errors]] = {name: [] for name in STAGES}
    number = 0
    for start in range(0, count, size):
        rows = slice(start, min(start + size, count))
        given = batch.given(rows)
        truth = batch.truth[rows]
        least = int(given.seen.any(1).sum(-1).min())
        if least == 0:
            raise _make_missing_error(batch, least)
        try:
            passes = method.passes(given) if method.passes is not None else (method.predict(given),)
        except torch.linalg.LinAlgError as error:
            if least < LEAST_FIDUCIALS:
                raise _make_missing_error(batch, least) from error
            raise RefusedError(
                f"evaluation: {name}: a system of equations has no solution ({error}), though every rig sees at least "
                f"{least} different fiducials: the object lies on one line, or this method has a fault"
            ) from error
        number = len(passes)
        found["alone"].append(errors(passes[-1], truth, given.obj))
        if len(passes) > 1:
            found["one_pass"].append(errors(passes[0], truth, given.obj))
        if method.refine is not None:
            refined = method.refine(passes[-1], given)
            found["refined"].append(errors(refined.prediction, truth, given.obj).where(refined.found))
    joined = {stage: vars(concatenate(parts)) if parts else None for stage, parts in found.items()}
    return {**joined, "passes": number, "rigs": count}


def _make_missing_error(batch: Sample, least: int) -> InputError:
    """Make the error for a rig that sees only `least` fiducials."""
    return InputError(
        f"missing: found {batch.conditions.corruption.missing:g}, expected a smaller share: it leaves one rig {least} "
        f"fiducials, and a pose needs {LEAST_FIDUCIALS}"
    )


def _row(trials: Sequence[_Collected], bounds: tuple[Errors, ...]) -> Row:
    def column(parts: Sequence[list[Errors]]) -> Scores | None:
        return Scores(tuple(map(concatenate, parts)), bounds) if parts[0] else None

    alone = column([trial.alone for trial in trials])
    assert alone is not None  # every method predicts
    refined, one_pass = column([trial.refined for trial in trials]), column([trial.one_pass for trial in trials])
    return Row(alone, refined, one_pass, trials[0].passes)


def _rms(values: Tensor) -> float:
    return float(values.square().nanmean().sqrt())
