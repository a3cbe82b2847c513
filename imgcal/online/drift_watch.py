"""Slow drift of a running rig, which the filter follows without an alarm: report it once it is large enough."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from imgcal.estimation import Gauge
from imgcal.monitoring import CHANGES, RigBelief
from imgcal.online.events import ChangeKind, Event
from imgcal.online.relearning import relative_std
from imgcal.types import SHOWN_UNITS, CameraRig

EVERY_SECONDS = 10.0
"""Time between two checks."""
LEAST_DRIFT = {"rotation": math.radians(0.05), "position": 0.5, "focal_length": 1.0, "principal_point": 1.0}
"""Drift (rad, mm, pixels) that is reported if significant."""
DRIFT_SIGMAS = 5.0
"""Significance of the drift, in standard deviations of the values at the start of the measurement."""
LEAST_SHIFT_RATIO = 0.5
"""Least ratio of two shifts of the labels: by the changes of all values of a camera, and by the drift alone. Values
that change together so that the labels hardly move, such as a focal length and a distortion, are being learned."""
HOW = {
    "rotation": "has slowly turned by",
    "position": "has slowly shifted by",
    "focal_length": "has slowly changed its focal length by",
    "principal_point": "has slowly changed its principal point by",
}


@dataclass
class DriftWatch:
    """Compares a rig with its state when drift was last reported, or when it was learned."""

    names: tuple[str, ...]
    looked: float | None = None  # time of the last check, s since the epoch
    reference: CameraRig | None = None
    std: Tensor | None = None  # (C, K) of the reference
    since: dict[int, float] = field(default_factory=dict)  # camera -> time of its reference
    unsettled: frozenset[int] = frozenset()  # cameras unsettled at any time since the last check

    def observe(
        self, belief: RigBelief, unsettled: frozenset[int], points: Callable[[int], Tensor], time: float, number: int
    ) -> list[Event]:
        """Return the cameras that have drifted.

        Args:
            belief: the current belief.
            unsettled: cameras whose drift is not measured, see `KeeperMemory.unsettled`.
            points: where a camera has lately seen the object: (P, 3) mm.
            time: s since the epoch.
            number: of the update.
        """
        self.unsettled |= unsettled
        if self.looked is not None and 0 <= time - self.looked < EVERY_SECONDS:
            return []
        unsettled, self.unsettled = self.unsettled, frozenset()
        self.looked = time
        std = relative_std(belief)
        if self.reference is None or self.std is None:
            self.reference, self.std = belief.rig, std
            self.since |= dict.fromkeys(range(len(self.names)), time)
            return []
        aligned = Gauge.from_majority(belief.rig, self.reference).align(belief.rig, self.reference)
        change = aligned.local(self.reference)
        events, restarted = [], set(unsettled)
        for camera in range(len(self.names)):
            if camera in unsettled:
                continue
            if bool((std[camera, :10] < 0.5 * self.std[camera, :10]).any()):
                restarted.add(camera)  # earlier changes are learning, not drift: its first labels may have been wrong
                continue
            found = self._largest(camera, change[camera], torch.maximum(self.std, std)[camera], points)
            if found is not None:
                events.append(self._event(camera, *found, std[camera], time, number))
                restarted.add(camera)
        if restarted:
            self._restart(sorted(restarted), aligned, std, time)
        return events

    def _largest(
        self, camera: int, change: Tensor, std: Tensor, points: Callable[[int], Tensor]
    ) -> tuple[ChangeKind, float] | None:
        """Most significant kind of change that moves the labels and its size, or None if none is worth a report."""
        assert self.reference is not None
        found: list[tuple[float, ChangeKind, float]] = []
        for kind, part in CHANGES.items():
            size = float(change[part].norm())
            least = max(LEAST_DRIFT[kind], DRIFT_SIGMAS * float(std[part].max()))
            if size >= least:
                found.append((size / least, kind, size))  # type: ignore[arg-type]
        for _, kind, size in sorted(found, reverse=True):
            alone = torch.zeros_like(change)
            alone[CHANGES[kind]] = change[CHANGES[kind]]
            steps = torch.stack((change, alone))
            together, by_itself = _image_shifts(self.reference.select([camera]), steps, points(camera))
            if together > LEAST_SHIFT_RATIO * by_itself:
                return kind, size
        return None

    def _event(self, camera: int, kind: ChangeKind, size: float, std: Tensor, time: float, number: int) -> Event:
        name = self.names[camera]
        unit, scale = SHOWN_UNITS[kind]
        assert self.std is not None
        part = CHANGES[kind]
        sigma = float((self.std[camera, part].square() + std[part].square()).max().sqrt()) * scale
        size, minutes = size * scale, (time - self.since[camera]) / 60
        message = f"{name} {HOW[kind]} {size:.2g} {unit} in {minutes:.1f} minutes"
        return Event(time, number, "drift", name, self.since[camera], kind, size, sigma, unit, message=message)

    def _restart(self, cameras: list[int], now: CameraRig, std: Tensor, time: float) -> None:
        """Measure the drift of some cameras from now on; `now`: the rig, aligned with the reference."""
        assert self.reference is not None and self.std is not None
        self.reference, self.std = replace_cameras(self.reference, now, cameras), self.std.clone()
        self.std[cameras] = std[cameras]
        self.since |= dict.fromkeys(cameras, time)


def _image_shifts(camera: CameraRig, changes: Tensor, points: Tensor) -> list[float]:
    """Median shift of points (P, 3) in a camera's image (px) by changes (M, K) of its values; zeros without points."""
    if not len(points):
        return [0.0] * len(changes)
    steps = torch.cat((torch.zeros_like(changes[:1]), changes))[:, None]
    uv = camera.expand(len(steps)).retract(steps).project_values(points.expand(len(steps), -1, -1), None).uv[:, 0]
    return [float(shift) for shift in (uv[1:] - uv[:1]).norm(dim=-1).median(-1).values]


def replace_cameras(rig: CameraRig, other: CameraRig, cameras: list[int]) -> CameraRig:
    """Replace cameras by those of another rig, both without batch axes."""

    def put(tensor: Tensor, source: Tensor) -> Tensor:
        changed = tensor.clone()
        changed[cameras] = source[cameras]
        return changed

    return CameraRig.combine((rig, other), lambda pair: put(*pair))
