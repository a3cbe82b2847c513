"""Recalibrate O10 from snapshots of a known object with imgcal, pycolmap, pyceres, mrcal, OpenCV and SciPy."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from imgcal.estimation import initial_pose
from scripts.benchmarks import recalibration_batches
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import debian_mrcal, versions
from scripts.benchmarks.recalibration_cases import DRIFT, KINDS, NOISE, Cases, bound, make_cases, score
from scripts.benchmarks.recalibration_methods import COLD, EVERY, FREE, IMGCAL, WITH_PRIOR, Method, methods
from scripts.output import BLUE, GREEN, GREY, RED, figure, markdown
from scripts.timing import side_by_side, timing_of

FITS = 0.1  # px, twice the noise: a rig with a larger error on its own observations has not converged
BASIN_SNAPSHOTS = (1, 5)
UNITS = {"focal_length": "f, px", "principal_point": "c, px", "rotation": "rotation, deg", "position": "position, mm"}
COLOURS = {"imgcal": BLUE, "pyceres": RED, "scipy": GREY, "pycolmap": "#d98b1f", "mrcal": GREEN, "OpenCV": "#7b4fa3"}


def measure(effort: Effort) -> dict[str, Any]:
    """Run all parts with one thread."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    sizes = effort.pick({1: (100, 12.0), 5: (60, 15.0), 20: (40, 20.0), 100: (20, 40.0)}, {1: (2, 0.1), 5: (1, 0.1)})
    snapshots = {
        str(size): _compare(make_cases(count, size, seed=size), EVERY if size == 1 else FREE, seconds)
        for size, (count, seconds) in sizes.items()
    }
    scales = effort.pick((1, 2, 4, 6, 8), (2,))
    names = tuple(name for name in FREE if name != COLD)
    basin = {str(size): _basin(size, scales, names, effort.pick(40, 1)) for size in BASIN_SNAPSHOTS}
    return {
        "peers": versions("pycolmap", "pyceres", "scipy") | {"mrcal": debian_mrcal() or "absent"},
        "noise_px": NOISE,
        "drift": asdict(DRIFT),
        "snapshots": snapshots,
        "basin": {"scales": list(scales), "converged": basin},
        "alone": recalibration_batches.measure(effort),
    }


def _compare(cases: Cases, names: Sequence[str], seconds: float) -> dict[str, Any]:
    """Time the methods in turn, and score the results of as many cases as each solves within a third of the time."""
    spans: dict[str, list[float]] = {}
    solved = {}
    with methods(cases, names) as found:
        runs: dict[str, Callable[[], object]]
        runs = {name: _in_turn(method, len(cases), spans.setdefault(name, [])) for name, method in found.items()}
        runs["start"] = lambda: initial_pose(cases.one(0), cases.factory[0], cases.obj)
        times = side_by_side(runs, seconds)
        for name, method in found.items():
            solved[name] = _solve_all(method, len(cases), seconds / 3)
    limit = bound(cases)
    rows: dict[str, Any] = dict.fromkeys(names)
    for name, method in found.items():
        rows[name] = _judged(method, cases, solved[name], limit)
        rows[name] |= timing_of(spans[name][-times[name].calls :]).values()  # without the warm-up calls
    return {"cases": len(cases), "start": times["start"].values(), "bound": _root_mean(limit), "methods": rows}


def _in_turn(method: Method, count: int, spans: list[float]) -> Callable[[], None]:
    """Solve one case after another; only the solvers are timed."""
    return lambda: spans.append(method.solve(len(spans) % count))


def _solve_all(method: Method, count: int, seconds: float) -> int:
    """Solve case after case until the time is up; return their number."""
    begin = time.perf_counter()
    for index in range(count):
        method.solve(index)
        if time.perf_counter() - begin > seconds:
            return index + 1
    return count


def _judged(method: Method, cases: Cases, count: int, limit: Mapping[str, np.ndarray]) -> dict[str, Any]:
    judged = score(method.answers()[:count], cases)
    good = judged.fit < FITS
    errors = {kind: square[good] for kind, square in judged.squares.items()}
    limits = {kind: square[:count][good] for kind, square in limit.items()}
    result: dict[str, Any] = {"solved": count, "failures": int((~good).sum())}
    if not good.any():
        return result
    error, least = _root_mean(errors), _root_mean(limits)
    ratios = {kind: error[kind] / least[kind] for kind in KINDS}
    return result | {"error": error, "over_bound": ratios, "held_out_px": float(np.median(judged.held_out[good]))}


def _root_mean(squares: Mapping[str, np.ndarray]) -> dict[str, float]:
    return {kind: float(np.sqrt(square.mean())) for kind, square in squares.items()}


