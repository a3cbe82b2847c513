"""How many blobs there were, how many got a label and how many labels do not fit, in the form that scripts read."""

from __future__ import annotations

from typing import Any

import numpy as np

from imgcal.pipeline import DOUBTFUL, Calibration, Tally
from imgcal.types import CameraRig, Detections


def counts_by_camera(calibration: Calibration, camera: int) -> dict[str, int]:
    """Count over all snapshots."""
    # Rows of one snapshot have its blobs in common: each blob counts once.
    blobs = int((calibration.labelled.detections.camera == camera).sum())
    return _counts(calibration.tally, np.s_[:, camera]) | {"blobs": blobs}


def counts_by_snapshot(calibration: Calibration) -> dict[str, dict[str, int]]:
    """Count over all cameras: snapshot name -> numbers."""
    labelled, counts = calibration.labelled, dict[str, dict[str, int]]()
    blobs = np.bincount(labelled.detections.snapshot, minlength=len(labelled.snapshots)).tolist()
    for s, snapshot in enumerate(labelled.snapshots):
        # Rows of one snapshot have its blobs in common: each blob counts once.
        own = _counts(calibration.tally, np.s_[s]) | {"blobs": blobs[s]}
        earlier = counts.get(snapshot.name, dict.fromkeys(own, 0))
        counts[snapshot.name] = {name: earlier[name] + value for name, value in own.items()}
    return counts


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


def _counts(counts: Tally, part: Any) -> dict[str, int]:
    return {name: int(getattr(counts, name)[part].sum()) for name in ("blobs", "labelled", "outliers")}
