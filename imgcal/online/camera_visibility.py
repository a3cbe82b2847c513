"""Track which cameras of a running rig see the object: lost cameras, and cameras that are back."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imgcal.medians import median
from imgcal.online.events import Event
from imgcal.types import CameraRig, Detections

LEAST_EXPECTED = 3
"""Number of fiducials that should be in view before their absence counts."""
MARGIN = 0.05
"""Margin at the image border, as a share of the image size, in which a fiducial may be out of view."""
HIDDEN_SNAPSHOTS = 3
"""Successive snapshots in which a camera sees nothing of what it should see until the object is hidden from it."""
ASTRAY_SNAPSHOTS, ASTRAY_SECONDS = 2, 0.4
"""Snapshots and seconds for which a camera must see a possible object in the wrong place until it counts as lost. Hands
and passers-by last less. The camera is in doubt at once."""
ABSENT_SECONDS, ABSENT_SNAPSHOTS = 2.0, 30
"""Seconds and snapshots for which a camera must miss what it should see until it counts as lost: arms hide objects."""
SILENT_SECONDS = 0.5
"""Minimum time without data from a camera until it counts as lost; `ABSENT_SECONDS` applies until its rate is known."""
RESTS, LATEST = 3.0, 8
"""How long to wait for a slow camera, in multiples of its usual interval, and how many intervals give that median."""


def well_inside(predicted: NDArray[np.float64], rig: CameraRig) -> NDArray[np.bool_]:
    """Tell which predictions (C, N, 2) px, NaN = none, are far enough inside the image that they should be seen."""
    size = rig.image_size.numpy()[:, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(((predicted > MARGIN * size) & (predicted < (1 - MARGIN) * size)).all(-1))


@dataclass(frozen=True)
class VisibleObject:
    """What the cameras saw in a snapshot."""

    time: float
    number: int
    blobs: Detections  # labelled
    predicted: NDArray[np.float64]  # (C, N, 2), nan if unknown
    astray: frozenset[int]  # cameras that see a possible object in the wrong place
    silent: frozenset[int]  # cameras without data
    left_out: frozenset[int] = frozenset()  # late cameras whose blobs could not be corrected, and got no labels


@dataclass
class CameraVisibility:
    """Tracks the visibility of the object in every camera."""

    names: tuple[str, ...]
    seen: set[int] = field(default_factory=set)  # cameras that have ever had labels
    lost: dict[int, float] = field(default_factory=dict)  # camera -> time of the loss
    missing: dict[int, tuple[float, int]] = field(default_factory=dict)  # not lost yet: start, number of snapshots
    silent: dict[int, float] = field(default_factory=dict)  # start of the silence
    heard: dict[int, deque[float]] = field(default_factory=dict)  # latest times of data
    astray: dict[int, tuple[float, int, float]] = field(default_factory=dict)  # start, number of snapshots, latest

    @property
    def missing_cameras(self) -> frozenset[int]:
        """Cameras that did not see the object where it should have been in view, and have not seen it since."""
        return frozenset(camera for camera, (_, times) in self.missing.items() if times >= HIDDEN_SNAPSHOTS)

    def hidden_cameras(self, rig: CameraRig, predicted: NDArray[np.float64]) -> frozenset[int]:
        """Those of them in which the object should still be in view: mostly, something hides it.

        Args:
            rig: the current one.
            predicted: (C, N, 2) px, nan if the object's pose is unknown; it may then be in view.
        """
        missing = self.missing_cameras
        if not missing:
            return missing
        unknown = set(np.flatnonzero(np.isnan(predicted).all((1, 2))).tolist())
        return missing & (self._should_see(rig, predicted) | unknown)

    def doubtful_cameras(self, time: float) -> frozenset[int]:
        """Cameras that have lately seen a possible object in the wrong place, and nothing better since."""
        return frozenset(
            camera for camera, (_, _, latest) in self.astray.items() if time - latest <= self._patience(camera)
        )

    def observe(self, rig: CameraRig, look: VisibleObject) -> list[Event]:
        """Return which cameras are lost or back with this snapshot."""
        count = np.bincount(look.blobs.camera[look.blobs.fiducial >= 0], minlength=len(self.names))
        some = set(np.flatnonzero(count).tolist())
        self.seen |= some
        labelled = set(np.flatnonzero(count >= labels_to_reappear(look.predicted.shape[1])).tolist()) - look.astray
        self._listen(look)
        absent = self._should_see(rig, look.predicted) - some - look.astray - look.silent - look.left_out
        for camera in labelled:
            self.missing.pop(camera, None)
            self.astray.pop(camera, None)
        for camera in absent:
            first, times = self.missing.get(camera, (look.time, 0))
            self.missing[camera] = min(first, look.time), times + 1  # clocks may be set back
        for camera in look.astray:
            first, times, latest = self.astray.get(camera, (look.time, 0, look.time))
            if look.time - latest > self._patience(camera):  # it has seen nothing since: this is something else
                first, times = look.time, 0
            self.astray[camera] = min(first, look.time), times + 1, look.time
        events = []
        for camera in range(len(self.names)):
            why = self._find_reason(camera, look)
            if why is not None and camera not in self.lost:
                since, message = why
                self.lost[camera] = since
                events.append(self._event("camera_lost", camera, since, message, look))
            elif camera in self.lost and camera in labelled:
                since = self.lost.pop(camera)
                events.append(self._event("camera_back", camera, since, "sees the object again", look))
        return events

    def _listen(self, look: VisibleObject) -> None:
        """Note which cameras sent data, and since when the others have not."""
        for camera in set(range(len(self.names))) - look.silent:
            heard = self.heard.setdefault(camera, deque(maxlen=LATEST + 1))
            if heard and look.time < heard[-1]:  # the clocks were set back
                heard.clear()
            heard.append(look.time)
        self.silent = {camera: min(self.silent.get(camera, look.time), look.time) for camera in look.silent}

    def _patience(self, camera: int) -> float:
        """Time (s) for which a camera may be silent."""
        times = self.heard.get(camera, ())
        if len(times) < 3:
            return ABSENT_SECONDS
        return max(SILENT_SECONDS, RESTS * median(np.diff(times)))

    def _find_reason(self, camera: int, look: VisibleObject) -> tuple[float, str] | None:
        first, times, latest = self.astray.get(camera, (look.time, 0, look.time))
        if times >= ASTRAY_SNAPSHOTS and latest - first >= ASTRAY_SECONDS:
            return min(first, self.missing.get(camera, (first, 0))[0]), (
                "sees what may be the object, but in the wrong place: the camera has moved far; move the object "
                "through the middle of its image, and the camera will be found again"
            )
        if camera in self.silent and look.time - self.silent[camera] >= self._patience(camera):
            why = "sends nothing usable when the other cameras do: it is off or stuck, or its clock is wrong"
            return self.silent[camera], why
        first, times = self.missing.get(camera, (look.time, 0))
        if times >= ABSENT_SNAPSHOTS and look.time - first >= ABSENT_SECONDS:
            return first, "does not see the object, which should be in view: it is covered, or has turned away"
        return None

    def _should_see(self, rig: CameraRig, predicted: NDArray[np.float64]) -> set[int]:
        """Cameras in which the object is well inside the image."""
        return set(np.flatnonzero(well_inside(predicted, rig).sum(1) >= LEAST_EXPECTED).tolist())

    def _event(self, kind: str, camera: int, since: float, message: str, look: VisibleObject) -> Event:
        name = self.names[camera]
        return Event(look.time, look.number, kind, name, since, message=f"{name} {message}")  # type: ignore[arg-type]


def labels_to_reappear(fiducials: int) -> int:
    """Number of labels that show that a camera sees the object again: one or two occur by chance."""
    return min(LEAST_EXPECTED, (fiducials + 1) // 2)
