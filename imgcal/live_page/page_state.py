"""`PageState`: all that the page shows, in constant memory, as the latest message of each kind."""

from __future__ import annotations

import base64
import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.live_page.acknowledgements import Acknowledgements
from imgcal.live_page.commands import Command
from imgcal.live_page.page import round_values, stream_event

Array = NDArray[np.float64]

MOST_VISITED = 400  # places of the object that are drawn
VISITED_SECONDS = 1.0
LAYOUT_SECONDS = 5.0
SPANS = {"fine": (1.0, 600), "coarse": (144.0, 600)}
"""Seconds between two points, and how many points are kept."""


@dataclass
class Timelines:
    """Series of all cameras: rotation (deg), position (mm), focal length (%) against the factory's; residual (px)."""

    _spans: dict[str, deque[tuple[float, Array, Array]]] = field(
        default_factory=lambda: {name: deque(maxlen=count) for name, (_, count) in SPANS.items()}
    )

    def add(self, time: float, values: Array, sigma: Array) -> None:
        """Note values (C, 4) and their standard deviations (C, 4), nan where unknown; most calls keep nothing."""
        for name, (every, _) in SPANS.items():
            points = self._spans[name]
            if points and time < points[-1][0]:  # the clock was set back
                points.clear()
            if not points or time - points[-1][0] >= every * 0.999:
                points.append((time, values, sigma))

    def content(self) -> dict[str, Any]:
        """Plain values: times (T), then values and deviations as (C, 4, T) of each span."""
        return {name: _columns(points) for name, points in self._spans.items()}


def camera_changes(change: Array, focal_length: Array) -> Array:
    """Turn (deg), way (mm) and change of the focal length (%) of each camera, of its change (C, 15): (C, 3)."""
    return np.stack(
        (
            np.rad2deg(np.linalg.norm(change[:, :3], axis=1)),
            np.linalg.norm(change[:, 3:6], axis=1),
            100 * (change[:, 6:8] / focal_length).mean(1),
        ),
        axis=1,
    )


def camera_sigmas(std: Array, focal_length: Array) -> Array:
    """Standard deviations of the four series, of one direction each: (C, 4), nan for the residual."""
    return np.stack(
        (
            np.rad2deg(np.sqrt(np.square(std[:, :3]).mean(1))),
            np.sqrt(np.square(std[:, 3:6]).mean(1)),
            100 * (std[:, 6:8] / focal_length).mean(1),
            np.full(len(std), np.nan),
        ),
        axis=1,
    )


def _columns(points: deque[tuple[float, Array, Array]]) -> dict[str, Any]:
    if not points:
        return {"time": [], "value": [], "sigma": []}
    value, sigma = (np.stack([p[i] for p in points], axis=-1) for i in (1, 2))  # (C, 4, T)
    return {"time": [round(p[0], 2) for p in points], "value": round_values(value), "sigma": round_values(sigma)}


