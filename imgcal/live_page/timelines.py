"""What each camera's values were, in constant memory: the last minutes finely, the last day coarsely."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.live_page.text import round_values

Array = NDArray[np.float64]

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
