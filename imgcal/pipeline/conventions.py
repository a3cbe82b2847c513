"""Name the convention that images or rig do not follow, once a calibration has failed.

A few snapshots are calibrated again with images or rig read in other conventions. Those that work, where ours does not,
are named. Where the cameras' lines of sight to the object tell them apart, only the likely ones are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.pipeline.lines_of_sight import FARTHEST, choose_telling_snapshots, mean_miss
from imgcal.pipeline.turned_images import UPRIGHT, WAYS, turn, undo
from imgcal.types import CameraRig, Detections

MOST_TRIED = 4
"""Snapshots that are calibrated."""
LIKELY, CLOSE = 2.0, np.radians(0.5)
"""A reading is tried if its lines of sight miss by at most this factor, or this angle, more than those of the best."""
CLEAR = np.radians(5.0)
"""Lines of sight that miss by more do not meet: a rig's drift is smaller."""
AS_IN_TABLES = {
    (False, False, True): " (as if v were counted from the bottom)",
    (False, True, False): " (as if u were counted from the right)",
    (True, False, False): " (as if u and v were exchanged)",
}

Fit = Callable[[Detections, CameraRig], float]
"""Calibrate; returns the RMS in pixels. Raises RefusedError."""


@dataclass(frozen=True)
class Reading:
    """Images and rig, read in one convention."""

    words: str  # what they seem to be, and what is expected
    detections: Detections
    rig: CameraRig


def lines_of_sight_miss(detections: Detections, rig: CameraRig) -> bool:
    """Tell whether the cameras' lines of sight to the object clearly do not meet."""
    miss = mean_miss(detections, rig)
    return miss is not None and miss > CLEAR


def require_conventions(error: RefusedError, detections: Detections, rig: CameraRig, fit: Fit) -> None:
    """Replace a refusal if the data calibrate in another convention.

    Args:
        error: the refusal.
        detections: the blobs that were refused.
        rig: the factory calibration, in float64.
        fit: calibrates some of the snapshots.

    Raises:
        RefusedError: names the convention.
    """
    asked = choose_telling_snapshots(detections, rig.num_cameras)
    detections = detections.choose_snapshots(asked)  # reading all of a long capture takes its time
    chosen = choose_telling_snapshots(detections, rig.num_cameras, MOST_TRIED)
    if len(chosen) == 0 or _fit_some(fit, detections, rig, chosen) is not None:
        return
    readings = list(other_readings(detections, rig))
    known = [mean_miss(reading.detections, reading.rig) for reading in readings]
    misses = [FARTHEST if miss is None else miss for miss in known]
    likely = max(LIKELY * min(misses), min(misses) + CLOSE)
    fitting = {
        reading.words: rms
        for reading, miss in zip(readings, misses, strict=True)
        if miss <= likely and (rms := _fit_some(fit, reading.detections, reading.rig, chosen)) is not None
    }
    if fitting:
        words, rms = ", or ".join(fitting), max(fitting.values())
        raise RefusedError(f"{words}; read like that, images and rig fit to {rms:.2g} px; so {error.reason}") from error


def _fit_some(fit: Fit, detections: Detections, rig: CameraRig, snapshots: NDArray[np.int64]) -> float | None:
    """Calibrate one snapshot that most cameras see, then these: the RMS in pixels; None = refused."""
    rms = None
    for some in (choose_telling_snapshots(detections, rig.num_cameras, 1), snapshots):
        try:
            rms = fit(detections.choose_snapshots(some), rig)
        except RefusedError:
            return None
    return rms


def other_readings(detections: Detections, rig: CameraRig) -> Iterator[Reading]:
    """Read images or rig in each of the conventions that files of other origin follow."""
    size = rig.image_size.double().numpy()[detections.camera]
    for way, name in WAYS.items():
        if name != UPRIGHT:
            words = f"all images seem to be {WAYS[undo(way)]}{AS_IN_TABLES.get(way, '')}"
            yield Reading(words, replace(detections, uv=turn(detections.uv, size - 1, way)), rig)
    if len(detections.uv) and detections.uv.min() >= -1 and detections.uv.max() <= 2:
        words = "u and v seem to be normalized by the image's width and height, expected pixels"
        yield Reading(words, replace(detections, uv=detections.uv * size - 0.5), rig)
    cam_from_rig = rig.cam_from_rig
    words = "the rig's poses seem to take a camera to the rig, expected the rig to the camera (cam_from_rig)"
    yield Reading(words, detections, replace(rig, cam_from_rig=cam_from_rig.inverse()))
    flip = cam_from_rig.rotation.new_tensor([1.0, -1.0, -1.0])
    flipped = RigidTransform(flip[:, None] * cam_from_rig.rotation, flip * cam_from_rig.translation)
    words = "the rig's cameras seem to look along -z with y up (as in OpenGL), expected z forward and y down"
    yield Reading(words, detections, replace(rig, cam_from_rig=flipped))
    at_positions = -torch.einsum("cij,cj->ci", cam_from_rig.rotation, cam_from_rig.translation)
    words = "the rig's translations seem to be positions of the cameras, expected those of cam_from_rig"
    yield Reading(words, detections, replace(rig, cam_from_rig=RigidTransform(cam_from_rig.rotation, at_positions)))
