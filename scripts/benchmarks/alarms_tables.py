"""Count the results on alarms, and show them as tables and as a plot."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

import imgcal
from scripts.benchmarks.alarms_runs import GATE, RUNS, SWEPT
from scripts.benchmarks.followed_streams import RIGS
from scripts.output import BLUE, GREEN, GREY, RED, figure, markdown

GOAL = 1_730_000
"""Snapshots in eight hours."""


def summarized(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Count the results of each experiment."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for entry in entries:
        groups.setdefault(entry["name"], []).append(entry)
    found: dict[str, Any] = {}
    for name in RUNS:
        group = groups.get(name, [])
        if not group:
            continue
        values: dict[str, Any] = {"items": len(group), "cpu_s": round(sum(e["cpu_s"] for e in group))}
        for key in ("snapshots", "alarms", "refused", "asked_ok", "wrong_ok", "wrong_at_once", "asked"):
            if key in group[0]:
                values[key] = sum(entry[key] for entry in group)
        if "delay" in group[0]:
            values |= _bumps(group)
        if "held_out" in group[0]:
            pairs = {after: [entry["held_out"][after] for entry in group] for after in group[0]["held_out"]}
            values["held_out_ratio"] = {after: _ratio(pair) for after, pair in pairs.items()}
        if "worst_chi2" in group[0]:
            values |= {"wrong": sum(e["wrong"] for e in group), "found_degrees": [e["found_degrees"] for e in group]}
        if name.endswith("sweep"):
            values["by_size"] = {str(size): _bumps([e for e in group if e["size"] == size]) for size in SWEPT
                                 if any(e["size"] == size for e in group)}  # fmt: skip
        if name.endswith("bump"):
            values["by_rig"] = {rig: _bumps([e for e in group if e["rig"] == rig]) for rig in RIGS
                                if any(e["rig"] == rig for e in group)}  # fmt: skip
            values["by_kind"] = {kind: _bumps([e for e in group if e["kind_of_bump"] == kind]) for kind in GATE
                                 if any(e["kind_of_bump"] == kind for e in group)}  # fmt: skip
        found[name] = values
    return found


def _ratio(pairs: list[list[float]]) -> float:
    """RMS of the first values divided by that of the second."""
    squares = np.square(pairs).sum(0)
    return math.sqrt(squares[0] / squares[1])


def _bumps(group: list[dict[str, Any]]) -> dict[str, Any]:
    delays = [delay for entry in group for delay in entry["delay"]]
    within = [delay for delay in delays if delay is not None and delay < 60]
    late = [late for entry in group for late in entry["late"] if late is not None]
    return {
        "bumps": len(delays),
        "found": len([delay for delay in delays if delay is not None]),
        "within_1_s": len(within),
        "delay_median": float(np.median(within)) if within else None,
        "delay_max": max(within, default=None),
        "others_blamed": sum(bool(entry["wrong"]) for entry in group),
        "right_kind": sum(sum(entry["kind"]) for entry in group),
        "kind_not_told": sum(sum(entry["undecided"]) for entry in group),
        "time_within_3": sum(abs(value) <= 3 for value in late),
    }


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Make the tables, by the names of their markers in the page."""
    found: dict[str, Any] = result["found"]
    quiet = [name for name, group in found.items() if "snapshots" in group and "bumps" not in group]
    rows = []
    for name, group in found.items():
        parts = {name: group} | {f"{name}, {size} x": part for size, part in group.get("by_size", {}).items()}
        parts |= {f"{name}, {kind.replace('_', ' ')}": part for kind, part in group.get("by_kind", {}).items()}
        rows += [[label, *_cells(part)] for label, part in parts.items() if "bumps" in part]
    head = [
        "bumps", "number", "found within 1 s", "median delay", "other cameras blamed", "right kind", "kind undecided",
        "time within 3 snapshots",
    ]  # fmt: skip
    return {
        "alarms steady": markdown(
            ["no camera bumped", "snapshots", "false alarms"],
            [[name, f"{found[name]['snapshots']:,}", str(found[name]["alarms"])] for name in quiet],
        ),
        "alarms bumps": markdown(head, rows),
    }


def _cells(part: dict[str, Any]) -> list[str]:
    count = part["bumps"]
    shares = [f"{100 * part[key] / count:.1f} %" for key in ("right_kind", "kind_not_told", "time_within_3")]
    median = "-" if part["delay_median"] is None else f"{part['delay_median']:g}"
    return [str(count), f"{100 * part['within_1_s'] / count:.1f} %", median, str(part["others_blamed"]), *shares]


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw the delay over the size of a bump and over the number of cameras, and false alarms over snapshots."""
    found = result["found"]
    with figure(path, panels=3, size=(11.0, 3.4)) as (by_size, by_cameras, false):
        sweep = found.get("monitor sweep", {}).get("by_size", {})
        sizes = [0.1 * float(size) for size in sweep]
        shares = [100 * part["within_1_s"] / part["bumps"] for part in sweep.values()]
        delays = [math.nan if part["delay_median"] is None else part["delay_median"] + 1 for part in sweep.values()]
        by_size.loglog(sizes, delays, "o-", color=BLUE)
        by_size.set(xlabel="turn of a camera (degrees), others alike", ylabel="snapshots until the alarm (median)")
        for size, delay, share in zip(sizes, delays, shares, strict=True):
            by_size.annotate(f"{share:.0f} %", (size, delay), textcoords="offset points", xytext=(3, 5), fontsize=8)
        rigs = found.get("monitor bump", {}).get("by_rig", {})
        for rig, part in rigs.items():
            if part["delay_median"] is not None:
                cameras = imgcal.load_rig(rig).num_cameras
                by_cameras.plot([cameras, cameras], [part["delay_median"] + 1, part["delay_max"] + 1], "o-", color=RED)
        by_cameras.set(xlabel="cameras", ylabel="snapshots until the alarm (median, longest)", ylim=(0, None))
        names = [name for name in found if "snapshots" in found[name] and "bumps" not in found[name]]
        false.barh(names, [found[name]["snapshots"] for name in names], color=GREY)
        for row, name in enumerate(names):
            false.annotate(f" {found[name]['alarms']} false", (found[name]["snapshots"], row), va="center", fontsize=8)
        false.axvline(GOAL, color=GREEN, linewidth=1)
        false.set(xscale="log", xlabel="snapshots run; line: eight hours", xlim=(1e3, 1e7))
