"""Commands of the page: the buttons of every page, and those that a program adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

COMMON = ("acknowledge", "factory", "pause", "resume")


@dataclass(frozen=True)
class Action:
    """A button that a program adds to the page."""

    name: str  # of the command that it sends
    label: str
    of_camera: bool = False  # it is about the camera that is chosen beside it
    undo: str | None = None  # label while it is on: it then sends the same command again; None = it has no state


@dataclass(frozen=True)
class Command:
    """A button that was pressed."""

    name: str  # "acknowledge", "factory", "pause", "resume", or the name of an action
    camera: str | None = None
    event: int | None = None  # number of the event that is acknowledged


def read_command(content: Any, cameras: Sequence[str], actions: Mapping[str, Action], events: int) -> Command:
    """Check the command that a page sent.

    Args:
        content: anything.
        cameras: names; a page sends the number of one.
        actions: of the program, by name.
        events: number of events so far.

    Raises:
        ValueError: it is no command.

    Examples:
        >>> read_command({"name": "bump", "camera": 1}, ["a", "b"], {"bump": Action("bump", "Bump", True)}, 0)
        Command(name='bump', camera='b', event=None)
    """
    if not isinstance(content, dict) or not set(content) <= {"name", "camera", "event", "confirmed"}:
        raise ValueError("expected an object with name, camera, event")
    name, camera, event = content.get("name"), content.get("camera"), content.get("event")
    if not isinstance(name, str) or (name not in COMMON and name not in actions):
        raise ValueError("expected the name of a command")
    if name == "factory" and content.get("confirmed") is not True:
        raise ValueError("expected a confirmation")
    about_camera = name in actions and actions[name].of_camera
    if about_camera != _is_index(camera, len(cameras)) or (camera is not None and not about_camera):
        raise ValueError("expected the number of a camera for a command about one")
    if (name == "acknowledge") != _is_index(event, events) or (event is not None and name != "acknowledge"):
        raise ValueError("expected the number of an event to acknowledge")
    return Command(name, cameras[camera] if about_camera and isinstance(camera, int) else None, event)


def _is_index(number: Any, count: int) -> bool:
    return isinstance(number, int) and not isinstance(number, bool) and 0 <= number < count
