"""Cameras that are lost and back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.online.camera_visibility import CameraVisibility, VisibleObject
from imgcal.types import Detections


def look(time: float, labelled: list[int], astray: frozenset[int] = frozenset(), silent: frozenset[int] = frozenset()):
    """A snapshot in which the object is in the middle of all four images."""
    labelled = [camera for camera in labelled for _ in range(3)]
    count = len(labelled)
    blobs = Detections(
        np.full((count, 2), 500.0), np.ones(count), np.array(labelled, dtype=np.int64), np.zeros(count, np.int64),
        np.zeros(count, np.int64), np.ones(count), np.zeros(count, np.uint8), ("a", "b", "c", "d"), ("0",),
    )  # fmt: skip
    return VisibleObject(time, round(time * 60), blobs, np.full((4, 8, 2), 500.0), astray, silent)


def kinds(sightings: CameraVisibility, looks: list[VisibleObject]) -> list[tuple[str, str | None, float | None]]:
    rig = imgcal.load_rig("T4").to(torch.float64)
    return [(e.kind, e.camera, e.since) for given in looks for e in sightings.observe(rig, given)]


def test_a_camera_that_misses_the_object_for_seconds_is_lost_and_one_that_is_covered_for_a_moment_is_not() -> None:
    sightings = CameraVisibility(("a", "b", "c", "d"))
    assert kinds(sightings, [look(s / 30, [0, 1, 2] if s < 30 else [0, 1, 2, 3]) for s in range(60)]) == []
    assert sightings.seen == {0, 1, 2, 3}
    told = kinds(sightings, [look(2 + s / 30, [0, 1, 2]) for s in range(100)])
    assert told == [("camera_lost", "d", pytest.approx(2.0))]
    assert kinds(sightings, [look(6.0, [0, 1, 2, 3])]) == [("camera_back", "d", pytest.approx(2.0))]


def test_a_camera_that_is_astray_or_silent_is_lost() -> None:
    sightings = CameraVisibility(("a", "b", "c", "d"))
    assert kinds(sightings, [look(0.0, [0, 1, 3], astray=frozenset({2}))]) == []  # it may be garbage ...
    assert sightings.astray.keys() == {2}
    assert kinds(sightings, [look(0.1, [0, 1, 2, 3])]) == [] and not sightings.astray  # ... as it was
    astray = [look(0.2 + s / 10, [0, 1, 2, 3], astray=frozenset({2})) for s in range(6)]  # a label by chance is none
    assert kinds(sightings, astray) == [("camera_lost", "c", 0.2)]
    given = [look(1 + s / 10, [0, 1, 3], silent=frozenset({1})) for s in range(7)]
    # Labels of a camera without a frame come from nowhere here: it is back at once.
    assert ("camera_lost", "b", 1.0) in kinds(sightings, given)
    assert sightings.lost.keys() >= {2}


def test_what_is_in_a_wrong_place_for_a_moment_only_is_no_loss_however_often() -> None:
    """A hand, or another person's markers: in 3 snapshots, or twice with seconds between."""
    sightings = CameraVisibility(("a", "b", "c", "d"))
    for start in (1.0, 2.0, 5.0, 9.0):
        odd = [look(start + s / 60, [0, 1, 3], astray=frozenset({2})) for s in range(3)]
        rest = [look(start + s / 60, [0, 1, 3]) for s in range(3, 60)]
        for given in rest:
            given.predicted[2] = np.nan  # then the object is out of this camera's view
        assert kinds(sightings, [*odd, *rest]) == [] and sightings.astray.keys() == {2}
    slow = CameraVisibility(("a", "b", "c", "d"))
    looks = [
        look(float(s), [0, 1, 2, 3] if s < 5 else [0, 1, 3], astray=frozenset({2} if s > 4 else ())) for s in range(7)
    ]
    assert kinds(slow, looks) == [("camera_lost", "c", 5.0)]  # two snapshots last long enough


def test_clocks_that_are_set_back_keep_no_camera_from_being_told_lost() -> None:
    sightings = CameraVisibility(("a", "b", "c", "d"))
    kinds(sightings, [look(5000 + s / 30, [0, 1, 2, 3] if s < 10 else [0, 1, 2]) for s in range(20)])
    told = kinds(sightings, [look(1400 + s / 30, [0, 1, 2]) for s in range(90)])
    assert told == [("camera_lost", "d", 1400.0)]


