"""A foreign object is reported once, after seconds; an absent object is not."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.online import ForeignObject
from tests.imgcal.online.states import restart, state_at


def watched(test: ForeignObject, refused: str | None, blobs: bool, first: float, count: int) -> list:
    """Watch some snapshots at twenty a second."""
    state, events = state_at(0, first), []
    shown = state.detections if blobs else state.detections.select(np.zeros(32, dtype=bool))
    for number in range(count):
        events += test(replace(state, time=first + number / 20, refused=refused, detections=shown), None, None)
    return events


def test_a_foreign_object_is_told_once() -> None:
    test = ForeignObject()
    assert watched(test, "identity", True, 0.0, 200) == []  # the object has never been seen
    assert watched(test, None, True, 10.0, 1) == []
    (event,) = watched(test, "identity", True, 11.0, 200)
    assert (event.kind, event.camera, event.since) == ("object_exchanged", None, 11.0)
    assert 14.0 <= event.time < 14.2
    again = restart(test, ForeignObject())
    assert watched(again, "identity", True, 30.0, 200) == []


def test_a_restart_takes_nothing_of_what_has_been_seen() -> None:
    test = ForeignObject()
    watched(test, None, True, 10.0, 1)
    watched(test, "identity", True, 11.0, 30)
    again = restart(test, ForeignObject())
    (event,) = watched(again, "identity", True, 12.5, 200)
    assert event.since == 11.0 and 14.0 <= event.time < 14.2


def test_clocks_that_are_set_back_meanwhile_do_not_keep_it_from_being_told() -> None:
    test = ForeignObject()
    watched(test, None, True, 5000.0, 1)
    watched(test, "identity", True, 5001.0, 20)
    (event,) = watched(test, "identity", True, 1400.0, 200)
    assert (event.since, event.time < 1405) == (1400.0, True)


@pytest.mark.parametrize(("refused_of_ten", "told"), [(9, 1), (6, 0)])
def test_a_few_labels_by_chance_do_not_make_it_the_object(refused_of_ten: int, told: int) -> None:
    test, events = ForeignObject(), []
    watched(test, None, True, 0.0, 1)
    state = state_at(0, 1.0)
    some = replace(state.detections, fiducial=np.where(np.arange(32) % 2, -1, state.detections.fiducial))
    for number in range(200):
        refused = "identity" if number % 10 < refused_of_ten else None
        events += test(replace(state, time=1 + number / 20, refused=refused, detections=some), None, None)
    assert len(events) == told


def test_an_absent_object_is_no_foreign_one() -> None:
    test = ForeignObject()
    watched(test, None, True, 0.0, 1)
    assert watched(test, "identity", False, 1.0, 200) == []


def test_labels_that_fit_in_no_camera_are_those_of_the_object() -> None:
    """All cameras have moved: it is recognized, but nowhere in its place."""
    test = ForeignObject()
    watched(test, None, True, 0.0, 1)
    assert watched(test, "estimation: labels are 32.1 px off in most cameras", True, 1.0, 200) == []
    (event,) = watched(test, "identity", True, 11.0, 200)
    assert event.since == 11.0
