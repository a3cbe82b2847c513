"""Blobs that grow, fade or fail to come are reported, and that they are as before; the object's place explains some."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.online import ImageQuality
from tests.imgcal.online.states import restart, state_at


def watched(spoil: str | None, until: int = 260, restarts: int = 1000) -> tuple[ImageQuality, list]:
    """Watch at three a second, with restarts after so many snapshots; a camera is spoiled from snapshot 120 on."""
    test, events = ImageQuality(4), []
    for number in range(until if spoil == "missing" else min(until + 40, 200)):
        if number % restarts == restarts - 1:
            test = restart(test, ImageQuality(4))
        state = state_at(number, number / 3)
        blobs, camera = state.detections, state.detections.camera == 1
        if spoil and 120 <= number < until:
            if spoil == "large":
                blobs = replace(blobs, radius=np.where(camera, 1.3 * blobs.radius, blobs.radius))
            elif spoil == "faint":
                blobs = replace(blobs, sigma=np.where(camera, 2.5 * blobs.sigma, blobs.sigma))
            else:
                blobs = blobs.select(~camera | (blobs.fiducial % 3 > 0))
        events += test(replace(state, detections=blobs), None, None)
    return test, events


@pytest.mark.parametrize(
    ("spoil", "kind", "seconds"), [("large", "defocused", 15.0), ("faint", "dirty", 15.0), ("missing", "dirty", 40.0)]
)
def test_a_camera_that_is_spoiled_is_reported(spoil: str, kind: str, seconds: float) -> None:
    _, events = watched(spoil)
    assert [(event.kind, event.camera) for event in events] == [(kind, "cam02")]
    assert 40.0 <= events[0].time < 40.0 + seconds
    assert 38.0 <= events[0].since <= 44.0


def changed_everywhere(change) -> list:
    """Watch for 100 s blobs that are changed by (state, number, depth of each blob in metres)."""
    test, events, luck = ImageQuality(4), [], np.random.default_rng(2)
    for number in range(300):
        state = state_at(number, number / 3)
        points = state.rig.cam_from_rig.apply(state.rig_from_object.apply(state.belief.points_object))
        blobs = state.detections
        depth = points[..., 2].numpy()[blobs.camera, blobs.fiducial] / 1000
        events += test(replace(state, detections=change(blobs, number, depth, luck)), None, None)
    return events


def test_blobs_that_depend_on_place_and_distance_are_no_fault_of_the_camera() -> None:
    def change(blobs, number, depth, luck):
        off = np.square(blobs.uv / 1000 - 0.5).sum(1)
        return replace(blobs, sigma=0.1 * depth**2 * (1 + off), radius=blobs.radius * (1 + 0.2 * off) * depth**0.3)

    assert changed_everywhere(change) == []


def test_sigmas_that_a_source_does_not_know_are_no_evidence() -> None:
    """All are 0.1 px, as where blobs come without: nothing says that a lamp far away is as bright as it should be."""
    assert changed_everywhere(lambda blobs, number, depth, luck: replace(blobs, sigma=np.full(len(blobs), 0.1))) == []


def test_an_arm_in_front_of_a_camera_for_some_seconds_is_no_dirt() -> None:
    def change(blobs, number, depth, luck):
        hidden = (blobs.camera == 2) & (blobs.fiducial < 5) & (150 <= number < 195)  # 15 s
        return blobs.select(~hidden)

    assert changed_everywhere(change) == []


def test_what_all_cameras_see_alike_is_the_fault_of_none() -> None:
    def change(blobs, number, depth, luck):
        return replace(blobs, radius=np.where(number >= 150, 1.3, 1.0) * blobs.radius)

    assert changed_everywhere(change) == []


def test_good_cameras_are_left_alone_and_a_clean_one_is_told() -> None:
    assert watched(None)[1] == []
    test, events = watched("large", until=150)
    assert [event.kind for event in events] == ["defocused", "clean"]
    with pytest.raises(ValueError, match=r"test\.bad: found another array than one of \(3, 3\)"):
        restart(test, ImageQuality(3))


def test_a_restart_takes_nothing_of_what_has_been_seen() -> None:
    """Every ten seconds, as often as blocks and their evidence are only half complete."""
    assert watched("large", restarts=30)[1] == watched("large")[1] != []


def test_a_camera_that_sends_nothing_is_not_dirty() -> None:
    test, events = ImageQuality(4), []
    for number in range(200):
        state = state_at(number, number / 3)
        out = state.detections.select(state.detections.camera != 2)
        events += test(state if number < 120 else replace(state, detections=out), None, None)
    assert events == []


def test_a_snapshot_a_second_of_which_a_tenth_is_hidden_is_clean() -> None:
    test, events, luck = ImageQuality(4), [], np.random.default_rng(1)
    state = state_at(0, 0.0)
    for number in range(3000):
        shown = state.detections.select(luck.random(32) > 0.1)
        events += test(replace(state, detections=shown, time=1.7e9 + number), None, None)
    assert events == []


def test_clocks_that_are_set_back_are_no_evidence() -> None:
    test, events = ImageQuality(4), []
    for number in range(120):
        state = state_at(number, number / 3)
        events += test(replace(state, time=1.7e9 + number / 3 - (1000.0 if number >= 60 else 0.0)), None, None)
    assert events == []
