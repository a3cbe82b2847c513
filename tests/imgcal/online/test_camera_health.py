"""How each camera is, the worst first, and the sentence that says so."""

import numpy as np

from imgcal.online import Event
from imgcal.online.camera_health import VAIN, camera_health, describe_health, take_health
from imgcal.online.camera_visibility import HIDDEN_SNAPSHOTS
from tests.imgcal.online.memories import Remembered


def test_the_worst_is_said_of_a_camera() -> None:
    memory, nowhere = Remembered().learn(2), np.full((4, 8, 2), np.nan)
    memory.sightings.seen |= {0, 1, 2}
    assert camera_health(memory, nowhere) == {"cam01": "ok", "cam02": "ok", "cam03": "ok", "cam04": "unseen"}
    take_health(memory, Event(0.0, 1, "dirty", "cam02"))
    take_health(memory, Event(0.0, 1, "object_bent"))
    assert camera_health(memory, nowhere)["cam02"] == "dirty"
    memory.off[1] = 0.0
    assert camera_health(memory, nowhere)["cam02"] == "doubtful"
    memory.off.clear()
    memory.monitor.undecided = {1: 3}
    assert camera_health(memory, nowhere)["cam02"] == "doubtful"
    memory.relearning.events[1] = Event(0.0, 1, "moved", "cam02")
    assert camera_health(memory, nowhere)["cam02"] == "relearning"
    memory.monitor.undecided = {}
    memory.relearning.events.clear()
    take_health(memory, Event(0.0, 2, "clean", "cam02"))
    assert camera_health(memory, nowhere)["cam02"] == "ok"
    memory.sightings.missing[1] = 0.0, HIDDEN_SNAPSHOTS
    assert camera_health(memory, nowhere)["cam02"] == "hidden"
    assert camera_health(memory, np.full((4, 8, 2), -900.0))["cam02"] == "ok"  # the object has left its view
    memory.sightings.missing.clear()
    memory.in_vain = VAIN
    assert camera_health(memory, nowhere) == {
        **dict.fromkeys(("cam01", "cam02", "cam03"), "doubtful"),
        "cam04": "unseen",
    }


def test_the_rig_is_said_in_a_sentence() -> None:
    assert describe_health({"a": "ok"}, 0) == "the object has not been seen yet"
    assert describe_health({"a": "ok", "b": "ok"}, 5) == "all 2 cameras are calibrated"
    assert describe_health({"a": "ok", "b": "hidden"}, 5) == "all 2 cameras are calibrated; b does not see the object"
    assert describe_health({"a": "dirty", "b": "hidden"}, 5) == "a is dirty; b does not see the object"
    assert describe_health({"a": "dirty", "b": "relearning"}, 5) == "b moved and is being recalibrated; a is dirty"
