"""Plans machines for a fleet from what was measured: docs/fleet_plan.md, by `scripts.benchmarks.fleet_speed`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from scripts.output import ROOT, markdown, read_json

PAGE = ROOT / "docs" / "fleet_plan.md"
STREAM = ROOT / "docs" / "benchmarks" / "rig_over_time.json"
CAPTURES, DAY = 1_000_000, 86_400
RIGS, RATE = 10_000, 60
CORES = 16
"""Of a machine."""
USE = 0.7
"""Share of its cores that is planned with."""
GIGABIT = 125e6  # bytes a second


def engine_share(result: Mapping[str, Any]) -> dict[str, Any]:
    """What was measured of each kind of capture, with what the engine adds in percent: of the work, of a plain loop.

    Workers' CPU time beyond that of the captures, the driver's (measured by itself, over thousands of rows: it is less
    than what Ray takes of every second anyway), and the scheduler's.
    """
    found = {}
    for kind, row in result["overhead"].items():
        spent = row["workers"] + result["driver"][kind] + row["engine"]
        percent = {"percent": 100 * (spent / row["work"] - 1), "percent_plain": 100 * (spent / row["plain"] - 1)}
        found[kind] = row | {"driver": result["driver"][kind]} | percent
    return found


def plan_tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Markdown by the name of its markers."""
    result = {**result, "overhead": engine_share(result)}
    return {
        "plan captures": _captures(result),
        "plan stream": _stream(result),
        "plan limits": _limits(result),
        "plan growth": _growth(result),
    }


def needed(row: Mapping[str, float]) -> tuple[float, float]:
    """Cores that a million captures a day keep busy, and CPU hours a million takes, the engine's share in it."""
    seconds = row["work"] * (1 + max(row["percent"], 0.0) / 100)
    return CAPTURES / DAY * seconds / USE, CAPTURES * seconds / 3600


def _captures(result: Mapping[str, Any]) -> str:
    rows = []
    for kind, row in result["overhead"].items():
        cores, hours = needed(row)
        moved = result["bytes"][kind]
        rows.append([
            kind, f"{1e3 * row['work']:.3g}", f"{cores:.2g}", f"{math.ceil(cores / CORES)}", f"{hours:,.0f}",
            f"{CAPTURES / DAY * moved['read'] / 1e6:.2g}", f"{CAPTURES * moved['stored'] / 1e9:.2g}",
        ])  # fmt: skip
    head = ["capture", "CPU ms", "cores", f"machines of {CORES}", "CPU hours a day", "read, MB/s", "kept, GB a day"]
    return markdown(head, rows)


def _stream(result: Mapping[str, Any]) -> str:
    times = read_json(STREAM)["times"]["RigKeeper"]
    snapshots = RIGS * RATE
    blobs = result["bytes"]["blobs, T4, 3 snapshots"]["read"] / 3
    per_rig, central = RATE * times["p50"] / 1e3, snapshots * times["p50"] / 1e3 / USE
    rows = [
        ["each rig beside itself (`imgcal watch`)", f"{100 * per_rig:.0f} % of a core a rig", "none"],
        [
            "all of them in one place",
            f"{central:,.0f} cores, {math.ceil(central / CORES):,} machines of {CORES}",
            f"{snapshots * blobs / 1e9:.2g} GB/s, {math.ceil(snapshots * blobs / GIGABIT / 10):,} links of 10 Gbit/s",
        ],
        [
            f"beside itself, and {CAPTURES // RIGS} captures a rig and day to the fleet",
            f"{100 * per_rig:.0f} % of a core a rig, and the machines of the table above",
            f"{CAPTURES / DAY * 3 * blobs / 1e6:.2g} MB/s (3 snapshots each)",
        ],
    ]
    return markdown([f"{RIGS:,} rigs x {RATE} Hz, {snapshots:,} snapshots a second", "processors", "network"], rows)


def _limits(result: Mapping[str, Any]) -> str:
    rows = []
    for kind, row in result["overhead"].items():
        most = 1 / max(row["driver"], 1e-5)
        link = GIGABIT / result["bytes"][kind]["read"]
        rows.append([
            kind, f"{1e3 * row['driver']:.2g}", f"{most:,.0f}", f"{most * DAY / 1e6:,.0f} M",
            f"{most * row['work']:,.0f}", f"{link:,.0f}",
        ])  # fmt: skip
    head = [
        "capture", "driver, CPU ms", "captures a second of one driver", "a day", "cores that it keeps busy",
        "captures a second through 1 Gbit/s",
    ]  # fmt: skip
    return markdown(head, rows)


def _growth(result: Mapping[str, Any]) -> str:
    rows = []
    if "memory" in result:
        memory = result["memory"]
        curve = [mb for _, mb in memory["curve_mb"]]
        told = f"{curve[0]:.0f} MB at first, {curve[-1]:.0f} MB after {memory['rows']:,} rows"
        rows += [["driver's memory", told]]
    rows += [["keys of what is done", "8 MB a million captures, on every machine"]]
    if "death" in result:
        rows += [["a machine that dies", f"{result['death']['lost_node_seconds']:.1f} node seconds"]]
    rows += [["files of results", f"{DAY // 30:,} a day at most (one in 30 s), or one in 4,096 rows"]]
    return markdown(["what", "how much"], rows)
