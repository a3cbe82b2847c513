"""Find cameras whose frames are of other moments than those of the others, from the first such snapshot on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imgcal.association import Associations, PipelineOptions, associate
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.pipeline.clock_offset import LateCamera, find_late_camera, suspects
from imgcal.pipeline.fitting import fit_labelled
from imgcal.pipeline.label_counts import LabelCounts
from imgcal.pipeline.labelled_capture import arrange_frames
from imgcal.pipeline.motion_check import count_fitting_labels
from imgcal.types import CalibrationObject, CameraRig, Detections, MovedError


def require_same_moments(
    error: RefusedError,
    detections: Detections,
    labelled: Associations,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
) -> None:
    """Replace a refusal if its cause is a camera whose frames are of other moments.

    Args:
        error: the refusal.
        detections: all blobs, with the labels of the input alone.
        labelled: the same with all labels.
        rig: as for `find_late_cameras`.
        obj: the calibration object.
        options: how certain a result must be.
    """
    arranged = arrange_frames(labelled, rig, obj)
    counts = count_fitting_labels(arranged, rig, obj, options)
    moves = error.moved if isinstance(error, MovedError) else ()
    moved = tuple((move.camera, detections.snapshot_names.index(move.snapshot)) for move in moves)
    for slipped in find_late_cameras(detections, counts, rig, obj, options, moved, arranged.labelled):
        raise RefusedError(
            str(slipped),
            python="give the frames of each moment, or leave the camera out (rig.select)",
            command=f"export its frames again, or leave it out: --without {slipped.camera}",
        ) from error


def find_late_cameras(
    detections: Detections,
    counts: LabelCounts,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    moved: tuple[tuple[str, int], ...] = (),
    labelled: Associations | None = None,
) -> tuple[LateCamera, ...]:
    """Find cameras that disagree with the others because their frames are of other moments.

    Args:
        detections: all blobs, with the labels of the input alone.
        counts: how much of them is explained.
        rig: approximate rig; its prior bounds the labelling of blobs.
        obj: the calibration object.
        options: how certain a result must be.
        moved: cameras reported to have moved, and the number of the snapshot of the move.
        labelled: rows of `counts` if several objects were in view; the one seen most often is used.
    """
    asked = suspects(counts, rig.camera_names, moved)
    if obj.parts and asked and labelled is not None:
        where, moments = dict(moved), labelled.moments.tolist()
        moments += moments[-1:]
        asked = {c: where.get(rig.camera_names[c], moments[row]) for c, row in asked.items()}
        counts_of_parts = np.bincount(labelled.part_of_rows, minlength=len(obj.parts))
        counts_of_parts[len(obj.parts) - obj.has_lights :] = 0
        detections, obj = _select_part(detections, obj, int(counts_of_parts.argmax()))

    def others(blobs: Detections) -> tuple[list[int], RigidTransform]:
        lenient = replace(options, blind_cameras=True)
        fit = fit_labelled(associate(blobs, rig, obj, options.begin_at(None)), rig, obj, lenient)
        return fit.labelled.used, fit.rig_from_object

    found = (find_late_camera(detections, rig, obj, camera, around, others) for camera, around in asked.items())
    return tuple(late for late in found if late is not None)


def _select_part(detections: Detections, obj: CalibrationObject, part: int) -> tuple[Detections, CalibrationObject]:
    """Keep the labels of one of several objects: the rest is clutter."""
    first = int(np.searchsorted(obj.part_of, part))
    own = (detections.fiducial >= 0) & (obj.part_of[detections.fiducial] == part)
    return replace(detections, fiducial=np.where(own, detections.fiducial - first, -1)), obj.parts[part]
