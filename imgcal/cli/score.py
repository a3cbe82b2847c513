"""`imgcal score`: how well a rig explains observations, as JSON."""

from __future__ import annotations

import json
import sys
from functools import partial

import torch

from imgcal.cli import arguments
from imgcal.cli.common import open_rig, progress, read_detections
from imgcal.io import load_objects, open_input
from imgcal.pipeline import RigScore, rms_length, score, unit_doubt
from imgcal.types import CameraRig


class Score(arguments.Score):
    """Run `imgcal score`."""

    def run(self) -> None:
        """Score and print."""
        rig, obj = open_rig(self.rig), load_objects(self.object)
        source = open_input(self.input, rig, obj.rows, self.videos_differ)
        detections, _ = read_detections(source, self.snapshots, self.detection, board=obj.board)
        bar = partial(progress, label="scoring")
        print(json.dumps(summary(score(detections, rig, obj, progress=bar), rig), indent=2))
        if doubt := unit_doubt(rig, obj):
            print(f"note: {doubt}", file=sys.stderr)


def summary(scored: RigScore, rig: CameraRig) -> dict[str, object]:
    """Summarize a score as plain values, robust figures first."""
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
    used, total = scored.labelled.moment_counts
    return {
        "median_px": float(scored.distances.median()),
        "p95_px": float(torch.quantile(scored.distances, 0.95)),
        "rms_px": rms_length(scored.residual, scored.seen & ~scored.outliers),
        "outliers": int(scored.outliers.sum()),
        "rms_px_with_outliers": rms_length(scored.residual, scored.seen),
        "points": int(scored.seen.sum()),
        "snapshots_used": used,
        "snapshots_rejected": total - used,
        "per_camera": per_camera,
    }
