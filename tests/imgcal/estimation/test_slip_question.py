"""A clock that slips and a camera that moves are told apart, where the object moves; what cannot be told waits."""

import math
from dataclasses import dataclass

import pytest

from imgcal.errors import RefusedError
from imgcal.estimation import ClockSlip, EstimationOptions
from imgcal.estimation.clock_slip import Slipped
from imgcal.estimation.slip_question import SLIP_ODDS, SLIP_PATIENCE, SlipQuestion, Suspicion
from scripts.benchmarks.rig_streams import Bump, Slip
from tests.imgcal.estimation.followed import followed

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
    count: int = COUNT

    def clocks(self, options: EstimationOptions) -> tuple[float, Slipped]:
        made = followed(1)
        slip = ClockSlip(1, 0, 0.01, 1e-4, math.nan)
        return self.odds, Slipped(made.beliefs[0], (slip,), [made.snapshots[0]] * 5, 0.0)


def test_what_cannot_be_told_waits_and_is_then_what_is_more_probable() -> None:
    question = SlipQuestion()
    for _ in range(SLIP_PATIENCE):
        with pytest.raises(RefusedError, match="cannot be told yet"):
            question.ask(Told(1.0), 40, OPTIONS, patient=True)
    slipped = question.ask(Told(1.0), 40, OPTIONS, patient=True)
    assert slipped is not None
    (slip,) = slipped.slips
    assert (slip.since, slip.odds) == (40 - (5 - COUNT), 1.0)  # it was found in earlier snapshots, too
    assert SlipQuestion().ask(Told(-1.0), 40, OPTIONS, patient=False) is None
    assert SlipQuestion().ask(Told(-2 * SLIP_ODDS), 40, OPTIONS, patient=True) is None
