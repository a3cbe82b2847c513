"""A camera that exposes late is told; one that was bumped is not."""

import numpy as np

from imgcal.online import ClockOffsets
from tests.imgcal.online.states import state_at


def watched(late: dict[int, float], bump: float = 0.0) -> tuple[ClockOffsets, list]:
    """Watch three seconds at 20 a second; what is late, or bumped, is so from the first second on."""
    test, events = ClockOffsets(4), []
    for number in range(60):
        begun = number >= 20
        state = state_at(number, number / 20, lambda c, b=begun: late.get(c, 0.0) if b else 0.0, bump if begun else 0.0)
        events += test(state, None, None)
    return test, events


def test_a_late_camera_is_told_with_its_offset() -> None:
    test, events = watched({2: 0.01})
    assert {event.camera for event in events} == {"cam03"}
    assert {event.kind for event in events} == {"clock_slip"}
    assert events[0].unit == "frames"
    offset, sigma = test.offsets()
    assert np.all(np.abs(offset[[0, 1, 3]]) < 5 * sigma[[0, 1, 3]] + 1e-4)
    assert 0.0095 < offset[2] < 0.0105


def test_cameras_in_time_and_bumped_cameras_are_not_told() -> None:
    assert watched({})[1] == []
    assert watched({}, bump=2.0)[1] == []


def test_what_was_told_is_kept() -> None:
    test, _ = watched({2: 0.01})
    again = ClockOffsets(4)
    again.restored(test.saved())
    assert again.saved() == test.saved()
