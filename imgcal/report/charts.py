"""The still charts of the report: residuals, errors by camera and fiducial, coverage, snapshots, time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from imgcal.pipeline import FIELDS
from imgcal.report import svg
from imgcal.report.content import ReportContent
from imgcal.report.svg import Array, Axes

LARGEST_SCATTER = 6000  # residuals in one scatter
LARGEST_PANEL = 1200  # observations in one camera's panel of the coverage, less with more than ten cameras
FEW = 500  # residuals: fewer are drawn as larger dots
RESIDUAL_CLASSES = 6  # colours of the residual's size: classes c0 to c5 of the style sheet


def sample(rows: NDArray[np.int64], largest: int) -> NDArray[np.int64]:
    """Choose at most `largest` rows at random, the same ones every time."""
    if len(rows) <= largest:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, largest, replace=False))


def scatter_limit(residual: Array) -> float:
    """Half the width of a scatter that shows 99.5 % of the residuals: pixels."""
    return max(1.1 * float(np.quantile(np.abs(residual).max(axis=1), 0.995)), 1e-6)


def residual_scatter(residual: Array, limit: float, kind: str) -> Markup:
    """Draw residual vectors (K, 2) in pixels as dots; `kind` is "before" or "after"."""
    axes = Axes(48, 348, 10, 310, (-limit, limit), (limit, -limit))
    inside = np.abs(residual).max(axis=1) <= limit
    centre = svg.line(axes.left, 160, axes.right, 160, "zero") + svg.line(198, axes.top, 198, axes.bottom, "zero")
    style = f"dot {kind}" + (" few" if len(residual) < FEW else "")
    points = svg.dots(axes.x(residual[inside, 0]), axes.y(residual[inside, 1]), style)
    outside = int((~inside).sum())
    note = svg.text(axes.right - 6, axes.bottom - 7, f"{outside} outside", anchor="end") if outside else ""
    frame = svg.box(axes.left, axes.top, 300, 300, "frame")
    title = f"Residual vectors {kind} recalibration, axes to {limit:.3g} px"
    return svg.drawing(
        360, 350, title, frame, svg.grid(axes, "u error (px)", "v error (px)", count=4), centre, points, note
    )


def whitened_histogram(whitened: Array) -> Markup:
    """Draw the distribution of residuals in standard deviations (K, 2) against the unit normal."""
    edges = np.linspace(-5, 5, 41)
    density = np.histogram(whitened, edges)[0] / (whitened.size * (edges[1] - edges[0]))
    normal_x = np.linspace(-5, 5, 101)
    normal = np.exp(-0.5 * normal_x**2) / math.sqrt(2 * math.pi)
    axes = Axes(42, 348, 10, 310, (-5, 5), (0, 1.12 * max(float(density.max()), float(normal.max()))))
    left, top = axes.x(edges), axes.y(density)
    width = float(left[1] - left[0]) - 1
    bars = [svg.box(x + 0.5, y, width, axes.bottom - y, "bar after") for x, y in zip(left[:-1], top, strict=True)]
    curve = svg.polyline(axes.x(normal_x), axes.y(normal), "curve")
    return svg.drawing(
        360, 350, "Histogram of residuals in standard deviations against the unit normal",
        svg.grid(axes, "error after / its standard deviation", "density"), *bars, curve,
    )  # fmt: skip


def rms_by_camera(content: ReportContent) -> Markup:
    """Draw the RMS of each camera before and after, on a logarithmic axis."""
    count = len(content.cameras)
    before = content.rms_by(content.detections.camera, content.residual_before, count)
    after = content.rms_by(content.detections.camera, content.residual_after, count)
    both = np.concatenate((before, after))
    both = np.log10(np.maximum(both[np.isfinite(both)], 1e-6))
    names = [svg.shorten_name(name) for name in content.cameras]
    margin = 24 + 6.5 * max(len(name) for name in names)
    limits = (float(both.min()) - 0.1, float(both.max()) + 0.1)
    axes = Axes(margin, 330, 6, 12 + 22 * count, limits, (0, 1))
    parts = [svg.grid(axes, "RMS error (px), logarithmic", log_x=True)]
    for i, name in enumerate(names):
        y = 20 + 22 * i
        parts.append(svg.text(axes.left - 8, y + 4, name, kind="label", anchor="end"))
        if np.isnan(after[i]):
            parts.append(svg.text(axes.left + 8, y + 4, "no observations", anchor="start"))
            continue
        right = float(axes.x(math.log10(max(after[i], 1e-6))))
        words = f"{svg.pixels(after[i])} px"
        if np.isfinite(before[i]):
            left = float(axes.x(math.log10(max(before[i], 1e-6))))
            parts.append(svg.line(left, y, right, y, "link"))
            parts.append(svg.dots(np.array([left]), np.array([y]), "mark before"))
            words = f"{svg.pixels(before[i])} → {words}"
        parts.append(svg.dots(np.array([right]), np.array([y]), "mark after"))
        parts.append(svg.text(axes.right + 8, y + 4, words, anchor="start"))
    return svg.drawing(450, 50 + 22 * count, "RMS error of each camera before and after recalibration", *parts)


def fiducial_rms(content: ReportContent) -> Array:
    """RMS after recalibration of each fiducial: (N,) pixels, nan where it was not seen."""
    count = int(content.labels[content.used].max()) + 1
    if content.object_points is not None:
        count = max(count, len(content.object_points))
    return content.rms_by(np.maximum(content.labels, 0), content.residual_after, count)


def rms_by_fiducial(content: ReportContent) -> Markup:
    """Draw the RMS after recalibration of each fiducial; those far above the median stand out."""
    rms = fiducial_rms(content)
    number = np.bincount(content.labels[content.used], minlength=len(rms))
    median = float(np.nanmedian(rms))
    axes = Axes(62, 450, 10, 220, (-0.5, len(rms) - 0.5), (0, 1.1 * max(float(np.nanmax(rms)), 1e-9)))
    width = (axes.right - axes.left) / len(rms)
    gap = max(min(0.25 * width, 6), width - 36)
    parts = [svg.grid(axes, "fiducial (row of the object file, from 0)", "RMS error after (px)")]
    for i in np.flatnonzero(number):
        top, left = float(axes.y(rms[i])), float(axes.x(i - 0.5))
        kind = "bar high" if rms[i] > 2 * median else "bar after"
        tip = f"fiducial {i}: {svg.pixels(rms[i])} px, {number[i]} observations"
        parts.append(svg.box(left + gap / 2, top, width - gap, axes.bottom - top, kind, tip))
    y = float(axes.y(median))
    parts.append(svg.line(axes.left, y, axes.right, y, "median"))
    return svg.drawing(460, 260, "RMS error of each fiducial after recalibration", *parts)


def coverage_limits(content: ReportContent) -> Array:
    """Upper limits of the residual classes of the coverage, the last one open: (classes - 1,) pixels."""
    size = np.linalg.norm(content.residual_after[content.used], axis=1)
    largest = float(np.quantile(size, 0.98)) if len(size) else 1.0
    return np.linspace(0, max(largest, 1e-9), RESIDUAL_CLASSES)[1:]


def panel_size(content: ReportContent) -> int:
    """Observations drawn in each camera's panel."""
    return min(LARGEST_PANEL, max(100, 10 * LARGEST_PANEL // len(content.cameras)))


def coverage_panel(content: ReportContent, camera: int, limits: Array) -> Markup:
    """Draw where one camera saw the object in all snapshots, coloured by the size of the residual after."""
    width, height = (float(x) for x in content.image_size[camera])
    scale = 240 / width
    own = content.detections.camera == camera
    largest = panel_size(content)
    parts = [svg.box(1, 1, 240, height * scale, "panel")]

    def placed(rows: NDArray[np.int64], kind: str) -> str:
        uv = content.detections.uv[rows]
        return svg.dots(1 + (uv[:, 0] + 0.5) * scale, 1 + (uv[:, 1] + 0.5) * scale, f"spot {kind}", len(rows) or 1)

    unused = sample(np.flatnonzero(own & ~content.used), largest // 3 if content.used.any() else largest)
    parts.append(placed(unused, "unused"))
    rows = sample(np.flatnonzero(own & content.used), largest)
    size = np.searchsorted(limits, np.linalg.norm(content.residual_after[rows], axis=1))
    parts += [placed(rows[size == i], f"c{i}") for i in range(RESIDUAL_CLASSES) if (size == i).any()]
    if not own.any():
        parts.append(svg.text(121, height * scale / 2 + 4, "no blobs"))
    title = f"Coverage of {content.cameras[camera]}"
    return svg.drawing(242, height * scale + 2, title, *parts)


def covered_share(content: ReportContent, camera: int) -> float:
    """Share of an 8 x 8 division of the image in which blobs were used (or labelled, where none could be used)."""
    rows = (content.detections.camera == camera) & (content.used if content.used.any() else content.labels >= 0)
    place = (content.detections.uv[rows] + 0.5) / content.image_size[camera] * FIELDS
    field = np.clip(place, 0, FIELDS - 1).astype(int)
    return len(np.unique(field[:, 0] * FIELDS + field[:, 1])) / FIELDS**2


def snapshot_strip(content: ReportContent) -> Markup:
    """Draw one bar a snapshot: blobs found, blobs used, rejected ones marked."""
    count = len(content.snapshots)
    step = min(1080 / count, 18)
    largest = max(max(s.found for s in content.snapshots), 1)
    parts = []
    for i, snapshot in enumerate(content.snapshots):
        found, used = 44 * snapshot.found / largest, 44 * snapshot.used / largest
        tip = f"{snapshot.name}: {snapshot.used} of {snapshot.found} blobs used"
        if snapshot.reason:
            tip += f"; rejected: {snapshot.reason}"
        thick = max(step * 0.75, step - 3)
        whole, foot = ("bar rejected", "bar rejected") if snapshot.reason else ("bar found", "bar after")
        parts.append(svg.box(i * step, 46 - found, thick, found, whole, tip))
        parts.append(svg.box(i * step, 46 - used, thick, used, "bar after", tip))
        parts.append(svg.box(i * step, 47.5, thick, 3, foot, tip))
    return svg.drawing(1080, 52, "Blobs found and used in each snapshot", *parts)


def time_bars(seconds: Mapping[str, float]) -> Markup:
    """Draw the time of each stage."""
    largest = max(*seconds.values(), 1e-9)
    parts = []
    for i, (stage, value) in enumerate(seconds.items()):
        y = 4 + 22 * i
        parts.append(svg.text(150, y + 13, stage, kind="label", anchor="end"))
        parts.append(svg.box(158, y + 2, max(300 * value / largest, 1), 14, "bar after"))
        parts.append(svg.text(166 + 300 * value / largest, y + 13, duration(value), anchor="start"))
    return svg.drawing(560, 8 + 22 * len(seconds), "Time of each stage", *parts)


def duration(seconds: float) -> str:
    """Write a time: "340 ms", "12.3 s"."""
    if seconds < 1:
        return f"{1e3 * seconds:.3g} ms"
    return f"{seconds:.3g} s" if seconds < 100 else f"{seconds:.0f} s"
