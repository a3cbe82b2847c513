"""`imgcal score`: how well a rig explains observations, as JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from imgcal.cli.common import open_rig, progress, read_detections
from imgcal.detection import DetectionOptions
from imgcal.io import load_object, open_input
from imgcal.pipeline import RigScore, rms_length, score, unit_doubt
from imgcal.types import CameraRig


@dataclass(frozen=True)
class Score:
    """Measure the reprojection error of a rig that is held fixed; only the object's pose is fitted in each snapshot.

    Prints JSON: median_px, p95_px, rms_px, outliers, rms_px_with_outliers, points, snapshots_used, snapshots_rejected,
    per_camera. All are of distances in the image; the RMS is that of OpenCV's calibrateCamera, sqrt(2) times the
    paper's RE. Outliers are much farther off than most of their camera, as
    half-hidden markers are; they count in median_px and p95_px.
    Example: imgcal score my_capture --rig out/rig.yaml --object object.csv
    """

    input: Annotated[Path, tyro.conf.Positional]  #: capture folder or detections file
    rig: str  #: rig file, or the name of a shipped rig
    object: str  #: object file, or the name of a shipped object
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)

    def run(self) -> None:
        """Score and print."""
        rig, obj = open_rig(self.rig), load_object(self.object)
        source = open_input(self.input, rig, obj.num_fiducials, self.videos_differ)
        detections, _ = read_detections(source, self.snapshots, self.detection)

        def bar(snapshots: Iterable[int], total: int) -> Iterable[int]:
            return progress(snapshots, total, "scoring")

        print(json.dumps(summary(score(detections, rig, obj, progress=bar), rig), indent=2))
        if doubt := unit_doubt(rig, obj):
            print(f"note: {doubt}", file=sys.stderr)


def summary(scored: RigScore, rig: CameraRig) -> dict[str, object]:
    """Put a score into the form that scripts read: robust figures first."""
    per_camera = {}
    for camera, name in enumerate(rig.camera_names):
        seen, outlier = scored.seen[:, camera], scored.outliers[:, camera]
        distances = scored.residual[:, camera].norm(dim=-1)[seen]
        per_camera[name] = {
            "median_px": float(distances.median()) if len(distances) else None,
            "rms_px": rms_length(scored.residual[:, camera], seen & ~outlier),
            "points": int(seen.sum()),
            "outliers": int(outlier.sum()),
        }
    used = len(scored.labelled.used)
    return {
        "median_px": float(scored.distances.median()),
        "p95_px": float(torch.quantile(scored.distances, 0.95)),
        "rms_px": rms_length(scored.residual, scored.seen & ~scored.outliers),
        "outliers": int(scored.outliers.sum()),
        "rms_px_with_outliers": rms_length(scored.residual, scored.seen),
        "points": int(scored.seen.sum()),
        "snapshots_used": used,
        "snapshots_rejected": len(scored.labelled.snapshots) - used,
        "per_camera": per_camera,
    }
