"""Compare the shipped point network with Levenberg-Marquardt steps: several drifts, two ranges of views.

Uses only files of the repository. `scripts.results.table` calls it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from imgcal.evaluation import QUICK_BASELINES, REFERENCE, Conditions, Latency, Protocol, latency, load_models
from imgcal.synthesis import Drift, PhysicalDrift, PoseRange, RelativeDrift
from scripts.output import markdown, surroundings
from scripts.results.measuring import NETWORK, ONE_PASS, Source, columns, evaluated

HEMISPHERE, OVERHEAD = PoseRange(), PoseRange(theta_deg=(0.0, 0.0), phi_deg=(0.0, 0.0))


@dataclass(frozen=True)
class Place:
    """One column: the distribution of rigs, and the paper's result for its point network there."""

    name: str
    poses: PoseRange
    drift: Drift
    paper: float | None = None


PLACES = (
    Place("hemisphere 2.5 %", HEMISPHERE, RelativeDrift(0.025, 0.025), 9.93),
    Place("5 %", HEMISPHERE, RelativeDrift(0.05, 0.05), 11.53),
    Place("10 %", HEMISPHERE, RelativeDrift(0.1, 0.1), 14.21),
    Place("overhead 2.5 %", OVERHEAD, RelativeDrift(0.025, 0.025)),
    Place("5 %", OVERHEAD, RelativeDrift(0.05, 0.05)),
    Place("10 %", OVERHEAD, RelativeDrift(0.1, 0.1)),
    Place("hemisphere, physical drift", HEMISPHERE, PhysicalDrift()),
)


def measure_headline(source: Source, count: int, device: str) -> dict[str, Any]:
    """Evaluate a network and the steps for every column: three trials of `count` rigs, exact points."""
    [model] = load_models([source.path], device=device)
    methods = {NETWORK: model.method} | QUICK_BASELINES
    found = []
    for place in PLACES:
        conditions = Conditions(model.conditions.rig, model.conditions.obj, place.poses, place.drift)
        what = f"{source.path.stem}, {place.name}"
        found.append(columns(evaluated(methods, conditions, Protocol(count, 3), what), methods))
    return {
        "model": source.path.name,
        "sha256": source.sha256,
        "rigs": 3 * count,
        "surroundings": surroundings(device),
        "places": [{"name": place.name, "columns": one} for place, one in zip(PLACES, found, strict=True)],
        "latency_ms": time_headline(source, min(200, 2 * count), device),
    }


def time_headline(source: Source, repeats: int, device: str) -> dict[str, Any]:
    """Milliseconds per rig, for the network and for each number of steps."""
    [model] = load_models([source.path], device=device)
    methods = {NETWORK: model.method} | QUICK_BASELINES
    return {name: vars(latency(method, model.conditions, repeats)) for name, method in methods.items()}


def headline_tables(result: Mapping[str, Any]) -> str:
    """Make a table of RE, and one for each quantity that RE does not show."""
    places = [place["columns"] for place in result["places"]]
    names = sorted((name for name in places[0] if name != REFERENCE), key=_order)
    took = {name: Latency(**one) for name, one in result["latency_ms"].items()}
    head = ("RE mean (px)", *(place.name for place in PLACES), "ms, p50")
    paper = ["paper's network", *("" if place.paper is None else f"{place.paper:g}" for place in PLACES), ""]
    rows = [paper, *([_shown(name), *(_px(one[name]["mean"]) for one in places), _time(name, took)] for name in names)]
    texts = [f"`{result['model']}`, one seed, exact points, {result['rigs']:,} rigs per column.", markdown(head, rows)]
    for title, cell in (
        ("RE < 1 px / < 0.5 px, % of rigs", _success),
        ("RE on held-out points, median (px)", lambda one: _px(one["held_out"]["median"])),
        ("rotation, RMS error (deg)", lambda one: _px(one["parameters"]["rotation_deg"])),
        ("principal point, RMS error (px)", lambda one: _px(one["parameters"]["principal_point"])),
        ("focal length, RMS error (px)", lambda one: _px(one["parameters"]["focal_length"])),
        ("position, RMS error (mm)", lambda one: _px(one["parameters"]["position"])),
    ):
        lines = [[_shown(name), *(cell(one[name]) for one in places)] for name in names if name in TOLD]
        texts.append(markdown((title, *(place.name for place in PLACES)), lines))
    return "\n\n".join(texts)


REFINED = f"{NETWORK} + refinement"
TOLD = (
    "factory, pose fitted",
    ONE_PASS,
    NETWORK,
    "1 LM step from the factory",
    "2 LM steps from the factory",
    "MAP from PnP",
)
"""Lines of the other tables; more than two steps equal MAP to the digits shown."""


def _shown(name: str) -> str:
    return f"{name}, all passes" if name == NETWORK else name


def _order(name: str) -> int:
    lines: Sequence[str] = (ONE_PASS, NETWORK, REFINED, *QUICK_BASELINES)
    return lines.index(name) if name in lines else len(lines)


def _time(name: str, took: Mapping[str, Latency]) -> str:
    if name == REFINED:
        return f"{took[NETWORK].refined_p50:.2g}"
    return f"{took[name].alone_p50:.2g}" if name in took else ""


def _success(one: Mapping[str, Any]) -> str:
    return f"{100 * one['share_under_one_px']:.3g} / {100 * one['share_under_half_px']:.3g}"


def _px(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if 100 <= value < 1e5 else f"{value:.2g}" if value < 1 else f"{value:.3g}"
