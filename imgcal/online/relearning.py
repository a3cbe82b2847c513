"""Cameras that moved: what is reported about them until they are relearned."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from torch import Tensor

from imgcal.estimation import Gauge
from imgcal.geometry import geodesic_angle
from imgcal.messages import plus_minus, round_to
from imgcal.monitoring import CHANGES, Change, RigBelief
from imgcal.online.events import ChangeKind, Event
from imgcal.types import SHOWN_UNITS, CameraRig

RELEARNT = 1.1
"""Largest standard deviations of a relearned camera, relative to those before it moved."""
RELEARNING_SNAPSHOTS = 4
"""Number of snapshots between two checks for that."""
NEARLY_UPRIGHT = math.radians(10.0)
"""Largest other rotation of a camera whose images are turned by 180 degrees: it was mounted upside down."""
EXTRINSICS_AND_PINHOLE = 10
"""Number of a camera's values that are compared: distortion is not affected by the changes that are reported."""

HOW: dict[ChangeKind, str] = {
    "rotation": "turned",
    "position": "was shifted by",
    "focal_length": "changed its focal length by",
    "principal_point": "changed its principal point by",
    "unknown": "moved",
}


@dataclass
class Relearning:
    """Remembers cameras that moved."""

    names: tuple[str, ...]
    events: dict[int, Event] = field(default_factory=dict)  # camera -> its latest report
    before: dict[int, Tensor] = field(default_factory=dict)  # camera -> (K,) std before it moved

    def report_change(
        self, change: Change, since: float, time: float, number: int, before: RigBelief, now: CameraRig
    ) -> Event:
        """Report a change.

        Args:
            change: as found by the monitor.
            since: s since the epoch, when it happened.
            time: s since the epoch, now.
            number: of the update.
            before: a belief before the change.
            now: the rig as it is known after it.
        """
        kind: ChangeKind = change.kind  # type: ignore[assignment]
        name = self.names[change.camera]
        unit, scale = SHOWN_UNITS.get(kind, (None, 1.0))
        size, sigma = (None, None) if unit is None else (change.size * scale, change.sigma * scale)
        parts = ((kind, change.size, change.sigma), *change.also)
        how = HOW[kind] if size is None else " and ".join(_describe(*part) for part in parts)
        evidence = change.evidence if math.isfinite(change.evidence) else None
        message = f"{name} {how}"
        if shows_upside_down(before.rig, now, change.camera):
            message += ": its images are turned by 180 degrees"
        if len(self.names) == 2:
            message += f", or {self.names[1 - change.camera]}: with two cameras it is impossible to tell which"
        event = Event(time, number, "moved", name, since, kind, size, sigma, unit, evidence, message)
        self.events[change.camera] = event
        if change.camera not in self.before:
            self.before[change.camera] = relative_std(before)[change.camera]
        return event

    def report_relearnt(
        self, belief: RigBelief, still_open: frozenset[int], best_known: frozenset[int], time: float, number: int
    ) -> list[Event]:
        """Report which cameras are known as well again as before they moved.

        Args:
            belief: the current belief.
            still_open: cameras whose kind of move is undecided.
            best_known: cameras that cannot become better known: everything that counts was seen after they moved.
            time: s since the epoch.
            number: of the update.
        """
        waiting = [camera for camera in self.events if camera not in still_open]
        if not waiting or number % RELEARNING_SNAPSHOTS:
            return []
        std, events = relative_std(belief), []
        for camera in waiting:
            part = slice(0, EXTRINSICS_AND_PINHOLE)
            known = std[camera, part] <= RELEARNT * self.before[camera][part]
            if camera in best_known or bool(known.all()):
                event = self.events.pop(camera)
                del self.before[camera]
                accuracy = change_sigma(std[camera], event.change)
                how_well = "" if accuracy is None else f" to +- {round_to(accuracy, 2)} {event.unit}"
                events.append(
                    replace(
                        event,
                        time=time,
                        snapshot=number,
                        kind="relearnt",
                        message=f"{event.message}; known again{how_well}",
                    )
                )
        return events


def shows_upside_down(before: CameraRig, now: CameraRig, camera: int) -> bool:
    """Tell whether a camera's images are turned by 180 degrees against those before, whatever else it did."""
    turn = now.cam_from_rig.rotation[camera] @ before.cam_from_rig.rotation[camera].mT
    return float(geodesic_angle(turn, turn.new_tensor([-1.0, -1.0, 1.0]).diag())) < NEARLY_UPRIGHT


def _describe(kind: str, size: float, sigma: float) -> str:
    """Say what a camera did, for example "turned 0.3 +- 0.01 deg"."""
    unit, scale = SHOWN_UNITS[kind]
    return f"{HOW[kind]} {plus_minus(size * scale, sigma * scale)} {unit}"  # type: ignore[index]


def relative_std(belief: RigBelief) -> Tensor:
    """One standard deviation of every parameter relative to the mean of the cameras that are known well: (C, K)."""
    covariance = belief.covariance()
    turned = covariance.diagonal().view(belief.unit.shape)[:, :3].sum(1)
    weight = turned.clamp_min(1e-30).reciprocal()  # one that may be anywhere says nothing about the others
    jacobian = Gauge(weight / weight.sum()).jacobian(belief.rig)
    spread = (jacobian @ covariance * jacobian).sum(1)
    return spread.clamp_min(0).sqrt().view(belief.unit.shape)


def change_sigma(std: Tensor, change: ChangeKind | None) -> float | None:
    """Standard deviation along the worst direction of a kind of change, from a camera's (K,), in the event's unit."""
    if change is None or change not in CHANGES:
        return None
    return float(std[CHANGES[change]].max()) * SHOWN_UNITS[change][1]
