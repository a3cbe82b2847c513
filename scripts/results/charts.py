"""Plots of evaluated networks for docs/results/tables.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scripts.output import BLUE, GREEN, RED, figure
from scripts.results.measuring import NETWORK, ONE_PASS, WITHOUT

LEAST_RE = 1e-4  # pixels: with exact points, refinement reaches rounding errors, which are meaningless


def over_time(results: Mapping[str, dict[str, Any]], path: Path) -> None:
    """Draw RE over training time, one line per run."""
    runs = {name: result["history"] for name, result in sorted(results.items()) if len(result["history"]) > 1}
    if not runs:
        return
    styles = ("-", "--", ":", "-.")
    with figure(path, size=(8.5, 4.2)) as [axes]:
        for number, (name, history) in enumerate(runs.items()):
            minutes, errors = zip(*history, strict=True)
            style = styles[number // 10 % len(styles)]
            axes.plot(minutes, errors, linewidth=1.2, label=name, color=f"C{number % 10}", linestyle=style)
        axes.set(xlabel="minutes of training", ylabel="RE of the training batches (px)", yscale="log")
        axes.legend(fontsize=6, ncols=math.ceil(len(runs) / 20), loc="center left", bbox_to_anchor=(1, 0.5))


def sweeps(result: dict[str, Any], path: Path) -> None:
    """Draw RE against perturbation and against the angle of view."""
    lines: dict[str, tuple[str, dict[str, Any]]] = {
        ONE_PASS: ("network, one pass", {"color": RED, "linestyle": ":"}),
        NETWORK: ("network, all passes", {"color": RED}),
        f"{NETWORK} + refinement": ("network + refinement", {"color": BLUE, "linewidth": 4.0}),
        WITHOUT: ("MAP without network", {"color": GREEN, "linestyle": "--"}),
    }
    with figure(path, panels=2, size=(8.5, 3.4)) as panels:
        for axes, axis, factor in zip(panels, ("kappa", "phi"), (100.0, 1.0), strict=True):
            values = [factor * value for value in result[axis]["values"]]
            for name, (text, style) in lines.items():
                if any(name not in row for row in result[axis]["rows"]):
                    continue  # a one-pass network
                means = [row[name]["mean"] for row in result[axis]["rows"]]
                errors = [math.nan if mean is None else max(mean, LEAST_RE) for mean in means]
                axes.plot(values, errors, marker="o", markersize=3, label=text, **style)
            axes.set(yscale="log", ylabel="RE (px)")
        panels[0].set(xlabel="kappa (%)", title=result["experiment"])
        panels[1].set(xlabel="angle from the zenith, phi (deg)")
        if result["trained_kappa"] is not None:
            panels[0].axvline(100 * result["trained_kappa"], color="#999999", linewidth=0.8, linestyle="--")
        panels[1].legend(fontsize=7)
