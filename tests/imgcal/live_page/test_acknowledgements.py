import pickle
from dataclasses import replace

import pytest

from imgcal.live_page import Command
from imgcal.live_page.acknowledgements import MOST_EVENTS, Acknowledgements
from imgcal.live_page.contents import event_message
from tests.imgcal.live_page.pages import ACTIONS, alarm

NAMED = {action.name: action for action in ACTIONS}


def test_a_server_that_begins_with_them_knows_what_people_did():
    notes = Acknowledgements()
    for name in ("cam01", "cam02", "cam03"):
        notes.add_event(event_message(alarm(name)))
    for command in (Command("acknowledge", event=1), Command("pause"), Command("warm"), Command("bump", "cam01")):
        notes.apply_command(command, NAMED)
    again = pickle.loads(pickle.dumps(notes))
    assert again == notes and again.controls() == {"paused": True, "on": ["warm"]}
    again.add_event(event_message(alarm("cam04")))
    assert [(event["number"], event["open"]) for event in again.events] == [
        (0, False),
        (1, False),
        (2, True),
        (3, True),
    ]


def test_they_are_bounded_and_numbers_go_on():
    notes = Acknowledgements()
    for _ in range(MOST_EVENTS + 5):
        notes.add_event(event_message(alarm("cam01")))
    assert len(notes.events) == MOST_EVENTS and notes.count == MOST_EVENTS + 5
    assert notes.events[-1]["number"] == MOST_EVENTS + 4


@pytest.mark.parametrize("name", ["factory", "bump"])
def test_commands_without_a_state_switch_nothing(name):
    notes = Acknowledgements()
    notes.apply_command(Command(name), NAMED)
    assert notes == Acknowledgements()


@pytest.mark.parametrize(
    ("kind", "ended"), [("camera_lost", "camera_back"), ("dirty", "clean"), ("defocused", "clean")]
)
def test_an_alarm_that_is_over_needs_no_acknowledgement_and_nor_does_its_end(kind, ended):
    notes = Acknowledgements()
    for camera in ("cam01", "cam02"):
        notes.add_event(event_message(replace(alarm(camera, since=5.0), kind=kind)))
    notes.add_event(event_message(replace(alarm("cam01", since=5.0), kind=ended)))
    assert [event["open"] for event in notes.events] == [False, True, False]
