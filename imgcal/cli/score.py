"""`imgcal score`: how well a rig explains observations, as a table or JSON."""

from __future__ import annotations

import json
import sys
from functools import partial
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from imgcal.cli import arguments
from imgcal.cli.common import open_rig, progress, read_detections, require_board_files
from imgcal.io import load_objects, open_input
from imgcal.messages import plural
from imgcal.pipeline import RigScore, rms_length, score, unit_doubt
from imgcal.types import CameraRig


class Score(arguments.Score):
    """Run `imgcal score`."""

    def run(self) -> None:
        """Score and print."""
        rig, obj = open_rig(self.rig), load_objects(self.object)
        source = open_input(self.input, rig, obj.rows, self.videos_differ)
        require_board_files(self.object, source)
        detections, _ = read_detections(source, self.snapshots, self.detection, board=obj.board)
        bar = partial(progress, label="scoring")
        found = summary(score(detections, rig, obj, progress=bar), rig)
        if sys.stdout.isatty() and not self.json:
            Console().print(table(found), *lines(found), sep="\n", markup=False, highlight=False)
        else:
            print(json.dumps(found, indent=2))
        if doubt := unit_doubt(rig, obj):
            print(f"note: {doubt}", file=sys.stderr)


def table(found: dict[str, Any]) -> Table:
    """Show a summary, a row per camera and one for all."""
    shown = Table("camera", title="Reprojection error (px)", title_justify="left")
    for name in ("median", "RMS", "points", "outliers"):
        shown.add_column(name, justify="right")
    for name, row in [*found["per_camera"].items(), ("all", found)]:
        shown.add_row(name, _pixels(row["median_px"]), _pixels(row["rms_px"]), str(row["points"]), str(row["outliers"]))
    return shown


def lines(found: dict[str, Any]) -> list[str]:
    """Say what a table of cameras does not show."""
    return [
        f"95 % of the points are within {_pixels(found['p95_px'])} px; the RMS leaves outliers out, with them it is "
        f"{_pixels(found['rms_px_with_outliers'])} px",
        f"{plural(found['snapshots_used'], 'snapshot')} used, {found['snapshots_rejected']} rejected",
    ]


def _pixels(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def summary(scored: RigScore, rig: CameraRig) -> dict[str, Any]:
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
