"""The health of each camera of a running rig in a word, and of the rig in a sentence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from imgcal.online.events import Event
from imgcal.online.keeper_memory import KeeperMemory
from imgcal.online.rig_state import CALIBRATED, CameraHealth

VAIN = 2
"""Successive snapshots that do not fit in most cameras; a single one may just have wrong labels."""
SAID: Mapping[CameraHealth, tuple[str, str]] = {
    "lost": ("is lost", "are lost"),
    "blind": ("is blind", "are blind"),
    "relearning": ("moved and is being recalibrated", "moved and are being recalibrated"),
    "doubtful": ("is in doubt", "are in doubt"),
    "dirty": ("is dirty", "are dirty"),
    "defocused": ("is out of focus", "are out of focus"),
    "unseen": ("has not seen the object yet", "have not seen the object yet"),
    "hidden": ("does not see the object", "do not see the object"),
}
"""The words for one camera, and for several."""


def camera_health(memory: KeeperMemory, predicted: NDArray[np.float64]) -> dict[str, CameraHealth]:
    """The health of each camera, by name; `predicted`: (C, N, 2) px, fiducials in the images, nan if unknown."""
    found: dict[str, CameraHealth] = {}
    hidden = memory.sightings.hidden_cameras(memory.belief.rig, predicted)
    doubted = {
        *memory.sightings.doubtful_cameras(memory.time),
        *memory.monitor.quarantine.cameras,
        *memory.monitor.undecided,
    }
    if memory.in_vain >= VAIN:
        doubted |= set(range(memory.prior.num_cameras))  # it is unknown which of them have moved
    for camera, name in enumerate(memory.prior.camera_names):
        if camera in memory.sightings.lost:
            found[name] = "lost"
        elif camera not in memory.sightings.seen:
            found[name] = "unseen"
        elif camera in memory.relearning.events:
            found[name] = "relearning"
        elif camera in memory.off or camera in doubted:
            found[name] = "doubtful"
        else:
            found[name] = memory.told_health.get(camera, "hidden" if camera in hidden else "ok")
    return found


def take_health(memory: KeeperMemory, event: Event) -> None:
    """Remember a test's verdict on a camera."""
    if event.camera is None:
        return
    camera = memory.prior.camera_names.index(event.camera)
    if event.kind in ("dirty", "defocused"):
        memory.told_health[camera] = event.kind
    elif event.kind == "camera_lost":
        memory.told_health[camera] = "blind"
    elif event.kind in ("clean", "camera_back"):
        memory.told_health.pop(camera, None)


def describe_health(health: Mapping[str, CameraHealth], learnt: int) -> str:
    """Describe a rig's health in a sentence; `learnt` is the number of learned snapshots.

    Examples:
        >>> describe_health({"cam01": "ok", "cam02": "lost", "cam03": "lost"}, 9)
        'cam02, cam03 are lost'
        >>> describe_health({"cam01": "ok", "cam02": "hidden"}, 9)
        'all 2 cameras are calibrated; cam02 does not see the object'
    """
    if not learnt:
        return "the object has not been seen yet"
    parts = []
    for state, words in SAID.items():
        names = [name for name, found in health.items() if found == state]
        if names:
            parts.append(f"{', '.join(names)} {words[len(names) > 1]}")
    if not set(health.values()) - CALIBRATED:
        parts.insert(0, f"all {len(health)} cameras are calibrated")
    return "; ".join(parts)
