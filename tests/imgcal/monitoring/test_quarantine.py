"""Cameras of which nothing is learnt for the time being: what they see is kept, and asked at times."""

from imgcal.monitoring.quarantine import ASKED, EVERY, MOST, SHAKEN_SECONDS, Quarantine
from tests.imgcal.monitoring.followed import followed


def test_what_they_see_is_kept_and_asked_with_what_the_others_saw() -> None:
    made, held = followed(30), Quarantine()
    held.hold([2], wide=False)
    asked = [number for number, (observations, _) in enumerate(made.snapshots[10:], 1) if held.take(observations, 0.1)]
    assert asked == [number for number in ASKED if number <= 20]
    suspicion = held.suspicion(made.recent)
    assert suspicion.count == MOST and len(suspicion.snapshots) == 30 and suspicion.held
    assert list(suspicion.cameras) == [2]
    assert suspicion.snapshots[-1][0] is made.snapshots[-1][0]


def test_a_new_one_begins_anew_and_those_that_see_nothing_are_not_asked() -> None:
    made, held = followed(3), Quarantine()
    held.hold([2], wide=False)
    observations = made.snapshots[0][0]
    assert held.take(observations, 0.1)
    held.hold([2], wide=False)
    assert held.taken == 1
    held.hold([1], wide=True)
    assert held.cameras == {1, 2} and held.taken == 0 and held.wide and not held.seen
    held.taken = EVERY - 1
    blind = held.hold_since([(observations, made.snapshots[0][1])], [0.1], [1], wide=True)
    assert not blind[0][0].seen[:, [1, 2]].any()
    assert not held.take(blind[0][0], 0.1)
    held.release()
    assert not held.cameras and not held.seen and not held.told


def test_moments_of_their_own_are_told_once_and_not_before_a_shaken_camera_would_stand_still() -> None:
    made, held = followed(30), Quarantine()
    held.hold([2], wide=False)
    held.apart = True
    told = []
    for observations, _ in made.snapshots:
        held.take(observations, 0.1)
        told.append(held.tell())
    assert [number for number, cameras in enumerate(told) if cameras] == [round(SHAKEN_SECONDS / 0.1)]
    assert told[round(SHAKEN_SECONDS / 0.1)] == (2,)