def _basin(snapshots: int, scales: Sequence[int], names: Sequence[str], count: int) -> dict[str, list[float] | None]:
    """Share of cases in which a method finds a rig that fits its observations, by size of the factory errors."""
    shares: dict[str, list[float]] = {name: [] for name in names}
    for scale in scales:
        cases = make_cases(count, snapshots, seed=1000 + scale, scale=scale)
        with methods(cases, names) as found:
            for method in found.values():
                _solve_all(method, count, math.inf)
        for name, method in found.items():
            shares[name].append(float((score(method.answers(), cases, fresh=1).fit < FITS).mean()))
    return {name: share or None for name, share in shares.items()}


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables of the page."""
    sizes: Mapping[str, Any] = result["snapshots"]
    one, *more = sizes
    head = ["method", "ms p50", "p99", *UNITS.values(), "held out, px", "times the bound", "failures", "cases"]
    several = [[size, *row] for size in more for row in _rows(sizes[size])]
    scales = [f"{scale} x" for scale in result["basin"]["scales"]]
    return {
        "recalibration one": markdown(head, _rows(sizes[one])),
        "recalibration snapshots": markdown(["snapshots", *head], several),
        "recalibration basin": markdown(["method", *scales], _basin_rows(result["basin"]["converged"])),
        "recalibration alone": markdown(["", "ms p50", "p99", "rigs/s"], _alone_rows(result["alone"]["times"])),
    }


def _rows(size: Mapping[str, Any]) -> list[list[str]]:
    found = {name: row for name, row in size["methods"].items() if row}
    fastest = min(found, key=lambda name: found[name]["p50"])
    rows = []
    for name, row in size["methods"].items():
        if not row:
            rows.append([name, "absent"])
            continue
        p50 = f"{row['p50']:.3g}"
        cells = [name, f"**{p50}**" if name == fastest else p50, f"{row['p99']:.3g}"]
        if "error" in row:
            cells += [f"{row['error'][kind]:.3g}" for kind in KINDS]
            cells += [f"{row['held_out_px']:.2g}", f"{_middle(row['over_bound']):.2f}"]
        else:
            cells += [""] * (len(KINDS) + 2)
        rows.append([*cells, str(row["failures"]), str(row["solved"])])
    start, limit = size["start"], size["bound"]
    rows.append(["the start pose that all but OpenCV get", f"{start['p50']:.3g}", f"{start['p99']:.3g}"])
    rows.append(["Cramér-Rao bound", "", "", *(f"{limit[kind]:.3g}" for kind in KINDS), "", "1"])
    return rows


def _middle(ratios: Mapping[str, float]) -> float:
    """Geometric mean over the kinds of values."""
    return math.exp(sum(math.log(ratio) for ratio in ratios.values()) / len(ratios))


def _basin_rows(converged: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for name in next(iter(converged.values())):
        shares = [found[name] for found in converged.values()]
        if None in shares:
            rows.append([name, "absent"])
        else:
            pairs = zip(*shares, strict=True)
            rows.append([name, *(" / ".join(f"{100 * share:.0f}" for share in pair) + " %" for pair in pairs)])
    return rows


def _alone_rows(times: Mapping[str, Any]) -> list[list[str]]:
    return [
        [
            name,
            f"{row['p50']:.3g}",
            f"{row['p99']:.3g}",
            f"{1e3 * row['rigs'] / row['p50']:,.0f}" if row["rigs"] > 1 else "",
        ]
        for name, row in times.items()
    ]


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw time over snapshots, and convergence over the size of the factory errors."""
    with figure(path, panels=2) as (speed, basin):
        sizes = {int(size): found["methods"] for size, found in result["snapshots"].items()}
        for name in FREE:
            points = [(size, found[name]["p50"]) for size, found in sizes.items() if found.get(name)]
            if points and name != COLD:
                speed.loglog(*zip(*points, strict=True), **_look(name))
        speed.set(xlabel="snapshots", ylabel="ms, p50")
        speed.legend(fontsize=6, frameon=False)
        for name, share in result["basin"]["converged"][str(BASIN_SNAPSHOTS[0])].items():
            if share:
                basin.plot(result["basin"]["scales"], [100 * part for part in share], **_look(name))
        basin.set(xlabel="factory errors, times the drift", ylabel="converged from one snapshot, %", ylim=(0, 103))


def _look(name: str) -> dict[str, Any]:
    colour = next((colour for key, colour in COLOURS.items() if name.startswith(key)), GREY)
    style = {
        "linewidth": 2.2 if name == IMGCAL else 1.2,
        "marker": "o",
        "markersize": 3,
        "color": colour,
        "label": name,
    }
    return style | {"linestyle": "-" if name in WITH_PRIOR else "--"}
