"""Blobs that grow, fade or fail to come are told, and so is when they are as before."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.online import ImageQuality
from tests.imgcal.online.states import state_at


def watched(spoil: str | None, until: int = 200) -> tuple[ImageQuality, list]:
    """Watch at three a second; a camera is spoiled from snapshot 120 on."""
    test, events = ImageQuality(4), []
    for number in range(200):
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


@pytest.mark.parametrize(("spoil", "kind"), [("large", "defocused"), ("faint", "dirty"), ("missing", "dirty")])
def test_a_camera_that_is_spoiled_is_told(spoil: str, kind: str) -> None:
    _, events = watched(spoil)
    assert [(event.kind, event.camera) for event in events] == [(kind, "cam02")]
    assert 40.0 <= events[0].time < 48.0
    assert 38.0 <= events[0].since <= 44.0


def test_good_cameras_are_left_alone_and_a_clean_one_is_told() -> None:
    assert watched(None)[1] == []
    test, events = watched("large", until=150)
    assert [event.kind for event in events] == ["defocused", "clean"]
    again = ImageQuality(4)
    again.restored(test.saved())
    assert again.saved() == test.saved()
    with pytest.raises(ValueError, match="4 cameras"):
        again.restored({name: [[1.0]] for name in test.saved()})


def test_what_is_told_after_a_start_that_goes_on_is_not_since_1970() -> None:
    known, _ = watched(None)
    test, events = ImageQuality(4), []
    test.restored(known.saved())
    state = state_at(0, 0.0)
    large = np.where(state.detections.camera == 1, 1.3 * state.detections.radius, state.detections.radius)
    for number in range(40):
        spoiled = replace(state.detections, radius=large)
        events += test(replace(state, detections=spoiled, time=1.7e9 + number / 3), None, None)
    assert [(event.kind, event.since) for event in events] == [("defocused", 1.7e9)]


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
