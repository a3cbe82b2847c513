"""Name the convention that images or rig do not follow, once a calibration has failed.

A few snapshots are calibrated again with images or rig read in other conventions. Those that work, where ours does not,
are named. Where the cameras' lines of sight to the object tell them apart, only the likely ones are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import associate_lights, background_rows, image_error
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.messages import plural
from imgcal.pipeline.lines_of_sight import FARTHEST, choose_telling_snapshots, mean_miss
from imgcal.pipeline.turned_images import UPRIGHT, WAYS, turn, undo
from imgcal.types import CameraRig, Detections, RigPrior

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

MOST_MET, MOST_BLOBS, LEAST_MEETING = 40, 4000, 3
"""Snapshots in which rays are compared, and blobs in these; minimum number of cameras: two rays meet too easily."""
LEAST_EVIDENCE, LEAST_LEAD = 50.0, 1.25
"""Log odds by which the markers of one reading must exceed those of any other, and the factor."""

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


def require_meeting_rays(error: RefusedError, detections: Detections, rig: CameraRig) -> None:
    """Replace a refusal if blobs meet in space once images or rig are read in another convention, or cameras renamed.

    This needs no object: sticks and lights have no pattern, but what three cameras see of a marker meets in one point.

    Args:
        error: the refusal.
        detections: the blobs that were refused.
        rig: the factory calibration, in float64.

    Raises:
        RefusedError: names the convention, or the cameras.
    """
    if rig.num_cameras < LEAST_MEETING:
        return
    count = len(detections.snapshot_names)
    most = min(count, MOST_MET, max(MOST_BLOBS * count // max(len(detections), 1), 1))
    detections = detections.choose_snapshots(np.linspace(0, count - 1, most).astype(int))
    detections = detections.select(~background_rows(detections))
    gate = image_error(rig, (rig.prior or RigPrior()).std(rig))
    readings = [Reading("", detections, rig), *other_readings(detections, rig), *other_names(detections, rig)]
    found = [associate_lights(reading.detections, reading.rig, gate) for reading in readings]
    evidence = np.array([float(lights.odds.sum()) for lights in found])
    best = int(evidence.argmax())
    words = readings[best].words
    rivals = evidence[[reading.words != words for reading in readings]]  # in a regular rig, several shifts fit alike
    if best == 0 or evidence[best] < LEAST_EVIDENCE + LEAST_LEAD * rivals.max():
        return
    raise RefusedError(
        f"{words}; read like that, blobs of three cameras or more meet in {plural(len(found[best]), 'place')}"
        f", otherwise in {len(found[0])}; so {error.reason}"
    ) from error


def other_names(detections: Detections, rig: CameraRig) -> Iterator[Reading]:
    """Exchange any two cameras, and shift the names of all by any number."""
    names, count = rig.camera_names, rig.num_cameras
    for pair in combinations(range(count), 2):
        words = f"cameras {names[pair[0]]} and {names[pair[1]]} seem to be exchanged"
        camera = np.arange(count)
        camera[list(pair)] = pair[::-1]
        yield Reading(words, replace(detections, camera=camera[detections.camera]), rig)
    for by in range(1, count):
        words = "the names of all cameras seem to be shifted against those of the rig: each has another one's name"
        yield Reading(words, replace(detections, camera=(detections.camera + by) % count), rig)


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
