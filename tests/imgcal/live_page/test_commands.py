import pytest

from imgcal.live_page import Action, Command
from imgcal.live_page.commands import read_command

CAMERAS, ACTIONS = ("left", "right"), {"bump": Action("bump", "Bump", of_camera=True), "warm": Action("warm", "Warm")}


def read(content):
    return read_command(content, CAMERAS, ACTIONS, 3)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"name": "pause"}, Command("pause")),
        ({"name": "warm"}, Command("warm")),
        ({"name": "bump", "camera": 1}, Command("bump", "right")),
        ({"name": "acknowledge", "event": 2}, Command("acknowledge", None, 2)),
        ({"name": "factory", "confirmed": True}, Command("factory")),
    ],
)
def test_commands_are_read(content, expected):
    assert read(content) == expected


@pytest.mark.parametrize(
    "content",
    [
        None, [], "pause", 1, {}, {"name": 1}, {"name": ["pause"]}, {"name": "reboot"}, {"name": "__class__"},
        {"name": "pause", "path": "/etc/passwd"}, {"name": "pause", "camera": 0}, {"name": "bump"},
        {"name": "bump", "camera": "left"}, {"name": "bump", "camera": 2}, {"name": "bump", "camera": -1},
        {"name": "bump", "camera": True}, {"name": "bump", "camera": 0.0}, {"name": "acknowledge"},
        {"name": "acknowledge", "event": 3}, {"name": "acknowledge", "event": -1}, {"name": "warm", "event": 1},
        {"name": "factory"}, {"name": "factory", "confirmed": "yes"}, {"name": "factory", "confirmed": 1},
    ],
)  # fmt: skip
def test_everything_else_is_refused(content):
    with pytest.raises(ValueError, match="expected"):
        read(content)
