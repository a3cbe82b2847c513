"""`imgcal score`: how well a rig explains observations, as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from imgcal.cli.common import progress, read_detections
from imgcal.detection import DetectionOptions
from imgcal.io import load_object, load_rig, open_input
from imgcal.pipeline import RigScore, rms_length, score
from imgcal.types import CameraRig


@dataclass(frozen=True)
class Score:
    """Measure the reprojection error of a rig that is held fixed; only the object's pose is fitted in each snapshot.

    Prints JSON: rms_px, median_px, p95_px, snapshots_used, snapshots_rejected, per_camera. All three are of
    distances in the image; the RMS is that of OpenCV's calibrateCamera, sqrt(2) times the paper's RE.
    Example: imgcal score my_capture --rig out/rig.yaml --object object.csv
    """

    input: Annotated[Path, tyro.conf.Positional]  #: capture folder or detections file
    rig: str  #: rig file, or the name of a shipped rig
    object: str  #: object file, or the name of a shipped object
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)

    def run(self) -> None:
        """Score and print."""
        rig, obj = load_rig(self.rig), load_object(self.object)
        detections, _ = read_detections(open_input(self.input, rig, obj.num_fiducials), self.snapshots, self.detection)

        def bar(snapshots: Iterable[int], total: int) -> Iterable[int]:
            return progress(snapshots, total, "scoring")

        print(json.dumps(summary(score(detections, rig, obj, progress=bar), rig), indent=2))


def summary(scored: RigScore, rig: CameraRig) -> dict[str, object]:
    """Put a score into the form that scripts read."""
    distances = scored.distances
    per_camera = {}
    for camera, name in enumerate(rig.camera_names):
        seen = scored.seen[:, camera]
        per_camera[name] = {
            "rms_px": rms_length(scored.residual[:, camera], seen),
            "points": int(seen.sum()),
        }
    used = len(scored.labelled.used)
    return {
        "rms_px": rms_length(scored.residual, scored.seen),
        "median_px": float(distances.median()),
        "p95_px": float(torch.quantile(distances, 0.95)),
        "snapshots_used": used,
        "snapshots_rejected": len(scored.labelled.snapshots) - used,
        "per_camera": per_camera,
    }
