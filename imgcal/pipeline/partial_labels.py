"""Say in a refusal that labels were given in part only: where a snapshot has any, its other blobs get none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from imgcal.errors import RefusedError
from imgcal.messages import name_cameras, plural
from imgcal.types import Detections


@contextmanager
def name_missing_labels(detections: Detections) -> Iterator[None]:
    """Complete a refusal that leaves the block by what the given labels lack.

    Args:
        detections: the blobs as given.

    Raises:
        RefusedError: the same one.
    """
    try:
        yield
    except RefusedError as error:
        if missing := describe_missing_labels(detections):
            error.append(missing)
        raise


def describe_missing_labels(detections: Detections) -> str:
    """Name the snapshots without labels, and the cameras without labels in the others.

    Returns:
        Empty if all have labels, as far as they see anything, or none has.
    """
    shape = len(detections.snapshot_names), len(detections.camera_names)
    labelled, blobs = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for images, rows in ((blobs, detections.usable), (labelled, detections.labelled)):
        images[detections.snapshot[rows], detections.camera[rows]] = True
    has_labels = labelled.any(1)
    if not has_labels.any():
        return ""
    bare = int((blobs.any(1) & ~has_labels).sum())
    missing = [f"{bare} of {plural(shape[0], 'snapshot')} have none"] if bare else []
    cameras = np.flatnonzero(blobs[has_labels].any(0) & ~labelled.any(0)).tolist()
    if cameras:
        names = name_cameras(detections.camera_names[camera] for camera in cameras)
        missing.append(f"{names} {'has' if len(cameras) == 1 else 'have'} none")
    if not missing:
        return ""
    return (
        f"labels are given in part only: {', '.join(missing)}; where a snapshot has labels, blobs without one are left "
        "out: give all labels, or none"
    )
