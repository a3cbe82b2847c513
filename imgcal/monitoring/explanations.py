"""Weigh all explanations of what has happened: one table, one place.

Each explanation states its prior probability and its variants: a belief, and the snapshots as they would have been. The
evidence of an explanation is the mean over its variants, so that many variants are no advantage. Values estimated
within a variant pay for their prior spread (Laplace's approximation, as in `MeasurementUpdate.evidence`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.monitoring.case import Case, Explained, Explanation, Finding, Snapshot, Start, Variant, mean_evidence
from imgcal.monitoring.change_search import FIT_CHI2_PER_DOF
from imgcal.monitoring.change_test import JUMPS
from imgcal.monitoring.clock_slip import ClockSlipExplanation
from imgcal.monitoring.lens_misfit import LensMisfit
from imgcal.monitoring.lens_warming import Warmed
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_change import MISFIT_LEAD, ObjectChanged
from imgcal.monitoring.pending_change import free_anywhere, free_cameras
from imgcal.monitoring.rig_belief import RigBelief
from imgcal.monitoring.shaking import Shaking, shake_cameras
from imgcal.monitoring.unsynchronized_cameras import LEAST_SNAPSHOTS, Unsynchronized, unsynchronized_evidence

PASSING = (2.0, 5.0)
"""Sizes of passing errors, relative to the usual size of errors."""
LEAD = 5.0
"""Log odds against the next best explanation at which one is believed ..."""
PATIENCE = 16
"""... the number of cases to wait for this, before the most probable one is believed anyway ..."""
HARMLESS_PATIENCE = 4
"""... and the same if possibly nothing has happened: after a pause, the belief allows for small moves."""

TOLERANCE = 0.01
"""Accuracy of the evidence (log odds): far below `LEAD`. What contradicts a belief converges slowly."""


class Steady(Explanation):
    """Nothing has happened."""

    name = "steady"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Keep the belief."""
        return [partial(Variant, case.before, case.latest)]


class Moved(Explanation):
    """The suspected cameras have changed in an unknown way: by each of `JUMPS`."""

    name = "moved"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Free the cameras."""
        if not case.cameras:
            raise RefusedError("no camera is suspected")
        return [partial(self._jump, case, jump) for jump in JUMPS]

    @staticmethod
    def _jump(case: Case, jump: float) -> Variant:
        """Free the cameras by a jump in pixels."""
        if jump == JUMPS[-1]:
            return Variant(free_anywhere(case.before, case.cameras, case.latest), case.latest)
        return Variant(free_cameras(case.before, dict.fromkeys(case.cameras), jump), case.latest)

    def premature(self, case: Case, found: Explained) -> str | None:
        """Wait while a clock that was always off, or some pose of the object, explains as much."""
        if case.quarantined and case.count < LEAST_SNAPSHOTS:
            return "a single snapshot of the camera"
        return "too little was seen before to exclude a late clock" if case.too_early else None


class PassingError(Explanation):
    """The suspected cameras have passing errors, several times as large as their usual persistent errors."""

    name = "passing error"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Shift the images of the cameras in each snapshot."""
        if case.lasting is None:
            raise RefusedError("this rig has no persistent errors")
        cameras = case.camera_sets[-1]
        start, size = Start(case.before, case.latest), max(float(case.lasting[camera]) for camera in cameras)
        return [partial(self._shift_images, start, cameras, factor * size) for factor in PASSING]

    @staticmethod
    def _shift_images(start: Start, cameras: Sequence[int], size: float) -> Variant:
        """Shift the images of some cameras in each snapshot; this is not reported as shaking."""
        return replace(shake_cameras(start, cameras, size), find=lambda _: Finding())


HARMLESS = {Steady.name, PassingError.name, Warmed.name, LensMisfit.name}
"""Explanations by which nothing needs a report."""
EXPLANATIONS: tuple[Explanation, ...] = (
    Steady(),
    Moved(),
    ClockSlipExplanation(),
    Unsynchronized(),
    Shaking(),
    ObjectChanged(),
    PassingError(),
    Warmed(),
    LensMisfit(),
)
"""All explanations that are weighed. To add one: a subclass as above, in its own module if long, and a line here."""


@dataclass(frozen=True)
class Verdict:
    """The probabilities of a case's explanations."""

    explained: Mapping[str, Explained]  # by name, most probable first; at least one
    reasons: Mapping[str, str]  # why the others could not be weighed

    @property
    def best(self) -> Explained:
        """The most probable explanation."""
        return next(iter(self.explained.values()))

    @property
    def lead(self) -> float:
        """Log odds of the best explanation against the next one; infinite where there is no other."""
        first, *others = self.explained.values()
        return first.evidence - max((other.evidence for other in others), default=-math.inf)

    @property
    def harmless(self) -> bool:
        """Tell whether possibly nothing has happened, and every rival is a consequence of that or passes."""
        near = {name for name, one in self.explained.items() if one.evidence > self.best.evidence - LEAD}
        return Steady.name in near and near <= HARMLESS | {Moved.name}

    def evidence(self, *names: str) -> float:
        """Largest evidence among the named explanations; minus infinity if none could be weighed."""
        return max((self.explained[name].evidence for name in names if name in self.explained), default=-math.inf)


