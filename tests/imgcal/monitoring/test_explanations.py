"""All explanations of a case are compared on the same scale; undecided cases wait."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.monitoring import ClockSlip, absorb
from imgcal.monitoring.case import Case, Explained, Explanation, Finding, Variant
from imgcal.monitoring.change_test import JUMPS
from imgcal.monitoring.clock_slip import ClockSlipExplanation
from imgcal.monitoring.explanations import (
    EXPLANATIONS,
    HARMLESS_PATIENCE,
    LEAD,
    PATIENCE,
    Diagnosis,
    Moved,
    doubtful_cameras,
    weigh,
)
from imgcal.monitoring.measurement_update import stack_snapshots
from imgcal.monitoring.pending_change import free_cameras
from imgcal.monitoring.shaking import Shaking
from scripts.benchmarks.rig_streams import Bump, Slip
from tests.imgcal.monitoring.followed import Followed, followed

BEFORE, COUNT = 40, 3


def case_of(made: Followed, rate: float = 60.0, **more) -> Case:
    """Camera 2 seems to have moved before the last snapshots."""
    count = len(made.snapshots) - BEFORE
    case = Case(made.beliefs[BEFORE], made.snapshots, [1 / rate] * len(made.snapshots), count, cameras=(2,))
    return replace(case, **more)


@dataclass(frozen=True)
class Known(Explanation):
    """An explanation whose evidence is known, and whose variants give it or fail."""

    name: str
    evidences: tuple[float | str, ...]
    log_prior: float = 0.0
    why_premature: str | None = None

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        return [lambda given=given: self._variant(case, given) for given in self.evidences]

    def _variant(self, case: Case, given: float | str) -> Variant:
        if isinstance(given, str):
            raise RefusedError(given)
        slip = ClockSlip(1, 0, given, 1e-4, math.nan)
        known = absorb(case.before, *stack_snapshots(case.latest), case.options).evidence
        return Variant(case.before, case.latest, given - known, find=lambda _: Finding((slip,)))

    def premature(self, case: Case, found: Explained) -> str | None:
        return self.why_premature


@pytest.fixture(scope="module")
def case() -> Case:
    made = followed(COUNT)
    return Case(made.beliefs[0], made.snapshots, [1 / 60] * COUNT, COUNT)


def test_the_evidence_is_the_mean_over_all_variants_times_the_prior(case: Case) -> None:
    one, many = Known("one", (2.0,)), Known("many", (2.0, -90.0, "no minimum", -90.0), log_prior=0.5)
    verdict = weigh(case, (many, one))
    assert list(verdict.explained) == ["one", "many"] and not verdict.reasons
    assert verdict.evidence("one") == pytest.approx(2.0, abs=1e-6)
    assert verdict.evidence("many") == pytest.approx(2.5 - math.log(4), abs=1e-6)
    assert verdict.lead == pytest.approx(math.log(4) - 0.5, abs=1e-6)
    assert verdict.explained["many"].finding.slips[0].seconds == 2.0  # of its best variant


def test_what_cannot_be_weighed_says_why_and_wins_nothing(case: Case) -> None:
    failed, excluded = Known("failed", ("no minimum", "no pose")), Known("excluded", (90.0,))
    verdict = weigh(replace(case, excluded={"excluded": "tested before"}), (failed, excluded, Known("left", (-9.0,))))
    assert verdict.best.name == "left" and verdict.lead == math.inf
    assert verdict.reasons == {"failed": "no minimum; no pose", "excluded": "tested before"}
    assert verdict.evidence("failed", "excluded") == -math.inf
    with pytest.raises(RefusedError, match="failed: no minimum; no pose"):
        weigh(case, (failed,))


def test_what_cannot_be_decided_waits_and_is_then_what_is_more_probable(case: Case) -> None:
    table: tuple[Explanation, ...] = (Known("a", (1.0,)), Known("b", (0.0,)))
    diagnosis = Diagnosis()
    for _ in range(PATIENCE):
        with pytest.raises(RefusedError, match="a is not certain yet: no explanation leads by 5"):
            diagnosis.decide(case, True, table)
    assert diagnosis.decide(case, True, table).best.name == "a"
    assert Diagnosis().decide(case, False, table).best.name == "a"
    assert Diagnosis().decide(case, True, (Known("a", (2 * LEAD,)), table[1])).best.name == "a"
    premature = Known("a", (2 * LEAD,), why_premature="one snapshot")
    with pytest.raises(RefusedError, match="yet: one snapshot"):
        Diagnosis().decide(case, False, (premature, table[1]))


def test_cases_that_are_left_out_count_as_waiting_but_do_not_end_it() -> None:
    diagnosis = Diagnosis()
    assert diagnosis.skip() and diagnosis.waited == 0  # nothing was undecided
    diagnosis.waited = 1
    assert sum(diagnosis.skip() for _ in range(PATIENCE)) == HARMLESS_PATIENCE - 1
    diagnosis.waited += 1  # that case was weighed, and is still undecided
    assert sum(diagnosis.skip() for _ in range(PATIENCE)) == PATIENCE - HARMLESS_PATIENCE - 1
    assert diagnosis.waited == PATIENCE


def test_the_table_names_each_explanation_once() -> None:
    names = [explanation.name for explanation in EXPLANATIONS]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("late", [0.002, -0.01, 0.0167])
def test_a_slip_is_more_probable_than_a_move(late: float) -> None:
    verdict = weigh(case_of(followed(BEFORE + COUNT, slips=[Slip(BEFORE, 2, late)])), (Moved(), ClockSlipExplanation()))
    assert verdict.best.name == "clock slip"
    (slip,) = verdict.best.finding.slips
    assert slip.camera == 2
    assert slip.seconds == pytest.approx(late, abs=max(5 * slip.sigma, 2e-4))


@pytest.mark.parametrize(("kind", "size"), [("rotation", math.radians(0.3)), ("position", 3.0)])
def test_a_move_is_more_probable_than_anything_else(kind: str, size: float) -> None:
    verdict = weigh(case_of(followed(BEFORE + COUNT, bumps=[Bump(BEFORE, 2, kind, size)])))
    assert verdict.best.name == "moved" and verdict.lead > LEAD
    assert verdict.evidence("clock slip") < verdict.evidence("moved") - LEAD
    assert set(verdict.explained) | set(verdict.reasons) == {one.name for one in EXPLANATIONS}


def test_a_move_is_averaged_over_how_far_it_went() -> None:
    made = followed(BEFORE + COUNT, bumps=[Bump(BEFORE, 2, "rotation", math.radians(0.3))])
    given = stack_snapshots(made.snapshots[BEFORE:])
    jumps = [absorb(free_cameras(made.beliefs[BEFORE], {2: None}, jump), *given).evidence for jump in JUMPS]
    mean = float(torch.tensor(jumps).double().logsumexp(0)) - math.log(len(jumps))
    assert weigh(case_of(made), (Moved(),)).evidence("moved") == pytest.approx(mean, abs=1e-6)


def test_a_move_is_not_believed_of_too_little() -> None:
    made = followed(BEFORE + 1, bumps=[Bump(BEFORE, 2, "rotation", math.radians(0.5))])
    case = case_of(made)
    verdict = weigh(case)
    assert verdict.best.name == "moved" and Diagnosis().decide(case, patient=False).best.name == "moved"
    assert "a move" in verdict.reasons["unsynchronized"]  # one snapshot is explained by either
    with pytest.raises(RefusedError, match="moved is not certain yet"):
        Diagnosis().decide(replace(case, quarantined=True), patient=False)
    early = replace(case, pauses=[0.0] * (BEFORE + 1), count=BEFORE, beginning=case.before)
    assert early.too_early and Moved().premature(early, verdict.best) is not None


def test_a_slip_that_is_hardly_known_of_a_camera_that_is_hardly_known_waits() -> None:
    case = case_of(followed(BEFORE + COUNT), uncertain=True)
    slipped = ClockSlipExplanation()
    for sigma, why in ((1e-4, None), (2e-3, "the slip is hardly known")):
        found = Finding((ClockSlip(2, 0, 0.01, sigma, math.nan),))
        explained = Explained(slipped, 0.0, case.before, list(case.latest), found)
        assert slipped.premature(case, explained) == why
        assert slipped.premature(replace(case, uncertain=False), explained) is None


@pytest.mark.parametrize("rate", [4.0, 60.0])
def test_a_camera_with_moments_of_its_own_is_told_from_one_that_moved_at_any_rate(rate: float) -> None:
    for happened, name in (
        ({"slips": [Slip(BEFORE, 2, 0.25)]}, "unsynchronized"),
        ({"bumps": [Bump(BEFORE, 2, "position", 5.0)]}, "moved"),
    ):
        case = case_of(followed(BEFORE + COUNT, rate=rate, **happened), rate, quarantined=True)
        verdict = Diagnosis().decide(case, patient=True)
        assert verdict.best.name == name
        assert abs(verdict.evidence("unsynchronized") - verdict.evidence("moved")) > 10 * LEAD
        assert verdict.evidence("steady") < verdict.evidence("moved") - 10 * LEAD


@pytest.mark.parametrize("shakes", [True, False])
def test_a_camera_that_shakes_a_little_is_told_from_one_that_moved(shakes: bool) -> None:
    made, generator = followed(BEFORE + 6), torch.Generator().manual_seed(2)
    shift = 0.6 * torch.randn(6, 2, generator=generator, dtype=torch.float64)
    shift = shift if shakes else torch.tensor([[0.9, -0.7]], dtype=torch.float64).expand(6, -1)
    for s in range(6):
        one, pose = made.snapshots[BEFORE + s]
        uv = one.uv.clone()
        uv[:, 2] += shift[s]
        made.snapshots[BEFORE + s] = (replace(one, uv=uv), pose)
    case = case_of(made)
    both = weigh(case, (Moved(), Shaking()))
    assert both.best.name == ("shaking" if shakes else "moved") and both.lead > 2 * LEAD
    found = Diagnosis().decide(replace(case, excluded={"steady": "a test has excluded it"}), patient=True).best
    assert found.name == both.best.name
    assert (found.finding.shake is not None) == shakes
    assert not shakes or float(found.finding.shake[2]) > 0


def refused(made: Followed) -> tuple[tuple[int, ...], bool]:
    before, snapshots = made.beliefs[BEFORE], made.snapshots[BEFORE:]
    return doubtful_cameras(before, snapshots, [1 / 60] * len(snapshots), Case(before, snapshots, [], 1).options)


def test_cameras_are_doubted_that_explain_what_fits_nowhere_and_else_none() -> None:
    assert refused(followed(BEFORE + 6, slips=[Slip(BEFORE, 2, 0.25)])) == ((2,), True)
    assert refused(followed(BEFORE + 6, bumps=[Bump(BEFORE, 1, "position", 20.0)])) == ((1,), False)
    assert refused(followed(BEFORE + 6)) == ((), False)
