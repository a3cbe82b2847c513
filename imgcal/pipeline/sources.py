"""Validate frames or blobs from a program against the rig and the object before use.

Files are checked line by line on reading; this is the same for values in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imgcal.association import Proposer, Sight, match_to_rig
from imgcal.detection import DetectionOptions, Frame, detect
from imgcal.errors import InputError
from imgcal.io import MARGIN, grey_frame, model_file, nearest, require_pixels
from imgcal.matching import MatchedFilter
from imgcal.messages import list_names
from imgcal.pipeline.learned_measurer import LearnedMeasurer
from imgcal.pipeline.learned_proposer import LearnedProposer, load_proposer
from imgcal.types import CalibrationObject, CameraRig, Detections, limits

Frames = Mapping[str, Frame | Sequence[Frame | None] | None]
DETECTORS = ("classical", "matched", "auto", "learned", "both")
DetectorName = str
"""One of `DETECTORS`, or a query network: its file, the folder of its training run, or the name of a shipped one."""
Detector = DetectorName | Proposer | Sight
"""What finds the fiducials in frames: blobs (classical), a matched filter, or the filter if blobs are not sufficient
(auto); a network, or the network if blobs are not sufficient (both); another proposer of labels; or one of them with
frames that are not in memory. Blobs decide if the others cannot."""


def as_unknown_marker(obj: CalibrationObject, detections: Detections) -> CalibrationObject:
    """Take an object of one marker for an unknown marker, unless labels say which blobs are it."""
    is_one = obj.pose_rank == 3 and not obj.parts and not (detections.fiducial >= 0).any()
    return replace(obj.about_centroid(obj.name), unknown_markers=True) if is_one else obj


def as_one(obj: CalibrationObject | Sequence[CalibrationObject]) -> CalibrationObject:
    """One object, or several combined.

    Raises:
        InputError: something else.
    """
    if isinstance(obj, CalibrationObject):
        return obj
    if isinstance(obj, str) or not all(isinstance(part, CalibrationObject) for part in obj):
        found = repr(obj) if isinstance(obj, str) else f"a {type(obj).__name__} of other things"
        raise InputError(f"object: found {found:.80}, expected a CalibrationObject; load_object(...) reads one")
    return CalibrationObject.of_several(obj)


def find_blobs(
    source: Detections | Frames,
    rig: CameraRig,
    obj: CalibrationObject,
    options: DetectionOptions,
    measurer: LearnedMeasurer | None = None,
) -> Detections:
    """Take blobs as they are, or find them in frames and measure them again; number cameras as in the rig.

    Raises:
        InputError: neither blobs nor frames, or not of this rig and object.
    """
    if isinstance(source, Detections):
        if measurer is not None:
            raise InputError(f"measurer {measurer.name}: found blobs without frames, expected frames to look at")
        detections = check_detections(source, rig, obj)
        require_pixels(detections)
        return detections
    frames = check_frames(source, rig)
    if not frames:
        raise InputError(f"frames: found no camera, expected frames of the cameras of rig {rig.name}")
    blobs = detect(frames, options, board=obj.board)
    if obj.board is not None and measurer is not None:
        raise InputError(f"measurer {measurer.name}: found a printed board, expected an object with markers")
    if measurer is not None:
        blobs = measurer.of_snapshots(_read_memory(frames), blobs, options)
    return match_to_rig(blobs, rig)


def make_sight(
    detector: Detector,
    source: Detections | Frames,
    detection: DetectionOptions,
    measurer: LearnedMeasurer | None = None,
) -> Sight | None:
    """Combine a detector with frames in memory; None = blobs alone decide.

    Args:
        detector: the detector.
        source: the frames.
        detection: how blobs are found as well.
        measurer: reads the markers that a network finds.

    Raises:
        InputError: there is no such detector, or there are no frames.
    """
    if isinstance(detector, Sight) or detector == "classical":
        return None if isinstance(detector, str) else detector
    proposer, where_blobs_fail = choose_proposer(detector, measurer)
    if isinstance(source, Detections):
        raise InputError(f"detector {proposer.name}: found blobs without frames, expected frames to look at")
    return Sight(proposer, _read_memory(source), where_blobs_fail, detection)


def choose_proposer(
    detector: DetectorName | Proposer, measurer: LearnedMeasurer | None = None
) -> tuple[Proposer, bool]:
    """Return the proposer, and whether to use it only if blobs are not sufficient.

    Args:
        detector: its name, or the proposer itself.
        measurer: reads the markers of a network given by name.

    Raises:
        InputError: there is no such detector.
    """
    if not isinstance(detector, str):
        return detector, False
    if detector in ("matched", "auto"):
        return MatchedFilter(), detector == "auto"
    if detector in ("learned", "both"):
        return _use_measurer(load_proposer(finder=MatchedFilter()), measurer), detector == "both"
    if not model_file(detector).is_file():
        expected = f"{', '.join(DETECTORS)}, or a network for frames: a file or the folder of a run"
        raise InputError(f"detector: found {detector!r:.80}{nearest(detector, DETECTORS)}, expected {expected}")
    return _use_measurer(load_proposer(detector, finder=MatchedFilter()), measurer), False


def _use_measurer(proposer: LearnedProposer, measurer: LearnedMeasurer | None) -> LearnedProposer:
    return proposer if measurer is None else replace(proposer, measurer=measurer.network)


def _read_memory(source: Frames) -> Callable[[int], Mapping[str, Frame | None]]:
    """Return a function that gives the frames of a snapshot; a camera may have one frame or many."""
    series = {name: entry if isinstance(entry, Sequence) else (entry,) for name, entry in source.items()}
    return lambda number: {name: frames[number] if number < len(frames) else None for name, frames in series.items()}


def check_frames(frames: object, rig: CameraRig) -> dict[str, Any]:
    """Return grey frames by camera, (H, W) each or a list of them.

    Frames of three equal channels, as OpenCV reads grey videos, count as grey, as in files.

    Raises:
        InputError: a camera or an image size is not the rig's, or a frame is not grey.
    """
    if not isinstance(frames, Mapping):
        raise InputError(f"found a {type(frames).__name__}, expected Detections or frames: {{camera name: frame}}")
    sizes = dict(zip(rig.camera_names, rig.image_size.tolist(), strict=True))
    checked: dict[str, Any] = {}
    for camera, entry in frames.items():
        if camera not in sizes:
            raise InputError(
                f"frames: found camera {camera!s:.80}, expected cameras of rig {rig.name}: {', '.join(sizes)}"
            )
        width, height = (int(size) for size in sizes[camera])
        if isinstance(entry, Sequence) and not isinstance(entry, str):
            checked[camera] = [_check_frame(frame, camera, width, height, rig) for frame in entry]
        else:
            checked[camera] = _check_frame(entry, camera, width, height, rig)
    return checked


def _check_frame(frame: Any, camera: str, width: int, height: int, rig: CameraRig) -> Any:
    """Check the size of a frame; detection explains other faults."""
    if not isinstance(frame, np.ndarray):
        return frame
    if frame.ndim == 3 or not frame.dtype.isnative or np.ma.is_masked(frame):
        frame = grey_frame(frame, f"camera {camera}")
    if frame.ndim == 2 and frame.shape != (height, width):
        raise InputError(
            f"camera {camera}: found a frame of {frame.shape[1]}x{frame.shape[0]} pixels, "
            f"expected {width}x{height} as in rig {rig.name}"
        )
    return frame


def check_detections(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Detections:
    """Return detections with cameras numbered as in the rig, if they fit this rig and object.

    Labels of unknown markers are taken off: they mean nothing from one snapshot to the next.

    Raises:
        InputError: inconsistent columns, a camera, fiducial or pixel that does not exist, a fiducial that a camera has
            twice in a snapshot, an invalid standard deviation, or several cameras that share no snapshot.
    """
    if obj.unknown_markers:
        detections = replace(detections, fiducial=np.full(np.shape(detections.uv)[:1], -1))
    elif obj.has_lights:
        nameless = detections.fiducial == obj.num_fiducials - 1
        detections = replace(detections, fiducial=np.where(nameless, -1, detections.fiducial))
    limits.check_detections(detections)
    beyond = detections.fiducial >= obj.num_fiducials
    if beyond.any():
        row = int(beyond.argmax())
        raise InputError(
            f"detections: fiducial: found {detections.fiducial[row]} in row {row}, expected a row of the object, 0 to "
            f"{obj.num_fiducials - 1}, or -1"
        )
    detections = match_to_rig(detections, rig)
    size = rig.image_size.numpy()[detections.camera]
    inside = ((detections.uv >= -0.5 - MARGIN) & (detections.uv <= size - 0.5 + MARGIN)).all(axis=1)
    if not inside.all():
        row = int(inside.argmin())
        (u, v), (width, height) = detections.uv[row], size[row]
        raise InputError(
            f"detections: found ({u:g}, {v:g}) in row {row}, expected a pixel of the {width}x{height} image of camera "
            f"{rig.camera_names[detections.camera[row]]}"
        )
    if len(detections.snapshot_names) > 1:
        _require_shared_snapshot(detections)
    return detections


def _require_shared_snapshot(detections: Detections) -> None:
    """Require a snapshot in which two cameras have blobs: without one, nothing relates the cameras to each other."""
    shape = len(detections.snapshot_names), len(detections.camera_names)
    blobs = np.bincount(detections.snapshot * shape[1] + detections.camera, minlength=shape[0] * shape[1])
    seen = blobs.reshape(shape) > 0
    showing = np.flatnonzero(seen.any(axis=0))
    if len(showing) < 2 or seen.sum(axis=1).max() > 1:
        return
    names = [
        f"{detections.camera_names[camera]}: "
        f"{list_names(detections.snapshot_names[each] for each in np.flatnonzero(seen[:, camera]))}"
        for camera in showing[:2]
    ]
    raise InputError(
        f"detections: found no snapshot in which two cameras have blobs ({'; '.join(names)}), expected what cameras "
        "see at one moment in snapshots of one name"
    )