def test_a_camera_is_in_doubt_until_it_has_seen_nothing_in_the_wrong_place_for_a_while() -> None:
    sightings, odd = CameraVisibility(("a", "b", "c", "d")), frozenset({2})
    nothing = look(0.0, [0, 1, 3])
    nothing.predicted[2] = np.nan  # the object is out of this camera's view
    assert kinds(sightings, [look(s / 60, [0, 1, 2, 3]) for s in range(6)]) == []
    doubts = []
    for given in (replace(nothing, time=0.09), look(0.1, [0, 1, 3], odd), replace(nothing, time=0.2)):
        assert kinds(sightings, [given]) == []
        doubts.append(sightings.doubtful_cameras(given.time) == odd)
    assert doubts == [False, True, True]
    assert kinds(sightings, [replace(nothing, time=0.7)]) == [] and not sightings.doubtful_cameras(0.7)


def test_a_camera_is_silent_by_its_own_measure() -> None:
    sightings = CameraVisibility(("a", "b", "c", "d"))
    slow = [look(s / 10, [0, 1, 3] + [2] * (s % 10 == 0), silent=frozenset({2} if s % 10 else ())) for s in range(60)]
    assert kinds(sightings, slow) == []  # once a second
    gone = [(s, look(s / 10, [0, 1, 3], silent=frozenset({2}))) for s in range(60, 100)]
    told = [(event, s) for s, given in gone for event in kinds(sightings, [given])]
    assert told == [(("camera_lost", "c", pytest.approx(5.1)), 81)]
    back = look(1.0, [0, 1, 2, 3])  # the clocks were set back
    assert kinds(sightings, [back]) == [("camera_back", "c", pytest.approx(5.1))]
    again = [look(1.0 + s / 10, [0, 1, 3], silent=frozenset({2})) for s in range(1, 30)]
    assert kinds(sightings, again) == [("camera_lost", "c", pytest.approx(1.1))]


def test_the_object_is_hidden_from_a_camera_that_suddenly_sees_nothing_before_it_is_lost() -> None:
    sightings, rig = CameraVisibility(("a", "b", "c", "d")), imgcal.load_rig("T4").to(torch.float64)
    hidden = []
    for s in range(4):
        assert kinds(sightings, [look(s / 60, [0, 1, 2])]) == []
        hidden.append(sightings.hidden_cameras(rig, look(0.0, []).predicted) == {3})
    assert hidden == [False, False, True, True]
    one = look(0.08, [0, 1, 2, 3])
    one = replace(one, blobs=one.blobs.select(np.arange(10)))
    assert kinds(sightings, [one]) == []
    assert sightings.hidden_cameras(rig, one.predicted) == {3}  # a label may come by chance
    assert kinds(sightings, [look(0.1, [0, 1, 2, 3])]) == [] and not sightings.hidden_cameras(rig, one.predicted)


def test_an_object_that_has_left_the_view_of_a_camera_is_not_hidden_from_it() -> None:
    sightings, rig = CameraVisibility(("a", "b", "c", "d")), imgcal.load_rig("T4").to(torch.float64)
    assert kinds(sightings, [look(s / 60, [0, 1, 2]) for s in range(4)]) == []
    left = look(4 / 60, [0, 1, 2])
    left.predicted[3] = -900.0
    assert kinds(sightings, [left]) == []
    assert sightings.hidden_cameras(rig, left.predicted) == frozenset()
    unknown = np.full_like(left.predicted, np.nan)  # where the object is now, nobody knows
    assert sightings.hidden_cameras(rig, unknown) == {3}
    assert sightings.hidden_cameras(rig, look(5 / 60, []).predicted) == {3}  # it comes back, and is still covered


def test_a_camera_whose_blobs_were_left_out_does_not_miss_the_object() -> None:
    sightings, rig = CameraVisibility(("a", "b", "c", "d")), imgcal.load_rig("T4").to(torch.float64)
    looks = [replace(look(s / 10, [0, 1, 2]), left_out=frozenset({3})) for s in range(60)]
    assert kinds(sightings, looks) == []
    assert sightings.hidden_cameras(rig, looks[-1].predicted) == frozenset()


def test_a_camera_that_cannot_see_the_object_misses_nothing() -> None:
    sightings, rig = CameraVisibility(("a", "b", "c", "d")), imgcal.load_rig("T4").to(torch.float64)
    for s in range(120):
        given = look(s / 30, [0, 1])
        given.predicted[3] = np.nan
        given.predicted[2] = 5.0  # at the border
        assert sightings.observe(rig, given) == []
