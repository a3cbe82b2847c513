"""How many blobs there were, how many got a label and how many labels do not fit, in the form that scripts read."""

from __future__ import annotations

from typing import Any

import numpy as np

from imgcal.pipeline import DOUBTFUL, Calibration, LabelCounts
from imgcal.types import CameraRig, Detections


def counts_by_camera(calibration: Calibration, camera: int) -> dict[str, int]:
    """Count over all snapshots."""
    blobs = int((calibration.labelled_detections.camera == camera).sum())
    return {"blobs": blobs, **_counts(calibration.tally, np.s_[:, camera])}


def counts_by_snapshot(calibration: Calibration) -> dict[str, dict[str, int]]:
    """Count over all cameras: snapshot name -> numbers."""
    detections = calibration.labelled_detections
    blobs = np.bincount(detections.snapshot, minlength=len(detections.snapshot_names)).tolist()
    found = {
        name: {"blobs": count, "labelled": 0, "outliers": 0}
        for name, count in zip(detections.snapshot_names, blobs, strict=True)
    }
    for row, snapshot in enumerate(calibration.labelled.snapshots):  # several rows may be of one snapshot
        for key, count in _counts(calibration.tally, np.s_[row]).items():
            found[snapshot.name][key] += count
    return found


def blobs_by_camera(detections: Detections, rig: CameraRig) -> dict[str, dict[str, Any]]:
    """What is known of each camera where nothing could be decided."""
    found = np.bincount(detections.camera, minlength=len(detections.camera_names)).tolist()
    blobs = dict(zip(detections.camera_names, found, strict=True))
    return {name: {"blobs": blobs.get(name, 0), "labelled": None, "outliers": None} for name in rig.camera_names}


def doubtful_cameras(calibration: Calibration) -> list[str]:
    """Say of which cameras a part of what they see of the object is not where it should be."""
    kept, unexplained = calibration.tally.kept.sum(0), calibration.tally.unexplained.sum(0)
    doubtful = np.flatnonzero(unexplained > DOUBTFUL * np.maximum(kept + unexplained, 1))
    stopped = [str(camera) for camera in calibration.doubtful]
    return [f"{late}; these took no part" for late in calibration.late] or stopped + [
        f"camera {calibration.rig.camera_names[c]}: {unexplained[c]} blobs may be fiducials and are not where these "
        f"should be, {kept[c]} are"
        for c in doubtful
    ]


def _counts(counts: LabelCounts, part: Any) -> dict[str, int]:
    return {name: int(getattr(counts, name)[part].sum()) for name in ("labelled", "outliers")}
