import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest

from imgcal.live_page.contents import (
    PICTURE_WIDTH,
    belief_message,
    event_message,
    picture_message,
    small_jpeg,
    state_message,
)
from tests.imgcal.live_page.pages import alarm, made_state


def opened(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 4095), (np.uint16, 65535)])
def test_frames_are_shown_small_with_markers_white_and_noise_black(dtype, top):
    frame = np.random.default_rng(0).normal(0.05 * top, 0.01 * top, (1088, 2048)).clip(0, top).astype(dtype)
    frame[500:530, 1000:1030] = int(0.7 * top)
    picture = opened(small_jpeg(frame))
    assert picture.shape == (255, PICTURE_WIDTH)
    assert picture[120, 237] > 200 and np.quantile(picture, 0.99) < 60
    assert opened(small_jpeg(np.full((4, 5), 7, dtype=dtype))).max() < 20  # nothing is to be seen, and nothing fails


@pytest.mark.parametrize(("width", "height"), [(2048, 1088), (1923, 1085), (961, 722), (700, 2001), (300, 200)])
def test_what_a_frame_of_any_size_shows_stays_in_its_place(width, height):
    frame = np.zeros((height, width), dtype=np.uint8)
    u, v = round(0.7 * width), round(0.3 * height)
    frame[v - 6 : v + 7, u - 6 : u + 7] = 255
    picture = opened(small_jpeg(frame)).astype(np.float64)
    shown = min(width, PICTURE_WIDTH)
    assert picture.shape == (round(height * shown / width), shown)
    picture[picture < 60] = 0.0
    rows, columns = np.indices(picture.shape)
    found = [(axis * picture).sum() / picture.sum() for axis in (columns, rows)]
    scale = shown / width
    assert found == pytest.approx([(u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5], abs=0.6)


def test_places_in_a_picture_are_shares_of_the_image(o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    message = picture_message(state, 3, {})
    assert message["jpeg"] is None and message["labelled"].all() and len(message["predicted"]) == 8
    assert message["detected"] == pytest.approx(message["predicted"], abs=1e-9)
    assert ((message["detected"] > 0) & (message["detected"] < 1)).all()
    unknown = replace(state, predicted=np.full_like(state.predicted, np.nan))
    assert len(picture_message(unknown, 3, {})["predicted"]) == 0


def test_a_snapshot_that_taught_nothing_has_no_object(o10, asymmetric8):
    state = replace(made_state(o10, asymmetric8), rig_from_object=None, refused="no object in sight")
    assert state_message(state, asymmetric8)["object"] is None
    assert state_message(state, asymmetric8)["refused"] == "no object in sight"
    belief, factory, turn = pickle.loads(belief_message(state)["pickled"])
    assert belief.rig.num_cameras == factory.num_cameras == 10 and turn.shape == (3, 3)


def test_an_object_is_in_view_while_a_camera_sees_enough_blobs(o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    assert state_message(state, asymmetric8)["in_view"]
    refused = replace(state, refused="identity: two poses fit")
    assert state_message(refused, asymmetric8)["in_view"]
    rows = state.detections.fiducial < 3
    assert not state_message(replace(refused, detections=state.detections.select(rows)), asymmetric8)["in_view"]
    nothing = state.detections.select(np.zeros_like(rows))
    assert not state_message(replace(refused, detections=nothing), asymmetric8)["in_view"]


def test_rigs_and_events_go_through(o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    belief, factory, _ = pickle.loads(belief_message(state)["pickled"])
    assert belief.rig.camera_names == factory.camera_names
    few = len(belief_message(state)["pickled"])
    assert state.belief.information.shape and len(belief_message(state)["pickled"]) == few  # not what follows from it
    assert event_message(alarm("cam07"))["message"] == "cam07 turned 0.3 degrees"
