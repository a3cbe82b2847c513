"""Which cameras have changed, and when: asked of the latest snapshots."""

import contextlib
import math

import numpy as np
import pytest

from imgcal.errors import RefusedError
from imgcal.monitoring.change_search import ALARM_CHI2, changed_cameras, find_alarm, likeliest_age, likeliest_camera
from imgcal.monitoring.recent_snapshots import SCREENED_AGES, RecentSnapshots
from scripts.benchmarks.rig_streams import Bump, Slip
from tests.imgcal.monitoring.followed import followed

TURN = math.radians(0.1)
INDEPENDENT = (lambda camera, shift: 1, [0.0] * 4)  # errors of single snapshots, which feign no shift


def test_a_steady_rig_has_not_changed() -> None:
    steady = followed(40)
    assert find_alarm(steady.recent, steady.filter.count, *INDEPENDENT) is None


def test_a_camera_that_was_turned_is_found_with_its_moment() -> None:
    turned = followed(46, bumps=[Bump(40, 2, "rotation", TURN)])
    age = find_alarm(turned.recent, turned.filter.count, *INDEPENDENT)
    assert age is not None
    test = turned.recent.test(age)
    assert likeliest_camera(test) == 2
    assert likeliest_age(turned.recent, 2, age) == 6
    free, evidence = changed_cameras(turned.recent, 6, {}, *INDEPENDENT)
    assert free == {2: None} and evidence[2] >= ALARM_CHI2


def test_two_cameras_are_found_and_what_is_known_is_not_found_again() -> None:
    turned = followed(46, bumps=[Bump(40, 1, "rotation", TURN), Bump(40, 3, "position", 1.0)])
    free, evidence = changed_cameras(turned.recent, 6, {}, *INDEPENDENT)
    assert free.keys() == evidence.keys() == {1, 3}
    free, evidence = changed_cameras(turned.recent, 6, {1: "rotation"}, *INDEPENDENT)
    assert free == {1: "rotation", 3: None} and evidence.keys() == {3}
    assert likeliest_camera(turned.recent.test(6), (0, 2, 3)) == 3


@pytest.mark.parametrize(("cameras", "suspected"), [(4, True), (10, True), (64, False)])
def test_chance_triggers_no_more_tests_of_a_rig_with_many_cameras(cameras: int, suspected: bool) -> None:
    asked = []

    class Recent:
        def __len__(self) -> int:
            return 10

        def screen(self) -> np.ndarray:
            return np.full((len(SCREENED_AGES), cameras), 22.0)

        def test_each(self, age: int) -> None:
            asked.append(age)
            raise RefusedError("asked")

    with contextlib.suppress(RefusedError):
        find_alarm(Recent(), 1, lambda camera, shift: 1, [0.0] * cameras)
    assert bool(asked) == suspected


def test_what_may_be_one_passing_error_is_no_alarm() -> None:
    turned = followed(46, bumps=[Bump(40, 2, "rotation", TURN)])
    count, cameras = turned.filter.count, 4
    assert (
        find_alarm(turned.recent, count, lambda camera, shift: 6, [0.0] * cameras) is None
    )  # six snapshots are one episode
    assert find_alarm(turned.recent, count, lambda camera, shift: 3, [0.0] * cameras) is not None
    _, shift = turned.recent.score_without_episode(6, 2, "rotation", 3)
    assert 0.5 < shift < 3.5  # 0.1 degrees are some 2.8 px, less what the poses take
    assert find_alarm(turned.recent, count, lambda camera, shift: 1, [4.0] * cameras) is None


def test_a_small_change_of_another_camera_may_be_an_error_that_lasts() -> None:
    turned = followed(46, bumps=[Bump(40, 1, "rotation", TURN), Bump(40, 3, "position", 1.0)])
    episode = INDEPENDENT[0]
    assert changed_cameras(turned.recent, 6, {}, episode, [0.5] * 4)[0].keys() == {1, 3}
    # The first one has been tested before.
    assert changed_cameras(turned.recent, 6, {}, episode, [50.0] * 4)[0].keys() == {1}


def test_another_camera_whose_error_ends_has_not_changed() -> None:
    """Camera 3 is off for six of the twelve snapshots since camera 1 was turned."""
    turn, late, in_time = Bump(40, 1, "rotation", TURN), Slip(42, 3, 0.01), Slip(48, 3, 0.0)
    passes, lasts = followed(52, bumps=[turn], slips=[late, in_time]), followed(52, bumps=[turn], slips=[late])

    def found(recent: RecentSnapshots, episode: int) -> set[int]:
        return set(changed_cameras(recent, 12, {}, lambda camera, shift: episode, [0.0] * 4)[0])

    assert found(passes.recent, 1) == {1, 3}
    assert found(passes.recent, 6) == {1}
    assert found(lasts.recent, 6) == {1, 3}
    assert found(lasts.recent, 12) == {1}  # all of it may be one episode


def test_a_large_error_may_pass_sooner_than_a_small_one() -> None:
    turned = followed(46, bumps=[Bump(40, 2, "rotation", TURN)])

    def episode(camera: int, shift: float) -> int:
        return 3 if shift > least else 6

    least = 0.5
    assert find_alarm(turned.recent, turned.filter.count, episode, [0.0] * 4) is not None
    least = 5.0
    assert find_alarm(turned.recent, turned.filter.count, episode, [0.0] * 4) is None
