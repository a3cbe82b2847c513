"""A clock that slips and a camera that moves are told apart, where the object moves; what cannot be told waits."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.monitoring import ClockSlip
from imgcal.monitoring.clock_slip import Slipped
from imgcal.monitoring.explanations import SLIP_ODDS, SLIP_PATIENCE, ExplanationSearch, Suspicion
from scripts.benchmarks.rig_streams import Bump, Slip
from tests.imgcal.monitoring.followed import followed

BEFORE, COUNT, OPTIONS = 40, 3, EstimationOptions()


def suspected(cameras: list[int], **happened) -> Suspicion:
    """Cameras that seem to have moved before the last snapshots."""
    made = followed(BEFORE + COUNT, **happened)
    return Suspicion(
        made.beliefs[BEFORE], made.snapshots, [1 / 60] * len(made.snapshots), COUNT, dict.fromkeys(cameras)
    )


@pytest.mark.parametrize("late", [0.002, -0.01, 0.0167])
def test_a_slip_is_more_probable_than_a_move(late: float) -> None:
    odds, slipped = suspected([2], slips=[Slip(BEFORE, 2, late)]).clocks(OPTIONS)
    assert odds > 0 and slipped is not None
    (slip,) = slipped.slips
    assert slip.camera == 2
    assert slip.seconds == pytest.approx(late, abs=max(5 * slip.sigma, 2e-4))


@pytest.mark.parametrize(("kind", "size"), [("rotation", math.radians(0.3)), ("position", 3.0)])
def test_a_move_is_more_probable_than_a_slip(kind: str, size: float) -> None:
    odds, _ = suspected([2], bumps=[Bump(BEFORE, 2, kind, size)]).clocks(OPTIONS)
    assert odds < -SLIP_ODDS


@dataclass
class Told:
    """A suspicion whose answer is known."""

    odds: float
    apart_odds: float = -math.inf
    steady_odds: float = -math.inf
    shaken_odds: float = -math.inf
    count: int = COUNT
    held: bool = False
    wide: bool = False
    too_early: bool = False

    def clocks(self, options: EstimationOptions) -> tuple[float, Slipped]:
        made = followed(1)
        slip = ClockSlip(1, 0, 0.01, 1e-4, math.nan)
        return self.odds, Slipped(made.beliefs[0], (slip,), [made.snapshots[0]] * 5, 0.0)

    def apart(self, options: EstimationOptions) -> float:
        return self.apart_odds

    def steady(self, options: EstimationOptions) -> float:
        return self.steady_odds

    def shaken(self, options: EstimationOptions) -> tuple[float, None]:
        return self.shaken_odds, None


def test_what_cannot_be_told_waits_and_is_then_what_is_more_probable() -> None:
    question = ExplanationSearch()
    for _ in range(SLIP_PATIENCE):
        with pytest.raises(RefusedError, match="cannot be told yet"):
            question.ask(Told(1.0), 40, OPTIONS, patient=True)
    answer = question.ask(Told(1.0), 40, OPTIONS, patient=True)
    assert answer.slipped is not None
    (slip,) = answer.slipped.slips
    assert (slip.since, slip.odds) == (40 - (5 - COUNT), 1.0)  # it was found in earlier snapshots, too
    assert ExplanationSearch().ask(Told(-1.0), 40, OPTIONS, patient=False).kind == "moved"
    assert ExplanationSearch().ask(Told(-2 * SLIP_ODDS), 40, OPTIONS, patient=True).kind == "moved"


@pytest.mark.parametrize(
    ("told", "kind"),
    [
        (Told(-9.0, apart_odds=20.0), "apart"),
        (Told(40.0, apart_odds=20.0), "slipped"),
        (Told(-9.0, apart_odds=20.0, steady_odds=90.0), "moved"),  # only what is held can be as if nothing was
        (Told(-9.0, apart_odds=-9.0, steady_odds=90.0, held=True), "steady"),
        (Told(-9.0, apart_odds=20.0, shaken_odds=30.0, count=4), "shaken"),
        (Told(-9.0, apart_odds=20.0, shaken_odds=30.0, held=True), "apart"),  # what is held shakes by more than that
        (Told(-9.0, apart_odds=20.0, count=1), "moved"),  # one snapshot is explained by either
    ],
)
def test_what_is_most_probable_is_answered(told: Told, kind: str) -> None:
    if kind == "moved" and told.count > 1:
        told.apart_odds = -20.0
    assert ExplanationSearch().ask(told, 40, OPTIONS, patient=True).kind == kind


@pytest.mark.parametrize("told", [Told(-9.0, held=True, count=1), Told(-9.0, too_early=True)])
def test_a_move_is_not_told_of_too_little(told: Told) -> None:
    with pytest.raises(RefusedError, match="cannot be told yet"):
        ExplanationSearch().ask(told, 40, OPTIONS, patient=False)


def test_a_slip_that_is_hardly_known_of_a_camera_that_is_hardly_known_waits() -> None:
    told = Told(40.0, wide=True)
    assert ExplanationSearch().ask(told, 40, OPTIONS, patient=True).kind == "slipped"  # to 0.1 ms
    vague = replace(told.clocks(OPTIONS)[1], slips=(ClockSlip(1, 0, 0.01, 2e-3, math.nan),))
    told.clocks = lambda options: (40.0, vague)
    with pytest.raises(RefusedError, match="cannot be told yet"):
        ExplanationSearch().ask(told, 40, OPTIONS, patient=False)


@pytest.mark.parametrize("rate", [4.0, 60.0])
def test_a_camera_with_moments_of_its_own_is_told_from_one_that_moved_at_any_rate(rate: float) -> None:
    for happened, apart in (
        ({"slips": [Slip(BEFORE, 2, 0.25)]}, True),
        ({"bumps": [Bump(BEFORE, 2, "position", 5.0)]}, False),
    ):
        made = followed(BEFORE + COUNT, rate=rate, **happened)
        pauses = [1 / rate] * len(made.snapshots)
        suspicion = Suspicion(made.beliefs[BEFORE], made.snapshots, pauses, COUNT, {2: None}, held=True)
        assert (suspicion.apart(OPTIONS) > 10 * SLIP_ODDS) == apart
        assert suspicion.apart(OPTIONS) > 10 * SLIP_ODDS or suspicion.apart(OPTIONS) < -10 * SLIP_ODDS
        assert suspicion.steady(OPTIONS) < -10 * SLIP_ODDS
        assert ExplanationSearch().ask(suspicion, 0, OPTIONS, patient=True).kind == ("apart" if apart else "moved")


@pytest.mark.parametrize("shakes", [True, False])
def test_a_camera_that_shakes_a_little_is_told_from_one_that_moved(shakes: bool) -> None:
    made, generator = followed(BEFORE + 6), torch.Generator().manual_seed(2)
    shift = 0.6 * torch.randn(6, 2, generator=generator, dtype=torch.float64)
    shift = shift if shakes else torch.tensor([[0.9, -0.7]], dtype=torch.float64).expand(6, -1)
    snapshots = list(made.snapshots)
    for s in range(6):
        one, pose = snapshots[BEFORE + s]
        uv = one.uv.clone()
        uv[:, 2] += shift[s]
        snapshots[BEFORE + s] = (replace(one, uv=uv), pose)
    suspicion = Suspicion(made.beliefs[BEFORE], snapshots, [1 / 60] * len(snapshots), 6, {2: None})
    odds, found = suspicion.shaken(OPTIONS)
    assert (odds > 2 * SLIP_ODDS) if shakes else (odds < -2 * SLIP_ODDS)
    answer = ExplanationSearch().ask(suspicion, BEFORE, OPTIONS, patient=True)
    assert answer.kind == ("shaken" if shakes else "moved")
    assert (answer.shaken is None) != shakes
    assert not shakes or (found is not None and float(found.shake[2]) > 0)
