"""Cameras in quarantine teach nothing; their blobs are kept and tested from time to time."""

from imgcal.estimation import EstimationOptions
from imgcal.monitoring.quarantine import CASE_AFTER, CASE_EVERY, CASE_SNAPSHOTS, SETTLE_SECONDS, Quarantine
from imgcal.monitoring.unsynchronized_cameras import drop_cameras
from tests.imgcal.monitoring.followed import followed


def test_what_they_see_is_kept_and_asked_with_what_the_others_saw() -> None:
    made, held = followed(30), Quarantine()
    held.add([2], uncertain=False)
    asked = [
        number for number, (observations, _) in enumerate(made.snapshots[10:], 1) if held.observe(observations, 0.1)
    ]
    assert asked == [number for number in CASE_AFTER if number <= 20]
    case = held.case(made.recent, EstimationOptions())
    assert case.count == CASE_SNAPSHOTS and len(case.snapshots) == 30 and case.quarantined
    assert case.cameras == (2,)
    assert case.snapshots[-1][0] is made.snapshots[-1][0]


def test_a_new_one_begins_anew_and_those_that_see_nothing_are_not_asked() -> None:
    made, held = followed(3), Quarantine()
    held.add([2], uncertain=False)
    observations = made.snapshots[0][0]
    assert held.observe(observations, 0.1)
    held.add([2], uncertain=False)
    assert held.sightings == 1
    held.add([1], uncertain=True)
    assert held.cameras == {1, 2} and held.sightings == 0 and held.uncertain and not held.seen
    held.sightings = CASE_EVERY - 1
    blind = drop_cameras(observations, [1, 2])
    held.add_unsynchronized([(blind, made.snapshots[0][1])], [0.1], [1], uncertain=True)
    assert held.unsynchronized and len(held.seen) == 1 and held.sightings == CASE_EVERY - 1
    assert not held.observe(blind, 0.1)
    held.release()
    assert not held.cameras and not held.seen and not held.reported


def test_moments_of_their_own_are_told_once_and_not_before_a_shaken_camera_would_stand_still() -> None:
    made, held = followed(30), Quarantine()
    held.add([2], uncertain=False)
    held.unsynchronized = True
    told = []
    for observations, _ in made.snapshots:
        held.observe(observations, 0.1)
        told.append(held.report_unsynchronized())
    assert [number for number, cameras in enumerate(told) if cameras] == [round(SETTLE_SECONDS / 0.1)]
    assert told[round(SETTLE_SECONDS / 0.1)] == (2,)
