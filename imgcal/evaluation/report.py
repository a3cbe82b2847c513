"""Evaluations as JSON, as tables in Markdown and on the terminal, and as plots."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.table import Table as RichTable

from imgcal.evaluation.protocol import REFERENCE, Conditions, Evaluation, Row, Scores
from imgcal.evaluation.sweeps import AXES, Sweep
from imgcal.evaluation.timing import Latency
from imgcal.io import write_text
from imgcal.synthesis import RelativeDrift

FORMAT = "imgcal-evaluation/1"
RESULT, TABLES = "evaluation.json", "evaluation.md"
PLOTS = (*(f"error-{axis}.png" for axis in AXES), "training.png", "latency.png")
MISSING = "–"
HUGE = 1e4  # pixels and so on, above which a table does not say how much


@dataclass(frozen=True)
class Facts:
    """What is known about a network beside its errors."""

    parameters: int
    size: int  # bytes of the file
    history: tuple[dict[str, Any], ...] = ()  # rows of metrics.jsonl


@dataclass(frozen=True)
class Report:
    """Everything that is written."""

    evaluation: Evaluation
    latencies: Mapping[str, Latency] = field(default_factory=dict)  # by method
    facts: Mapping[str, Facts] = field(default_factory=dict)  # by method, of networks
    sweeps: tuple[Sweep, ...] = ()


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


def write(report: Report, folder: Path) -> list[Path]:
    """Write the JSON file, the tables and those plots for which there are data.

    Args:
        report: what to write.
        folder: an existing folder.

    Returns:
        The files, JSON first.
    """
    from imgcal.evaluation.plots import write_plots  # brings matplotlib along

    write_text(folder / RESULT, json.dumps(as_values(report), indent=2, allow_nan=False) + "\n")
    write_text(folder / TABLES, markdown(report))
    return [folder / RESULT, folder / TABLES, *write_plots(report, folder)]


def markdown(report: Report) -> str:
    """All tables, with a line on what was measured."""
    return f"{describe(report.evaluation)}\n\n" + "\n".join(table.markdown() for table in tables(report))


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


def tables(report: Report) -> tuple[Table, ...]:
    """Reprojection errors; parameters against the physical bound; what networks cost."""
    found = [_errors_table(report.evaluation), _parameters_table(report.evaluation)]
    if report.latencies:
        found.append(_cost_table(report))
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


def _cost_table(report: Report) -> Table:
    header = ("method", "p50 (ms)", "p99 (ms)", "refined p50 (ms)", "refined p99 (ms)", "parameters", "file (MB)")
    rows = []
    for name, took in report.latencies.items():
        known = report.facts.get(name)
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


def as_values(report: Report) -> dict[str, Any]:
    """The report in plain values, for scripts: keys stay; null where there is nothing or no finite number."""
    evaluation, protocol = report.evaluation, report.evaluation.protocol
    values = {
        "format": FORMAT,
        **_conditions(evaluation.conditions),
        "count": protocol.count,
        "trials": protocol.trials,
        "seed": protocol.seed,
        "machine": {
            "processor": platform.machine(),
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        },
        "reference": {"name": REFERENCE} | _scores(evaluation.reference),
        "methods": {
            name: {
                "alone": _scores(row.alone),
                "refined": None if row.refined is None else _scores(row.refined),
                "latency_ms": asdict(report.latencies[name]) if name in report.latencies else None,
                "model": _facts(report.facts.get(name)),
            }
            for name, row in evaluation.rows.items()
        },
        "sweeps": {sweep.axis: _sweep(sweep) for sweep in report.sweeps},
    }
    return _finite(values)


def _conditions(conditions: Conditions) -> dict[str, Any]:
    drift, poses = conditions.drift, conditions.pose_range
    return {
        "rig": conditions.rig.name,
        "object": conditions.obj.name,
        "poses_deg": {name.removesuffix("_deg"): list(limits) for name, limits in vars(poses).items()},
        "drift": {"kind": "relative" if isinstance(drift, RelativeDrift) else "physical"} | vars(drift),
        "corruption": dict(vars(conditions.corruption)),
        "sigma_px": conditions.sigma,
    }


def _scores(scores: Scores) -> dict[str, Any]:
    return {
        "re_px": dict(scores.statistics()),
        "parameters": scores.parameters(),
        "cramer_rao_ratio": scores.cramer_rao_ratios(),
    }


def _facts(facts: Facts | None) -> dict[str, int] | None:
    return None if facts is None else {"parameters": facts.parameters, "bytes": facts.size}


def _sweep(sweep: Sweep) -> dict[str, Any]:
    def column(scores: Sequence[Scores | None]) -> list[dict[str, Any] | None]:
        return [None if one is None else dict(one.statistics()) for one in scores]

    names = list(sweep.evaluations[0].rows)
    return {
        "values": list(sweep.values),
        "reference": column([evaluation.reference for evaluation in sweep.evaluations]),
        "methods": {
            name: {
                "alone": column([evaluation.rows[name].alone for evaluation in sweep.evaluations]),
                "refined": column([evaluation.rows[name].refined for evaluation in sweep.evaluations]),
            }
            for name in names
        },
    }


def _finite(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: _finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [_finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values
