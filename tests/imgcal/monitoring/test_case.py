"""A case: its start, its cameras, and whether it is too early to decide."""

from dataclasses import replace

import pytest

from imgcal.errors import RefusedError
from imgcal.monitoring import absorb
from imgcal.monitoring.case import Case, mean_evidence
from imgcal.monitoring.measurement_update import stack_snapshots
from scripts.benchmarks.rig_streams import Slip
from tests.imgcal.monitoring.followed import followed


def test_a_belief_about_the_beginning_competes_with_one_about_the_latest_snapshots() -> None:
    made = followed(30, slips=[Slip(0, 2, 0.25)])
    case = Case(made.beliefs[20], made.snapshots, [1 / 60] * 30, 10)
    assert len(case.starts) == 1
    since, always = replace(case, beginning=made.beliefs[0]).starts
    assert (len(since.snapshots), len(always.snapshots)) == (10, 30)
    earlier = absorb(made.beliefs[0], *stack_snapshots(made.snapshots[:20])).evidence
    assert since.log_prior == 0 and always.log_prior == pytest.approx(-earlier)


def test_within_the_first_second_a_move_may_be_a_late_clock() -> None:
    made = followed(8)
    case = Case(made.beliefs[5], made.snapshots, [1 / 60] * 8, 3, beginning=made.beliefs[0])
    assert case.too_early
    assert not replace(case, pauses=[1.0] * 8).too_early  # there was time enough
    assert not replace(case, beginning=None).too_early
    still = [made.snapshots[0]] * 5 + made.snapshots[5:]
    assert not replace(case, snapshots=still).too_early  # of an object at rest no clock shows


def test_the_surest_camera_is_suspected_alone_and_with_all_others() -> None:
    made = followed(1)
    case = Case(made.beliefs[0], made.snapshots, [0.0], 1)
    assert replace(case, cameras=(3,)).camera_sets == ((3,),)
    assert replace(case, cameras=(3, 1)).camera_sets == ((3,), (3, 1))
    with pytest.raises(RefusedError, match="no camera is suspected"):
        case.camera_sets  # noqa: B018


def test_the_evidence_is_the_mean_over_variants_of_which_some_failed() -> None:
    assert mean_evidence([0.0, 0.0], 2) == 0.0
    assert mean_evidence([-1000.0, -1000.0], 4) == pytest.approx(-1000.0 - 0.6931472)
