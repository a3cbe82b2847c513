"""Evaluations as tables, in Markdown and on the terminal, and all files of one: values, tables, plots."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table as RichTable

from imgcal.evaluation.protocol import REFERENCE, Evaluation, Row, Scores
from imgcal.evaluation.summary import Summary, as_values
from imgcal.evaluation.sweeps import AXES
from imgcal.io import write_text

RESULT, TABLES = "evaluation.json", "evaluation.md"
PLOTS = (*(f"error-{axis}.png" for axis in AXES), "training.png", "latency.png")
MISSING = "–"
HUGE = 1e4  # pixels and so on, above which a table does not say how much


@dataclass(frozen=True)
class Table:
    """Text in rows."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """The table in Markdown, numbers aligned right."""
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]
        rule = [":" + "-" * (width - 1) if i == 0 else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
        lines = [_line(self.header, widths), f"| {' | '.join(rule)} |", *(_line(row, widths) for row in self.rows)]
        return f"### {self.title}\n\n" + "\n".join(lines) + "\n"

    def rich(self) -> RichTable:
        """The table for a terminal."""
        table = RichTable(title=self.title, title_justify="left")
        for number, name in enumerate(self.header):
            table.add_column(name, justify="left" if number == 0 else "right")
        for row in self.rows:
            table.add_row(*row)
        return table


def write(summary: Summary, folder: Path) -> list[Path]:
    """Write the JSON file, the tables and those plots for which there are data.

    Args:
        summary: what to write.
        folder: an existing folder.

    Returns:
        The files, JSON first.
    """
    from imgcal.evaluation.plots import write_plots  # brings matplotlib along

    write_text(folder / RESULT, json.dumps(as_values(summary), indent=2, allow_nan=False) + "\n")
    write_text(folder / TABLES, markdown(summary))
    return [folder / RESULT, folder / TABLES, *write_plots(summary, folder)]


def markdown(summary: Summary) -> str:
    """All tables, with a line on what was measured."""
    return f"{describe(summary.evaluation)}\n\n" + "\n".join(table.markdown() for table in as_tables(summary))


def describe(evaluation: Evaluation) -> str:
    """One line on what the rigs were."""
    known, protocol = evaluation.conditions, evaluation.protocol
    phi = " to ".join(f"{angle:g}" for angle in known.pose_range.phi_deg)
    drift = ", ".join(f"{name} {value:g}" for name, value in vars(known.drift).items())
    wrong = ", ".join(f"{name} {value:g}" for name, value in vars(known.corruption).items() if value)
    return (
        f"Rig {known.rig.name}, object {known.obj.name}, phi {phi} deg, {drift}; {wrong or 'exact points'}; "
        f"{protocol.count} rigs a trial, {protocol.trials} trials, seed {protocol.seed}."
    )


def as_tables(summary: Summary) -> tuple[Table, ...]:
    """Reprojection errors; parameters against the physical bound; what networks cost."""
    found = [_errors_table(summary.evaluation), _parameters_table(summary.evaluation)]
    if summary.latencies:
        found.append(_cost_table(summary))
    return tuple(found)


def _errors_table(evaluation: Evaluation) -> Table:
    numbers = ("mean", "median", "p99", "< 0.5 px")
    header = ("method", *(f"RE {n}" for n in numbers), *(f"refined {n}" for n in numbers), "rigs")
    rows = [
        (name, *_errors(row.alone), *_errors(row.refined), f"{len(row.alone.re)}") for name, row in _rows(evaluation)
    ]
    return Table("Reprojection error RE (px), alone and refined", header, tuple(rows))


def _errors(scores: Scores | None) -> tuple[str, ...]:
    if scores is None:
        return (MISSING,) * 4
    found = scores.statistics()
    spread = "" if found["spread"] is None else f" ± {_number(found['spread'])}"
    share = f"{100 * found['share_under_half_px']:.1f} %"
    return _number(found["mean"]) + spread, _number(found["median"]), _number(found["p99"]), share


def _parameters_table(evaluation: Evaluation) -> Table:
    kinds = {
        "focal_length": "f (px)",
        "focal_length_percent": "f (%)",
        "principal_point": "pp (px)",
        "rotation_deg": "rotation (deg)",
        "position": "position (mm)",
    }
    ratios = {"re": "RE", "focal_length": "f", "principal_point": "pp", "rotation_deg": "rot.", "position": "pos."}
    header = ("method", *kinds.values(), *(f"{name} / bound" for name in ratios.values()))
    rows = []
    for name, row in _rows(evaluation):
        for label, scores in ((name, row.alone), (f"{name}, refined", row.refined)):
            if scores is not None:
                errors, bound = scores.parameters(), scores.cramer_rao_ratios()
                cells = [_number(errors[kind]) for kind in kinds] + [_number(bound[kind]) for kind in ratios]
                rows.append((label, *cells))
    return Table("Parameters, RMS error, and ratio to the Cramer-Rao bound", header, tuple(rows))


def _cost_table(summary: Summary) -> Table:
    header = ("method", "p50 (ms)", "p99 (ms)", "refined p50 (ms)", "refined p99 (ms)", "parameters", "file (MB)")
    rows = []
    for name, took in summary.latencies.items():
        known = summary.facts.get(name)
        size = (MISSING, MISSING) if known is None else (f"{known.parameters:,}", f"{known.size / 1e6:.1f}")
        times = (took.alone_p50, took.alone_p99, took.refined_p50, took.refined_p99)
        rows.append((name, *map(_number, times), *size))
    return Table("One rig at a time, and size", header, tuple(rows))


def _rows(evaluation: Evaluation) -> list[tuple[str, Row]]:
    return [*evaluation.rows.items(), (REFERENCE, Row(evaluation.reference))]


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return MISSING
    if value >= HUGE:
        return f"> {HUGE:.0f}"
    if value >= 100:
        return f"{value:.0f}"
    return f"{value:.3g}" if value >= 0.001 or value == 0 else f"{value:.1e}"


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = (
        cell.ljust(width) if i == 0 else cell.rjust(width)
        for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return f"| {' | '.join((first, *others))} |"