def weigh(case: Case, explanations: Sequence[Explanation] = EXPLANATIONS) -> Verdict:
    """Compare the evidence of explanations for the same snapshots.

    Raises:
        RefusedError: none could be weighed.
    """
    found, reasons = list[Explained](), dict[str, str]()
    case = replace(case, options=replace(case.options, tolerance=max(TOLERANCE, case.options.tolerance)))
    for explanation in explanations:
        try:
            found.append(_explain(case, explanation))
        except RefusedError as reason:
            reasons[explanation.name] = str(reason)
    if not found:
        raise RefusedError("; ".join(f"{name}: {reason}" for name, reason in reasons.items()))
    found.sort(key=lambda one: -one.evidence)
    return Verdict({one.name: one for one in found}, reasons)


def _explain(case: Case, explanation: Explanation) -> Explained:
    """Average the evidence of an explanation over its variants.

    Raises:
        RefusedError: the explanation is excluded, or no variant holds.
    """
    if explanation.name in case.excluded:
        raise RefusedError(case.excluded[explanation.name])
    variants, found, failed = explanation.variants(case), [], dict[str, None]()
    for make in variants:
        try:
            variant = make()
            result = absorb(variant.before, *stack_snapshots(variant.snapshots), case.options)
            more = 0.0 if variant.more is None else variant.more(result)
        except RefusedError as reason:
            failed[str(reason)] = None
            continue
        found.append((result.evidence + variant.log_prior + more, variant, result))
    if not found:
        raise RefusedError("; ".join(failed))
    _, variant, result = max(found, key=lambda one: one[0])
    evidence = explanation.log_prior + mean_evidence([one[0] for one in found], len(variants))
    poses = result.rig_from_object
    snapshots = [(one, poses[s : s + 1]) for s, (one, _) in enumerate(variant.snapshots)]
    return Explained(explanation, evidence, variant.before, snapshots, variant.find(result))


@dataclass
class Diagnosis:
    """Weighs the cases of a rig, and waits for a while if no explanation leads."""

    waited: int = 0  # successive cases without a leading explanation

    def decide(self, case: Case, patient: bool, explanations: Sequence[Explanation] = EXPLANATIONS) -> Verdict:
        """Weigh a case; `patient`: waiting for more snapshots is possible.

        Raises:
            RefusedError: the case cannot be decided yet.
        """
        verdict = weigh(case, explanations)
        best = verdict.best
        self.waited = self.waited + 1 if verdict.lead < LEAD else 0
        patience = HARMLESS_PATIENCE if verdict.harmless else PATIENCE
        why = best.explanation.premature(case, best)
        if why is None and 0 < self.waited <= patience and patient:
            why = f"no explanation leads by {LEAD:g}"
        if why is not None:
            raise RefusedError(f"diagnosis: {best.name} is not certain yet: {why}")
        self.waited = 0
        return verdict

    def skip(self) -> bool:
        """Leave out a case in which little is new, unless the patience ends with it; return whether it is left out."""
        if self.waited in (HARMLESS_PATIENCE, PATIENCE):
            return False
        self.waited += self.waited > 0
        return True


def explained_by_moves(
    before: RigBelief, snapshots: Sequence[Snapshot], pauses: Sequence[float], options: EstimationOptions
) -> bool:
    """Tell whether snapshots that fit nowhere surely fit if all cameras have moved before them, and none is shaking.

    Args:
        before: the belief before them.
        snapshots: all of them need an explanation.
        pauses: s before each.
        options: how to minimize.

    Raises:
        RefusedError: nothing explains these snapshots.
    """
    cameras = tuple(range(before.rig.num_cameras))
    case = Case(before, snapshots, pauses, len(snapshots), options, cameras)
    verdict = weigh(case, (Steady(), Moved(), Shaking()))
    if verdict.best.name != Moved.name or verdict.lead < MISFIT_LEAD:
        return False
    fit = absorb(verdict.best.before, *stack_snapshots(verdict.best.snapshots), options)
    return fit.chi2 <= FIT_CHI2_PER_DOF * max(fit.dof, 1)


def doubtful_cameras(
    before: RigBelief, snapshots: Sequence[Snapshot], pauses: Sequence[float], options: EstimationOptions
) -> tuple[tuple[int, ...], bool]:
    """Find the cameras, at most half of them, that explain snapshots which fit nowhere.

    Args:
        before: the belief before them.
        snapshots: all of them need an explanation.
        pauses: s before each.
        options: how to minimize.

    Returns:
        Cameras that have moved or are unsynchronized, empty if something else is as probable; and whether they are
        surely unsynchronized.
    """
    observations, poses = stack_snapshots(snapshots)
    count, found, evidence = observations.seen.shape[1], tuple[int, ...](), -math.inf
    while 2 * len(found) + 2 <= count:
        with_one_more = {}
        for camera in set(range(count)) - set(found):
            with contextlib.suppress(RefusedError):  # without it, the others do not determine poses
                one_more = (*found, camera)
                with_one_more[camera] = unsynchronized_evidence(before, observations, poses, one_more, options)
        best = max(with_one_more, key=lambda one: with_one_more[one], default=None)
        if best is None or with_one_more[best] < evidence + LEAD:
            break
        found, evidence = (*found, best), with_one_more[best]
    if not found:
        return (), False
    verdict = weigh(Case(before, snapshots, pauses, len(snapshots), options, found))
    blamed = (Moved.name, ClockSlipExplanation.name, Unsynchronized.name)
    rivals = set(verdict.explained) - set(blamed)
    if verdict.evidence(*blamed) < verdict.evidence(*rivals) + LEAD:
        return (), False
    return found, verdict.best.name == Unsynchronized.name and verdict.lead >= LEAD
