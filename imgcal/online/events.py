"""Events of a rig that is kept calibrated; each is one line of `events.jsonl`."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, get_args

EventKind = Literal[
    "moved",
    "relearnt",
    "drift",
    "camera_lost",
    "camera_back",
    "dirty",
    "defocused",
    "clean",
    "object_bent",
    "object_exchanged",
    "clock_slip",
    "restart",
    "factory",
]
ChangeKind = Literal["rotation", "position", "focal_length", "principal_point", "unknown"]
Unit = Literal["deg", "mm", "px", "frames"]

EVENT_KINDS: tuple[EventKind, ...] = get_args(EventKind)


@dataclass(frozen=True)
class Event:
    """Something that happened to a rig.

    A camera that moved has two events: one with the change `unknown` as soon as the move is certain, and a second one
    with the same camera and `since` once the kind and size of the move are decided.

    Examples:
        >>> event = Event(1.5, 90, "moved", "cam07", since=1.48, change="rotation", size=0.3, sigma=0.01, unit="deg",
        ...               evidence=412.0, message="cam07 turned 0.3 degrees")
        >>> json.loads(event.to_json())["time"], json.loads(event.to_json())["kind"]
        ('1970-01-01T00:00:01.500+00:00', 'rotation')
    """

    time: float  # s since the epoch: when it was detected
    snapshot: int  # number of the update that detected it
    kind: EventKind
    camera: str | None = None
    since: float | None = None  # s since the epoch: when it happened
    change: ChangeKind | None = None
    size: float | None = None  # in `unit`
    sigma: float | None = None  # one standard deviation of the size
    unit: Unit | None = None
    evidence: float | None = None  # chi-squared of "it stood still", for a camera that moved
    message: str = ""  # one sentence

    def to_json(self) -> str:
        """Write one line of `events.jsonl`: times in ISO 8601, UTC; `event` says what happened, `kind` how it changed.

        A number that is not finite becomes null.
        """
        since, size, sigma, evidence = map(_finite, (self.since, self.size, self.sigma, self.evidence))
        values = {
            "event": self.kind,
            "camera": self.camera,
            "snapshot": snapshot_name(self.snapshot),
            "time": None if _finite(self.time) is None else iso_time(self.time),
            "since": None if since is None else iso_time(since),
            "kind": self.change,
            "size": size,
            "sigma": sigma,
            "unit": self.unit,
            "evidence": evidence,
            "message": self.message,
        }
        return json.dumps(values, allow_nan=False, ensure_ascii=False)


def snapshot_name(number: int) -> str:
    """Name of update `number`."""
    return f"{number:05d}"


def iso_time(seconds: float) -> str:
    """Format seconds since the epoch in ISO 8601, UTC, to the millisecond."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
