"""The report of a fleet on one page: drift, outlier cameras, refusals and their reasons."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from imgcal.fleet import Dataset, KindOfRig, LearntPrior
from imgcal.fleet import refusals as reasons_of
from imgcal.io import write_text
from imgcal.live_page import read_asset, render_page
from imgcal.messages import plural
from imgcal.report import svg
from imgcal.report.svg import Axes
from imgcal.types import PARAMETER_KINDS, RigPrior

WORST = 50
"""Cameras that are listed."""
SURE = 4.0
"""Standard deviations from which a slope is shown."""
UNITS = {
    "rotation": ("deg", 180 / math.pi),
    "position": ("mm", 1.0),
    "focal_length": ("%", 100.0),
    "principal_point": ("px", 1.0),
    "distortion": ("", 1.0),
}


@dataclass(frozen=True)
class Taught:
    """One kind of rig, and the prior learned from its devices, or why there is none."""

    kind: KindOfRig
    learnt: LearntPrior | None
    reason: str = ""


def write_fleet_report(dataset: Dataset, taught: Sequence[Taught], before: RigPrior, path: Path) -> None:
    """Write the page.

    Args:
        dataset: results of the fleet.
        taught: what was learned, kind by kind of rig.
        before: the prior that captures were recalibrated with, beside which the learned one stands.
        path: HTML file, replaced in one step.

    Raises:
        InputError: there are no results, or the file cannot be written.
    """
    table = dataset.latest(("status", "device", "time", "rms_px", "labels", "seconds")).to_pydict()
    page = render_page(
        "report/templates/fleet.html.j2",
        read_asset("report/templates/report.css"),
        sources={"style-src": "'unsafe-inline'"},
        sentence=_sentence(table, taught),
        status=Counter(table["status"]).most_common(),
        total=len(table["status"]),
        refusals=[row for row in reasons_of(dataset) if row[0] != "ok"],
        kinds=[_kind(one, before) for one in taught],
        quality=[
            _histogram("RMS after recalibration (px)", _finite(table["rms_px"])),
            _histogram("labels a capture", _finite(table["labels"])),
            _histogram("seconds a capture", _finite(table["seconds"])),
        ],
        days=_days(table),
    )
    write_text(path, page.text)


def _sentence(table: Mapping[str, Sequence[Any]], taught: Sequence[Taught]) -> str:
    total, ok = len(table["status"]), table["status"].count("ok")
    devices = sum(len(one.kind.devices) for one in taught)
    found = f"{ok} of {total} captures recalibrated, of {plural(devices, 'device')}"
    learnt = [one.learnt for one in taught if one.learnt]
    if not learnt:
        return f"{found}; no drift was learned, so no camera was tested against it."
    outliers = sum(len(one.outliers) for one in learnt)
    out = "no camera is" if not outliers else f"{plural(outliers, 'camera')} {'is' if outliers == 1 else 'are'}"
    return f"{found}; {out} farther off than the fleet's drift explains."


def _kind(one: Taught, before: RigPrior) -> dict[str, Any]:
    learnt = one.learnt
    shown: dict[str, Any] = {"cameras": one.kind.cameras, "devices": len(one.kind.devices), "reason": one.reason}
    if learnt is None:
        return shown | {"spreads": [], "outliers": [], "trends": [], "charts": []}
    parameters = one.kind.drift.parameters
    kind_of = np.array([kind for kind, part in PARAMETER_KINDS.items() for _ in range(*part.indices(parameters))])
    offsets = learnt.standardized.reshape(len(one.kind.devices), -1, parameters)
    return shown | {
        "hours": learnt.hours,
        "spreads": [
            {
                "kind": spread.kind.replace("_", " "), "camera": spread.camera or "all", "unit": unit,
                "before": f"{factor * getattr(before, spread.kind):.4g}",
                "learnt": _show_deviation(factor * spread.value, factor * spread.sigma),
                "rate": _show_deviation(factor * spread.rate, factor * spread.rate_sigma),
                "aged": f"{factor * spread.variance(learnt.hours or 0.0) ** 0.5:.4g}",
            }
            for spread in learnt.spreads
            for unit, factor in [UNITS[spread.kind]]
        ],
        "outliers": [
            (one.kind.devices[o.device], o.camera, o.kind.replace("_", " "), f"{o.sigmas:.1f}")
            for o in sorted(learnt.outliers, key=lambda o: -o.sigmas)[:WORST]
        ],
        "trends": [
            (
                t.covariate, t.camera, one.kind.parameter_name(t),
                f"{factor * t.slope:.3g} ± {factor * t.sigma:.1g} {unit}",
            )
            for t in learnt.trends
            for unit, factor in [UNITS[kind_of[t.parameter]]]
            if t.sigma > 0 and abs(t.slope) > SURE * t.sigma
        ],
        "charts": [
            _histogram(f"{kind.replace('_', ' ')}, in spreads", offsets[..., part].numpy().ravel(), normal=True)
            for kind in UNITS
            for part in [kind == kind_of]
        ],
    }  # fmt: skip


def _show_deviation(value: float, sigma: float) -> str:
    return f"{value:.4g} ± {sigma:.1g}" if math.isfinite(sigma) else "not seen"


def _finite(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([value for value in values if value is not None], dtype=np.float64)


def _histogram(title: str, values: NDArray[np.float64], normal: bool = False) -> Markup:
    """Draw the distribution of values, beside the unit normal where they should follow it."""
    values = values[np.isfinite(values)]
    if not len(values):
        return Markup("<p>Nothing to show.</p>")
    low, high = (-6.0, 6.0) if normal else (float(values.min()), float(np.quantile(values, 0.995)))
    high = high if high > low else low + 1.0
    counts, edges = np.histogram(values.clip(low, high), 40, (low, high))
    share = counts / counts.sum()
    curve_x = np.linspace(-6, 6, 121)
    curve = np.exp(-0.5 * curve_x**2) / math.sqrt(2 * math.pi) * (edges[1] - edges[0])
    top = 1.1 * max(float(share.max()), float(curve.max()) if normal else 0.0)
    axes = Axes(48, 350, 8, 190, (low, high), (0, top))
    x, y = axes.x(edges), axes.y(share)
    bars = [
        svg.box(float(a) + 0.4, float(b), float(c - a) - 0.8, axes.bottom - float(b), "bar after")
        for a, c, b in zip(x[:-1], x[1:], y, strict=True)
    ]
    line = svg.polyline(axes.x(curve_x), axes.y(curve), "curve") if normal else ""
    return svg.drawing(360, 232, f"Histogram: {title}", svg.grid(axes, title, "share"), *bars, line)


def _days(table: Mapping[str, Sequence[Any]]) -> Markup | None:
    """Draw the share of captures that were recalibrated, day by day."""
    days: dict[int, list[bool]] = {}
    for moment, status in zip(table["time"], table["status"], strict=True):
        if moment is not None:
            days.setdefault(moment.toordinal(), []).append(status == "ok")
    if len(days) < 2:
        return None
    x = np.array(sorted(days), dtype=np.float64)
    share = np.array([100 * np.mean(days[int(day)]) for day in x])
    axes = Axes(48, 700, 8, 160, (0.0, float(x[-1] - x[0])), (0, 105))
    line = svg.polyline(axes.x(x - x[0]), axes.y(share), "curve") + svg.dots(
        axes.x(x - x[0]), axes.y(share), "mark after"
    )
    return svg.drawing(
        720, 202, "Share recalibrated by day", svg.grid(axes, "days since the first", "recalibrated (%)"), line
    )