class PageState:
    """Collects what the loop's process sends, and returns what is new for the viewers.

    Messages are made as bytes of server-sent events, once for all viewers. A message replaces the one before it of the
    same key, so that a slow reader needs only the latest of each.
    """

    def __init__(self, greeting: Mapping[str, Any]) -> None:
        """Start from the greeting of the loop's process."""
        self.greeting = greeting
        self.instance = f"{time.time_ns():x}"  # another one: the server was started again
        self.notes: Acknowledgements = greeting["notes"]
        self.state: dict[str, Any] | None = None
        self._actions = {action.name: action for action in greeting["actions"]}
        self.advice: dict[str, Any] | None = None
        self._timelines = Timelines()
        self._visited: deque[list[float]] = deque(maxlen=MOST_VISITED)
        self._visited_at = self._layout_at = -math.inf
        self._pictures: dict[str, Any] = {}
        self._rate = _Rate()
        self._layout = greeting["arrangement"]
        self._value = np.full((len(greeting["cameras"]), 4), np.nan)
        self._sigma = self._value.copy()

    def update(self, kind: str, content: Mapping[str, Any]) -> dict[str, bytes]:
        """Take a message; returns what is new, by key."""
        match kind:
            case "state":
                return self._update_state(content)
            case "picture":
                return self._update_picture(content)
            case "event":
                return self._update_event(content)
        return {}

    def update_change(
        self, time: float, layout: dict[str, Any], change: Array, std: Array, focal_length: Array
    ) -> dict[str, bytes]:
        """Take the rig of a moment: how it is drawn, its change against the factory and one standard deviation of that
        (C, 15) each, and focal lengths (C, 2).
        """
        self._value[:, :3] = camera_changes(change, focal_length)
        self._sigma = camera_sigmas(std, focal_length)
        self._timelines.add(time, self._value.copy(), self._sigma)
        if abs(time - self._layout_at) < LAYOUT_SECONDS:
            return {}
        self._layout_at, self._layout = time, layout
        return {"layout": stream_event("layout", layout), "volume": stream_event("volume", self._volume())}

    def update_advice(self, advice: dict[str, Any]) -> dict[str, bytes]:
        """Take what has been computed of a belief: predicted error and guidance."""
        self.advice = advice
        return {"volume": stream_event("volume", self._volume())}

    def apply_command(self, command: Command) -> dict[str, bytes]:
        """Note a command that changes what is shown."""
        self.notes.apply_command(command, self._actions)
        if command.event is not None:
            return {"events": self._events()}
        return {"controls": stream_event("controls", self.notes.controls())}

    def full_state(self) -> dict[str, bytes]:
        """Everything that a new viewer needs."""
        return {key: stream_event(key.partition(":")[0], content) for key, content in self.contents().items()}

    def contents(self) -> dict[str, Any]:
        """The same as plain values; a report is made of them, too."""
        found: dict[str, Any] = {
            "hello": self._hello(),
            "layout": self._layout,
            "controls": self.notes.controls(),
            "history": self._timelines.content(),
            "events": list(self.notes.events),
            "volume": self._volume(),
        }
        if self.state is not None:
            found["state"] = self.state
        return found | self._pictures

    def _hello(self) -> dict[str, Any]:
        given = self.greeting
        return {
            "instance": self.instance,
            "title": given["title"],
            "version": given["version"],
            "rig": given["rig_name"],
            "object": given["object_name"],
            "cameras": list(given["cameras"]),
            "fiducials": len(given["points"]),
            "sizes": given["image_size"].tolist(),
            "actions": [
                {"name": a.name, "label": a.label, "ofCamera": a.of_camera, "undo": a.undo} for a in given["actions"]
            ],
        }

    def _update_state(self, content: Mapping[str, Any]) -> dict[str, bytes]:
        now, points = float(content["time"]), content["object"]
        self._value[:, 3] = content["residual"]
        self.state = {
            "time": now,
            "snapshot": content["snapshot"],
            "rate": self._rate(time.monotonic(), content["snapshot"]),
            "sentence": content["sentence"],
            "refused": content["refused"],
            "inView": content["in_view"],
            "health": content["health"],
            "value": round_values(self._value),
            "sigma": round_values(self._sigma),
            "sees": content["sees"].tolist(),
            "object": None if points is None else round_values(points),
        }
        if points is not None and abs(now - self._visited_at) >= VISITED_SECONDS:
            self._visited_at = now
            self._visited.append(round_values(points.mean(0), 4))
        return {"state": stream_event("state", self.state)}

    def _update_picture(self, content: Mapping[str, Any]) -> dict[str, bytes]:
        jpeg = content["jpeg"]
        key = f"picture:{content['camera']}"
        self._pictures[key] = {
            "camera": content["camera"],
            "time": content["time"],
            "jpeg": None if jpeg is None else base64.b64encode(jpeg).decode(),
            "detected": round_values(content["detected"], 4),
            "labelled": content["labelled"].tolist(),
            "predicted": round_values(content["predicted"], 4),
        }
        return {key: stream_event("picture", self._pictures[key])}

    def _update_event(self, content: Mapping[str, Any]) -> dict[str, bytes]:
        if content["kind"] == "factory":
            self._visited.clear()
        self.notes.add_event(content)
        return {"events": self._events()}

    def _events(self) -> bytes:
        return stream_event("events", list(self.notes.events))

    def _volume(self) -> dict[str, Any]:
        return {"advice": self.advice, "visited": list(self._visited)}


class _Rate:
    """How many snapshots there are in a second, smoothed over some."""

    def __init__(self) -> None:
        self._marks: deque[tuple[float, int]] = deque(maxlen=30)

    def __call__(self, now: float, snapshot: int) -> float | None:
        self._marks.append((now, snapshot))
        (start, first), (end, last) = self._marks[0], self._marks[-1]
        return None if end - start < 0.5 else round((last - first) / (end - start), 1)
