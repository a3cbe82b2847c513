"""What an evaluation found: plain values for scripts, tables in Markdown and on the terminal, and all its files."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import torch
from rich.table import Table as RichTable

from imgcal.evaluation.encoder_check import LEAST_RISE, EncoderCheck
from imgcal.evaluation.protocol import REFERENCE, Conditions, Evaluation, Row, Scores, Statistics
from imgcal.evaluation.sweeps import AXES, Sweep
from imgcal.evaluation.timing import Latency
from imgcal.io import write_text
from imgcal.messages import plural
from imgcal.synthesis import RelativeDrift

FORMAT = "imgcal-evaluation/1"
RESULT, TABLES = "evaluation.json", "evaluation.md"
PLOTS = (*(f"error-{axis}.png" for axis in AXES), "training.png", "latency.png")
MISSING = "–"
HUGE = 1e4  # pixels and so on, above which a table does not say how much


@dataclass(frozen=True)
class Facts:
    """Facts about a network other than its errors."""

    parameters: int
    size: int  # bytes of the file
    history: tuple[dict[str, Any], ...] = ()  # rows of metrics.jsonl
    experiment: str | None = None  # what it was trained by; the same with another seed is another run of it
    seed: int = 0  # of its training
    encoder: EncoderCheck | None = None  # None = it has none, or was not asked


@dataclass(frozen=True)
class Summary:
    """Everything that is written."""

    evaluation: Evaluation
    latencies: Mapping[str, Latency] = field(default_factory=dict)  # by method
    facts: Mapping[str, Facts] = field(default_factory=dict)  # by method, of networks
    sweeps: tuple[Sweep, ...] = ()

    def groups(self) -> dict[str, tuple[str, ...]]:
        """Methods by the name of their line in tables: runs of one experiment that differ in the seed share a line."""
        runs: dict[str, dict[int, str]] = {}
        for name, facts in self.facts.items():
            if facts.experiment is not None:
                runs.setdefault(facts.experiment, {}).setdefault(facts.seed, name)
        shared = {name: experiment for experiment, by in runs.items() if len(by) > 1 for name in by.values()}
        found: dict[str, tuple[str, ...]] = {}
        for name in self.evaluation.rows:
            line = shared.get(name, name)
            found[line] = (*found.get(line, ()), name)
        return found


def as_values(summary: Summary) -> dict[str, Any]:
    """The summary in plain values, for scripts: keys stay; null where there is nothing or no finite number."""
    evaluation, protocol = summary.evaluation, summary.evaluation.protocol
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
                "passes": row.passes,
                "one_pass": None if row.one_pass is None else _scores(row.one_pass),
                "alone": _scores(row.alone),
                "refined": None if row.refined is None else _scores(row.refined),
                "latency_ms": asdict(summary.latencies[name]) if name in summary.latencies else None,
                "model": _facts(summary.facts.get(name)),
            }
            for name, row in evaluation.rows.items()
        },
        "seeds": {line: list(names) for line, names in summary.groups().items() if len(names) > 1},
        "sweeps": {sweep.axis: _sweep(sweep) for sweep in summary.sweeps},
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
        "images": {name: value for name, value in vars(conditions.degradation).items() if name != "points"},
        "sigma_px": conditions.sigma,
    }


def _scores(scores: Scores) -> dict[str, Any]:
    return {
        "re_px": dict(scores.statistics()),
        "held_out_px": dict(scores.statistics("held_out")),
        "parameters": scores.parameters(),
        "cramer_rao_ratio": scores.cramer_rao_ratios(),
    }


def _facts(facts: Facts | None) -> dict[str, Any] | None:
    if facts is None:
        return None
    check = facts.encoder
    return {
        "parameters": facts.parameters,
        "bytes": facts.size,
        "experiment": facts.experiment,
        "seed": facts.seed,
        "encoder": None if check is None else asdict(check) | {"rise": check.rise, "used": check.used},
    }


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
    images = {name: value for name, value in vars(known.degradation).items() if name != "points" and value}
    if images:
        wrong += "; images: " + ", ".join(f"{name} {value:g}" for name, value in images.items())
    return (
        f"Rig {known.rig.name}, object {known.obj.name}, phi {phi} deg, {drift}; {wrong or 'exact points'}; "
        f"{protocol.count} rigs a trial, {plural(protocol.trials, 'trial')}, seed {protocol.seed}."
    )


def as_tables(summary: Summary) -> tuple[Table, ...]:
    """Reprojection errors; parameters against the physical bound; whether encoders are used; what methods cost."""
    found = [_errors_table(summary), _parameters_table(summary)]
    if any(facts.encoder is not None for facts in summary.facts.values()):
        found.append(_encoder_table(summary.facts))
    if summary.latencies:
        found.append(_cost_table(summary))
    return tuple(found)


def _errors_table(summary: Summary) -> Table:
    header = ("method", "seeds", "RE mean", "median", "p99", "< 1 px", "< 0.5 px", "held-out median", "rigs")
    rows = [(line.label, line.seeds, *_errors(line.scores)) for line in _lines(summary)]
    return Table("Reprojection error RE (px)", header, tuple(rows))


def _errors(seeds: Sequence[Scores]) -> tuple[str, ...]:
    """Cells of one line: means over training seeds, the spread of the mean RE over them, or over trials of one."""
    found = [scores.statistics() for scores in seeds]
    held_out = [scores.statistics("held_out")["median"] for scores in seeds]
    means = [one["mean"] for one in found if not math.isnan(one["mean"])]
    spread = stdev(means) if len(means) > 1 else found[0]["spread"]
    return (
        number(_mean(means)) + ("" if spread is None else f" ± {number(spread)}") + _rig_share(found),
        number(_mean([one["median"] for one in found])),
        number(_mean([one["p99"] for one in found])),
        f"{100 * fmean(one['share_under_one_px'] for one in found):.1f} %",
        f"{100 * fmean(one['share_under_half_px'] for one in found):.1f} %",
        number(_mean(held_out)),
        f"{found[0]['rigs']}",
    )


def _rig_share(found: Sequence[Statistics]) -> str:
    """Say of how many rigs the mean is, where the refinement of others has failed."""
    share = fmean(one["found"] for one in found)
    return "" if share == 1 else f" ({100 * share:.1f} % of rigs)"


@dataclass(frozen=True)
class _Line:
    """One stage of one method, or of all training seeds of an experiment."""

    label: str
    seeds: str
    scores: tuple[Scores, ...]  # of each seed


def _lines(summary: Summary) -> list[_Line]:
    """Stages in the order in which they come: one pass (what the paper reports), all passes, refined."""
    found = []
    for name, members in summary.groups().items():
        rows = [summary.evaluation.rows[member] for member in members]
        trained = members[0] in summary.facts
        seeds = f"{len(members)} seeds" if len(members) > 1 else "one seed" if trained else MISSING
        for stage in ("one_pass", "alone", "refined"):
            scores = tuple(one for row in rows if (one := getattr(row, stage)) is not None)
            if scores:
                found.append(_Line(name + _suffix(stage, rows[0]), seeds, scores))
    return [*found, _Line(REFERENCE, MISSING, (summary.evaluation.reference,))]


def _suffix(stage: str, row: Row) -> str:
    if stage == "alone":
        return "" if row.passes == 1 else f", {row.passes} passes"
    return ", one pass" if stage == "one_pass" else ", refined"


def _encoder_table(facts: Mapping[str, Facts]) -> Table:
    header = ("network", "RE median", "shuffled", "zeroed", "noise", "rises by", "encoder is")
    rows = []
    for name, known in facts.items():
        if (check := known.encoder) is not None:
            errors = (check.untouched, check.shuffled, check.zeroed, check.noise)
            verdict = "used" if check.used else "NOT USED"
            rows.append((name, *map(number, errors), f"{number(check.rise)} x", verdict))
    return Table(f"Encoder's output spoilt: used if RE (px, alone) rises {LEAST_RISE:g} x", header, tuple(rows))


def _parameters_table(summary: Summary) -> Table:
    kinds = {
        "focal_length": "f (px)",
        "focal_length_percent": "f (%)",
        "principal_point": "pp (px)",
        "rotation_deg": "rotation (deg)",
        "position": "position (mm)",
    }
    bounded = bool(summary.evaluation.reference.bounds)
    ratios = {
        "re": "RE",
        "held_out": "held-out",
        "focal_length": "f",
        "principal_point": "pp",
        "rotation_deg": "rot.",
        "position": "pos.",
    }
    ratios = ratios if bounded else {}
    header = ("method", *kinds.values(), *(f"{name} / bound" for name in ratios.values()))
    rows = []
    for line in _lines(summary):
        errors = [scores.parameters() for scores in line.scores]
        bounds = [scores.cramer_rao_ratios() for scores in line.scores]
        cells = [number(_mean([one[kind] for one in errors])) for kind in kinds]
        rows.append((line.label, *cells, *(number(_mean([one[kind] for one in bounds])) for kind in ratios)))
    title = "Parameters, RMS error" + (", and ratio to the Cramer-Rao bound" if bounded else "")
    return Table(title, header, tuple(rows))


def _cost_table(summary: Summary) -> Table:
    header = ("method", "p50 (ms)", "p99 (ms)", "refined p50 (ms)", "refined p99 (ms)", "parameters", "file (MB)")
    rows = []
    for name, took in summary.latencies.items():
        known = summary.facts.get(name)
        size = (MISSING, MISSING) if known is None else (f"{known.parameters:,}", f"{known.size / 1e6:.1f}")
        times = (took.alone_p50, took.alone_p99, took.refined_p50, took.refined_p99)
        rows.append((name, *map(number, times), *size))
    return Table("One rig at a time, and size", header, tuple(rows))


def _mean(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None and not math.isnan(value)]
    return fmean(there) if there else None


def number(value: float | None) -> str:
    """A number as tables show it."""
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
