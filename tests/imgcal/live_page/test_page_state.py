import json
import time
from dataclasses import replace

import numpy as np
import pytest

from imgcal.live_page import Address, Command
from imgcal.live_page.acknowledgements import MOST_EVENTS
from imgcal.live_page.contents import event_message, greeting, picture_message, state_message
from imgcal.live_page.page_state import MOST_VISITED, PageState
from imgcal.live_page.rig_drawing import viewing_volume
from tests.imgcal.live_page.pages import ACTIONS, alarm, made_state


@pytest.fixture
def board(o10, asymmetric8):
    return PageState(greeting(o10, asymmetric8, viewing_volume(o10), Address(), "token" * 5, ACTIONS, "live"))


def content(message):
    (text,) = message.values()
    return json.loads(text.decode().split("data: ")[1])


def test_nothing_grows_however_long_it_runs(board, o10, asymmetric8):
    state, events = made_state(o10, asymmetric8, now=0.0), event_message(alarm("cam01"))
    message = state_message(state, asymmetric8)
    for second in range(MOST_VISITED + 50):
        board.update("state", message | {"time": 2.0 * second})
    for _ in range(MOST_EVENTS + 50):
        board.update("event", events)
    assert len(board.notes.events) == MOST_EVENTS and board.notes.count == MOST_EVENTS + 50
    assert len(board.contents()["volume"]["visited"]) == MOST_VISITED
    assert set(board.full_state()) == {"hello", "layout", "controls", "history", "events", "volume", "state"}


def test_the_token_is_in_no_message(board, o10, asymmetric8):
    board.update("state", state_message(made_state(o10, asymmetric8), asymmetric8))
    assert "token" * 5 not in json.dumps(board.contents())


def test_a_state_says_who_sees_and_what_is_off(board, o10, asymmetric8):
    state = made_state(o10, asymmetric8, 7, health={"cam03": "blind"})
    told = content(board.update("state", state_message(state, asymmetric8)))
    assert told["snapshot"] == 7 and told["health"][2] == "blind" and told["sees"] == [8] * 10
    assert np.shape(told["object"]) == (8, 3) and told["value"][0] == [None, None, None, 0.07]
    change = np.zeros((10, 15))
    change[4, 0] = np.deg2rad(0.3)
    std = np.full((10, 15), 0.001)
    board.update_change(time.time(), board.greeting["arrangement"], change, std, o10.focal_length.numpy())
    told = content(board.update("state", state_message(state, asymmetric8)))
    assert told["value"][4][0] == pytest.approx(0.3)
    assert board.contents()["history"]["fine"]["value"][4][0] == pytest.approx([0.3])
    assert content(board.update("state", state_message(state, asymmetric8)))["sigma"][4][1] == pytest.approx(0.001)


def test_alarms_are_open_until_they_are_acknowledged(board):
    for name in ("cam01", "cam02", "cam03"):
        board.update("event", event_message(alarm(name)))
    assert [event["open"] for event in content(board.apply_command(Command("acknowledge", event=1)))] == [
        False,
        False,
        True,
    ]


def test_what_is_known_better_takes_the_place_of_the_alarm(board):
    for camera, since, kind in (("cam01", 5.0, "moved"), ("cam01", 5.0, "relearnt"), ("cam02", 6.0, "relearnt")):
        board.update("event", event_message(replace(alarm(camera, since=since), kind=kind)))
    assert [event["open"] for event in board.notes.events] == [False, True, False]
    board.apply_command(Command("acknowledge", event=1))
    board.update("event", event_message(replace(alarm("cam01", since=5.0), kind="relearnt")))
    assert not any(event["open"] for event in board.notes.events)


def test_buttons_with_a_state_are_on_and_off(board):
    assert (
        content(board.apply_command(Command("warm")))["on"] == ["warm"]
        and content(board.apply_command(Command("warm")))["on"] == []
    )
    assert (
        content(board.apply_command(Command("pause")))["paused"]
        and not content(board.apply_command(Command("resume")))["paused"]
    )


def test_a_picture_replaces_the_one_before(board, o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    frames = {"cam02": np.zeros((1088, 2048), dtype=np.uint8)}
    for _ in range(3):
        message = board.update("picture", picture_message(state, 1, frames))
    assert list(message) == ["picture:1"] and content(message)["jpeg"]
    assert content(board.update("picture", picture_message(state, 0, frames)))["jpeg"] is None
    assert sum(key.startswith("picture") for key in board.full_state()) == 2
