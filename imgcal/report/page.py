"""The page: everything in one HTML file that opens without a network."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from imgcal.io import write_text
from imgcal.live_page import read_asset, render_page, to_json
from imgcal.messages import plural
from imgcal.pipeline import MOVED, UNDETERMINED
from imgcal.report import accuracy, charts, overlay, scene, svg, tables
from imgcal.report.content import UNKNOWN_MARKERS, ReportContent
from imgcal.report.rig_view import rig_view_script
from imgcal.report.verdict import judge

LARGEST_SNAPSHOT_TABLE = 400


@dataclass(frozen=True)
class Panel:
    """One camera's picture with its caption."""

    name: str
    figure: Markup
    note: str


def write_report(content: ReportContent, path: str | Path) -> None:
    """Write the report as one HTML page; the file at `path` is replaced in one step.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(path, render(content))


def render(content: ReportContent) -> str:
    """Build the page; the same content gives the same text."""
    return render_page(
        "report/templates/report.html.j2",
        read_asset("report/templates/report.css"),
        (rig_view_script(), read_asset("report/templates/report.js")),
        {"style-src": "'unsafe-inline'", "img-src": "data:"},
        content=content,
        verdict=judge(content),
        snapshots=_snapshots(content),
        residuals=_residuals(content),
        coverage=_coverage(content),
        accuracy=_accuracy(content),
        rig=_rig(content),
        overlays=_overlays(content),
        rows=tables.camera_rows(content),
        groups=tables.GROUPS,
        knowledge=list(zip(content.cameras, tables.knowledge_rows(content), strict=False)),
        parameters=[content.factory.parameter_names[i] for i in tables.columns(content)],
        limits={"moved": MOVED, "undetermined": round(100 * UNDETERMINED)},
        times=charts.time_bars(content.seconds) if content.seconds else None,
        total=charts.duration(sum(content.seconds.values())),
        subsampling=_subsampling(content),
    ).text


def _snapshots(content: ReportContent) -> dict[str, object]:
    rejected = [s for s in content.snapshots if s.reason]
    # What comes after a colon are the numbers of one snapshot.
    kinds = Counter(s.reason.split(": ")[0] for s in rejected if s.reason != content.reason)
    return {
        "strip": charts.snapshot_strip(content) if content.snapshots else None,
        "reasons": kinds.most_common(8),
        "rejected": len(rejected),
        "table": content.snapshots[:LARGEST_SNAPSHOT_TABLE],
        "left_out": max(len(content.snapshots) - LARGEST_SNAPSHOT_TABLE, 0),
    }


def _residuals(content: ReportContent) -> dict[str, object] | None:
    """Charts of the residuals; None when there is no fit."""
    if not content.used.any():
        return None
    rows = charts.sample(np.flatnonzero(content.used), charts.LARGEST_SCATTER)
    after, before = content.residual_after[rows], content.residual_before[rows]
    before = before[np.isfinite(before).all(axis=1)]
    own = charts.scatter_limit(after)
    common = max(own, charts.scatter_limit(before)) if len(before) else own
    beyond = float(np.mean(np.abs(content.whitened) > 3))
    return {
        "before": charts.residual_scatter(before, common, "before") if len(before) else None,
        "after_common": charts.residual_scatter(after, common, "after"),
        "after_own": charts.residual_scatter(after, own, "after"),
        "histogram": charts.whitened_histogram(content.whitened),
        "spread": f"{float(np.sqrt(np.mean(content.whitened**2))):.2f}",
        "beyond": f"{100 * beyond:.2g} %",
        "cameras": charts.rms_by_camera(content),
        "fiducials": charts.rms_by_fiducial(content) if len(charts.fiducial_rms(content)) > 1 else None,
        "median": svg.pixels(float(np.nanmedian(charts.fiducial_rms(content)))),
        "shown": len(rows),
        "total": int(content.used.sum()),
    }


def _coverage(content: ReportContent) -> dict[str, object]:
    limits = charts.coverage_limits(content)
    fitted, labelled = content.used.any(), content.labels >= 0
    rows = content.used if fitted else labelled if labelled.any() else np.ones_like(labelled)
    counts = content.detections.count_by_camera(rows)

    def words(camera: int) -> str:
        number = f"{svg.group_digits(int(counts[camera]))} blob{'' if counts[camera] == 1 else 's'}"
        if not labelled.any():  # what a reflection covers is unknown
            return f"{number}, none labelled"
        return f"{number}, {100 * charts.covered_share(content, camera):.0f} %"

    panels = [
        Panel(
            name,
            charts.coverage_panel(content, i, limits),
            words(i),
        )
        for i, name in enumerate(content.cameras)
    ]
    return {"panels": panels, "limits": [f"{x:.2g}" for x in limits]}


def _accuracy(content: ReportContent) -> dict[str, object] | None:
    """Maps of the predicted error; None where nothing is predicted."""
    predicted = content.predicted
    if predicted is None or not bool(predicted.px.isfinite().any()):
        return None
    px, mm = accuracy.limits(predicted.px.numpy()), accuracy.limits(predicted.mm.numpy())
    panels = [
        Panel(
            name,
            accuracy.camera_map(predicted, i, content.image_size[i], px),
            f"{svg.pixels(error)} px" if math.isfinite(error) else "",
        )
        for i, (name, error) in enumerate(zip(content.cameras, predicted.camera_px, strict=True))
    ]
    size = (predicted.volume.high - predicted.volume.low).tolist()
    slice_, where = accuracy.volume_slice(predicted, mm) if predicted.seen_share else (None, "")
    return {
        "sentences": accuracy.sentences(content),
        "advice": accuracy.advice(content),
        "panels": panels,
        "px_limits": [f"{x:g}" for x in px],
        "mm_limits": [f"{x:g}" for x in mm],
        "slice": slice_,
        "where": where,
        "volume": " × ".join(f"{side:.0f}" for side in size),
        "with_noise": accuracy.length(predicted.median_mm_with_noise),
        "noise": svg.pixels(predicted.noise),
    }


def _rig(content: ReportContent) -> dict[str, object]:
    drawn = scene.describe_scene(content)
    snapshots, _ = scene.choose_fiducials(content)
    return {
        "scene": Markup(to_json(drawn.values)),
        "factors": drawn.factors,
        "start": drawn.start,
        "dots": _dots(content, len(snapshots)) if len(snapshots) else "",
    }


def _dots(content: ReportContent, count: int) -> str:
    """Say what the dots of the rig's drawing are."""
    if content.identity == UNKNOWN_MARKERS:
        return plural(count, "marker")
    return f"the object in {plural(count, 'pose')}"


