"""The paper's protocol: many random rigs, several trials, every method on the same rigs."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypedDict

import torch
from torch import Tensor

from imgcal.errors import InputError, RefusedError
from imgcal.estimation import Estimate
from imgcal.evaluation.methods import Given, Method
from imgcal.evaluation.metrics import KINDS, Errors, concatenate, cramer_rao, errors
from imgcal.messages import shortened
from imgcal.refinement import SQUARED, as_prediction, refine_points
from imgcal.synthesis import LEVELS, Corrupted, Corruption, Degradation, Drift, PoseRange, RelativeDrift, synthesize
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views

REFERENCE = "MAP, true inliers"
LEAST_FIDUCIALS = 3  # different ones that a pose needs
LEAST_SIGMA = 0.02  # pixels: what exact points are believed to

Progress = Callable[[int], None]
"""Called with a number of rigs whenever that many have been given to one more method."""


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
        """What methods are told about the noise: pixels."""
        return max(self.corruption.noise, LEAST_SIGMA)


@dataclass(frozen=True)
class Protocol:
    """How much to evaluate."""

    count: int = 20_000  # rigs a trial
    trials: int = 3
    seed: int = 0
    batch: int = 512  # rigs at once at most
    bound_count: int = 512  # rigs of a trial whose Cramer-Rao bounds are evaluated, where there is noise

    def __post_init__(self) -> None:
        for name, least, most in (
            ("count", 1, 10**7), ("trials", 1, 1000), ("batch", 1, 10**5), ("seed", 0, 2**47 - 1),
        ):  # fmt: skip
            if not least <= getattr(self, name) <= most:
                raise InputError(f"{name}: found {shortened(str(getattr(self, name)))}, expected {least} to {most}")


class Statistics(TypedDict):
    """An error in pixels, over all rigs of all trials."""

    rigs: int
    mean: float  # over rigs, averaged over trials
    spread: float | None  # standard deviation of the trials' means; None = one trial
    trial_means: tuple[float, ...]
    median: float
    p95: float
    p99: float
    share_under_half_px: float
    share_under_one_px: float


@dataclass(frozen=True)
class Scores:
    """Errors of one column over all trials."""

    trials: tuple[Errors, ...]
    bounds: tuple[Errors, ...]  # of the first rigs of each trial

    @property
    def re(self) -> Tensor:
        """RE of all rigs of all trials, pixels."""
        return torch.cat([trial.re for trial in self.trials])

    def statistics(self, kind: Literal["re", "held_out"] = "re") -> Statistics:
        """Sum up RE, on the object's own points or on those that took no part."""
        values = [getattr(trial, kind) for trial in self.trials]
        means = [float(trial.mean()) for trial in values]
        re = torch.cat(values).double()
        median, p95, p99 = re.quantile(re.new_tensor((0.5, 0.95, 0.99))).tolist()
        return Statistics(
            rigs=len(re),
            mean=statistics.fmean(means),
            spread=statistics.stdev(means) if len(means) > 1 else None,
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


def evaluate(
    methods: Mapping[str, Method],
    conditions: Conditions,
    protocol: Protocol = Protocol(),
    progress: Progress = lambda rigs: None,
) -> Evaluation:
    """Measure methods on random rigs.

    Args:
        methods: by the name that they get in tables.
        conditions: what rigs are drawn from, and how their views are corrupted.
        protocol: how many rigs; the same seed gives the same rigs, whatever the methods are.
        progress: called after each method has done a batch.

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
    done: dict[str, list[_Collected]] = {name: [] for name in methods}
    reference: list[Errors] = []
    bounds: list[Errors] = []
    for trial in range(protocol.trials):
        parts = {name: _Collected() for name in methods}
        exact: list[Errors] = []
        limits: list[Errors] = []
        for first, batch in _batches(conditions, protocol, trial):
            fit = batch.reference()
            exact.append(errors(as_prediction(fit), batch.truth, conditions.obj))
            if first < protocol.bound_count and conditions.corruption.noise >= LEAST_SIGMA:
                limits.append(cramer_rao(fit, conditions.obj))
            progress(len(batch))
            for name, method in methods.items():
                _measure(name, method, batch, first, parts[name])
                progress(len(batch))
        reference.append(concatenate(exact))
        bounds.extend([concatenate(limits)] if limits else [])
        for name, collected in parts.items():
            done[name].append(collected)
    limits_of_trials = tuple(bounds)
    rows = {name: _row(collected, limits_of_trials) for name, collected in done.items()}
    return Evaluation(conditions, protocol, rows, Scores(tuple(reference), limits_of_trials))


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
        """What methods may use, of some of the rigs."""
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


def _batches(conditions: Conditions, protocol: Protocol, trial: int) -> Iterator[tuple[int, Sample]]:
    """Rigs of a trial with the number of the first one of each batch."""
    generator = torch.Generator().manual_seed(protocol.seed * 65_536 + trial)
    for first in range(0, protocol.count, protocol.batch):
        yield first, draw(conditions, min(protocol.batch, protocol.count - first), generator)


def _measure(name: str, method: Method, batch: Sample, first: int, into: _Collected) -> None:
    """Give a method those rigs of a batch that are its share, a few at a time.

    Raises:
        InputError: a rig sees too few fiducials.
        RefusedError: the method has met a singular system for another reason.
    """
    count = len(batch) if method.most is None else max(0, min(len(batch), method.most - first))
    size = method.batch or max(count, 1)
    for start in range(0, count, size):
        rows = slice(start, min(start + size, count))
        given = batch.given(rows)
        truth = batch.truth[rows]
        try:
            passes = method.passes(given) if method.passes is not None else (method.predict(given),)
        except torch.linalg.LinAlgError as error:
            least = int(given.seen.any(1).sum(-1).min())
            if least < LEAST_FIDUCIALS:
                raise InputError(
                    f"missing: found {batch.conditions.corruption.missing:g}, expected a smaller share: of one rig "
                    f"{least} fiducials are left, and a pose needs {LEAST_FIDUCIALS}"
                ) from error
            raise RefusedError(
                f"evaluation: {name}: a system of equations has no solution ({error}), though every rig sees at least "
                f"{least} different fiducials: an object on one line, or a fault of this method"
            ) from error
        into.passes = len(passes)
        into.alone.append(errors(passes[-1], truth, given.obj))
        if len(passes) > 1:
            into.one_pass.append(errors(passes[0], truth, given.obj))
        if method.refine is not None:
            into.refined.append(errors(method.refine(passes[-1], given), truth, given.obj))


def _row(trials: Sequence[_Collected], bounds: tuple[Errors, ...]) -> Row:
    def column(parts: Sequence[list[Errors]]) -> Scores | None:
        return Scores(tuple(map(concatenate, parts)), bounds) if parts[0] else None

    alone = column([trial.alone for trial in trials])
    assert alone is not None  # every method predicts
    refined, one_pass = column([trial.refined for trial in trials]), column([trial.one_pass for trial in trials])
    return Row(alone, refined, one_pass, trials[0].passes)


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
