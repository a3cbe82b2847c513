"""`Acknowledgements`: events shown on the page, and their acknowledgement. The loop keeps a copy, since the server
may restart.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from imgcal.live_page.commands import Action, Command

MOST_EVENTS = 200
ALARMS = frozenset({"moved", "camera_lost", "dirty", "defocused", "object_bent", "object_exchanged", "clock_slip"})
"""Events that wait for somebody to acknowledge them."""
ENDS = {"camera_back": {"camera_lost"}, "clean": {"dirty", "defocused"}}
"""Good news, which needs no acknowledgement, and the alarms of the same camera that it ends."""


@dataclass
class Acknowledgements:
    """Events and switches, in constant memory.

    Examples:
        >>> notes = Acknowledgements()
        >>> notes.apply_command(Command("pause"), {})
        >>> notes.controls()
        {'paused': True, 'on': []}
    """

    events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=MOST_EVENTS))
    count: int = 0  # of events so far
    paused: bool = False
    switched: set[str] = field(default_factory=set)  # actions that are on

    def add_event(self, content: Mapping[str, Any]) -> None:
        """Note an event (`contents.event_message`)."""
        numbers = ("time", "since", "size", "sigma")
        plain = {k: _finite_or_none(v) if k in numbers else v for k, v in content.items()}
        waits = plain["kind"] in ALARMS
        ended = ENDS.get(content["kind"], set())
        for event in self.events:
            if not event["open"] or event["camera"] != plain["camera"]:
                continue
            if event["kind"] in ended:
                event["open"] = False
            elif not ended and event["since"] == plain["since"] is not None:  # the same, known better now
                event["open"], waits = False, True
        self.events.append(plain | {"number": self.count, "open": waits})
        self.count += 1

    def apply_command(self, command: Command, actions: Mapping[str, Action]) -> None:
        """Apply a command: acknowledge an event and all before it, or set a switch."""
        if command.event is not None:
            for event in self.events:
                event["open"] = event["open"] and event["number"] > command.event
        elif command.name in ("pause", "resume"):
            self.paused = command.name == "pause"
        elif command.name in actions and actions[command.name].undo is not None:
            self.switched ^= {command.name}

    def controls(self) -> dict[str, Any]:
        """The switches, as plain values."""
        return {"paused": self.paused, "on": sorted(self.switched)}


def _finite_or_none(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