def _overlays(content: ReportContent) -> dict[str, object]:
    names = content.detections.snapshot_names
    panels = []
    for i, drawn in enumerate(overlay.overlays(content)):
        pictured = bool(content.frames) and content.frames[i] is not None
        panels.append(Panel(content.cameras[i], drawn, "" if pictured else "no frame"))
    return {
        "panels": panels,
        "symbols": overlay.SYMBOLS,
        "snapshot": names[content.frame_snapshots[0]] if names else "",
        "stretched": any(frame is not None for frame in content.frames),
    }


def _subsampling(content: ReportContent) -> list[str]:
    """List what is drawn only in part. All numbers and the histogram use everything."""
    notes = []
    used = int(content.used.sum())
    if used > charts.LARGEST_SCATTER:
        notes.append(
            f"The scatter shows {svg.group_digits(charts.LARGEST_SCATTER)} of {svg.group_digits(used)} residuals."
        )
    panel = charts.panel_size(content)
    if int(content.detections.count_by_camera().max()) > panel:
        notes.append(f"The coverage shows at most {panel} observations of each camera.")
    snapshots, fiducials = scene.choose_fiducials(content)
    total = 0 if content.object_points is None else len(content.object_points)
    poses = scene.known_poses(content)
    if len(snapshots) and (len(snapshots) < len(poses) or len(fiducials) < total):
        each = f" and {len(fiducials)} of {total} fiducials in each" if total > 1 else ""
        noun = "marker" if content.identity == UNKNOWN_MARKERS else "pose"
        notes.append(f"The rig shows {len(snapshots)} of {plural(len(poses), noun)}{each}.")
    d = content.detections
    if int(d.count_by_camera(content.pictured).max()) > overlay.count_drawn_blobs(content):
        notes.append(f"The overlays show at most {overlay.count_drawn_blobs(content)} blobs of each camera.")
    return notes
