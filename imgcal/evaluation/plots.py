"""Plots of evaluations, without a display."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imgcal.evaluation.protocol import REFERENCE, Scores
from imgcal.evaluation.sweeps import AXES, Sweep
from imgcal.evaluation.tables import Summary
from imgcal.io import write_bytes

SIZE = (7.2, 4.4)  # inches
LEAST, MOST = 1e-4, 1e4  # pixels that are drawn: everything below, or above, lies on the edge


def write_plots(summary: Summary, folder: Path) -> list[Path]:
    """Draw what there are data for: sweeps, training, latency against accuracy; returns the PNG files."""
    figures = {f"error-{sweep.axis}.png": draw_sweep(sweep) for sweep in summary.sweeps}
    if any(facts.history for facts in summary.facts.values()):
        figures["training.png"] = draw_training(summary)
    if summary.latencies:
        figures["latency.png"] = draw_latency(summary)
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
        write_bytes(folder / name, buffer.getvalue())
    return [folder / name for name in figures]


def draw_sweep(sweep: Sweep) -> Figure:
    """Mean RE over one condition: dashed alone, solid refined, dotted MAP of the true inliers."""
    figure, axes = _figure(AXES[sweep.axis].label, "mean RE (px)")
    for number, name in enumerate(sweep.evaluations[0].rows):
        rows = [evaluation.rows[name] for evaluation in sweep.evaluations]
        refined = [row.refined for row in rows if row.refined is not None]
        axes.plot(sweep.values, _means(row.alone for row in rows), "o--", color=f"C{number}", label=name)
        if refined:
            axes.plot(sweep.values, _means(refined), "o-", color=f"C{number}", label=f"{name}, refined")
    reference = (evaluation.reference for evaluation in sweep.evaluations)
    axes.plot(sweep.values, _means(reference), ":", color="black", label=REFERENCE)
    return _add_legend(figure, axes)


def draw_training(summary: Summary) -> Figure:
    """RE over training steps: of training batches thin, of validation with points."""
    figure, axes = _figure("training step", "RE alone (px)")
    for number, (name, facts) in enumerate(summary.facts.items()):
        for key, style, label in (("re_px", "-", None), ("validation_re_px", "o-", name)):
            rows = [row for row in facts.history if row.get(key) is not None]
            values = _clip(row[key] for row in rows)
            axes.plot([row["step"] for row in rows], values, style, color=f"C{number}", ms=3, lw=0.8, label=label)
    return _add_legend(figure, axes)


def draw_latency(summary: Summary) -> Figure:
    """Mean RE over the time for one rig: hollow alone, filled refined."""
    figure, axes = _figure("time for one rig, median (ms)", "mean RE (px)")
    axes.set_xscale("log")
    for number, (name, took) in enumerate(summary.latencies.items()):
        row, colour = summary.evaluation.rows[name], f"C{number}"
        alone = _means([row.alone])
        axes.plot([took.alone_p50], alone, "o", mfc="none", color=colour, label=name)
        if row.refined is not None and took.refined_p50 is not None:
            refined = _means([row.refined])
            axes.plot([took.alone_p50, took.refined_p50], [*alone, *refined], ":", color=colour, lw=0.8)
            axes.plot([took.refined_p50], refined, "o", color=colour, label=f"{name}, refined")
    return _add_legend(figure, axes)


def _figure(across: str, up: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.set_yscale("log")
    axes.grid(True, which="major", alpha=0.3)
    return figure, axes


def _add_legend(figure: Figure, axes: Axes) -> Figure:
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _means(scores: Iterable[Scores]) -> list[float]:
    return _clip(one.statistics()["mean"] for one in scores)


def _clip(values: Iterable[float]) -> list[float]:
    return [min(max(value, LEAST), MOST) for value in values]
