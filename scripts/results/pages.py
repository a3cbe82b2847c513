"""Turn results into the tables of docs/results/tables.md, between its markers.

Each line is one experiment: mean and spread over its training seeds, or the words "one seed".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from imgcal.training import RigExperiment
from scripts.output import markdown
from scripts.results.measuring import FACTORY, NETWORK, ONE_PASS, ROBUST, WITHOUT, label

Runs = Sequence[Mapping[str, Any]]
"""Results of one experiment, one per training seed."""
Results = Mapping[str, Runs]

MISSING = "not trained yet"
TRAINING = ("minutes", "steps x rigs", "started from", "trained")
REFINED = f"{NETWORK} + refinement"
STEPS = ("1 LM step from the factory", "2 LM steps from the factory", "3 LM steps from the factory")
PARAMETERS = {
    "rotation_deg": "rotation (deg)",
    "principal_point": "principal point (px)",
    "focal_length": "focal length (px)",
    "position": "position (mm)",
}


def accuracy_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Table 1, our networks: the columns comparable with the paper first, then steps from the factory."""
    stages = {ONE_PASS: "one pass", NETWORK: "all passes", REFINED: "refined", FACTORY: FACTORY}
    stages |= {name: name.replace(" from the factory", "") for name in STEPS}
    head = ("row", "experiment", "paper's RE", *stages.values(), "RE < 1 px, one pass / all", "encoder", "seeds")

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        row = [str(row_of(experiment)), _what(experiment, runs), _paper(experiment)]
        row += [f"**{cell}**" if cell and name == ONE_PASS else cell for name in stages for cell in [mean(runs, name)]]
        return [*row, _shares(runs, (ONE_PASS, NETWORK), "share_under_one_px"), encoder(runs), seeds(runs)]

    return _of_trained(head, experiments, results, cells)


def parameters_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Table 1, quantities that RE does not show: factory / one pass / all passes / MAP."""
    stages = (FACTORY, ONE_PASS, NETWORK, WITHOUT)
    head = ("row", "experiment", *PARAMETERS.values(), "RE on held-out points, median (px)")

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        row = [str(row_of(experiment)), _what(experiment, runs)]
        for kind in PARAMETERS:
            row.append(" / ".join(_px(_mean(runs, name, "parameters", kind)) or "?" for name in stages))
        return [*row, " / ".join(_px(_mean(runs, name, "held_out", "median")) or "?" for name in stages)]

    return _of_trained(head, experiments, results, cells)


def background_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Table 1, last part: noise, and the length of each training."""
    head = ("row", "experiment", "0.1 px noise: alone", "refined", "refined / Cramér-Rao bound", "rigs", *TRAINING)

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        row = [str(row_of(experiment)), _what(experiment, runs)]
        row += [_px(_mean(runs, name, "mean", part="noise")) for name in (NETWORK, REFINED)]
        bound = _mean(runs, REFINED, "times_cramer_rao", "re", part="noise")
        return [*row, "" if bound is None else f"{bound:.2f}", f"{runs[0]['rigs']:,}", *training_cells(runs)]

    return _of_trained(head, experiments, results, cells)


def paper_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Trained networks of the paper's own design."""
    head = (
        "row",
        "experiment",
        "paper's RE",
        "network alone",
        REFINED,
        *STEPS[:2],
        "encoder",
        "seeds",
        "rigs",
        "parameters",
        *TRAINING,
    )

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        row = [str(row_of(experiment)), _what(experiment, runs), _paper(experiment)]
        row += [mean(runs, name) for name in (NETWORK, REFINED, *STEPS[:2])]
        row += [encoder(runs), seeds(runs), _rigs(runs)]
        return [*row, _millions(runs[0]["parameters"]), *training_cells(runs)]

    return _of_trained(head, experiments, results, cells)


def comparison_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Effect of single design decisions, in equal training time from scratch."""
    head = ("experiment", "network alone", "median", "seeds", "rigs", "parameters", *TRAINING)

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        row = [experiment.description.partition(":")[0], mean(runs, NETWORK), _px(_mean(runs, NETWORK, "median"))]
        return [*row, seeds(runs), _rigs(runs), _millions(runs[0]["parameters"]), *training_cells(runs)]

    return _of_trained(head, experiments, results, cells)


def shipped_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Accuracy, speed and size of the shipped models."""
    head = (
        "model", "one pass", "all passes", REFINED, *STEPS[:2], "RE < 1 px, one pass / all / refined", "encoder",
        "rises by", "seeds", "rigs", "alone, ms p50 / p99", "refined, ms p50 / p99", "parameters", "file, MB",
        *TRAINING,
    )  # fmt: skip
    stages = (ONE_PASS, NETWORK, REFINED)

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        shown = next((run for run in runs if run["shipped"]), runs[0])
        took, check = shown["latency_ms"], shown.get("encoder")
        name = experiment.name if shown["shipped"] else f"{experiment.name} (float32 run)"
        row = [name, *(mean(runs, stage) for stage in (*stages, *STEPS[:2]))]
        row += [_shares(runs, stages, "share_under_one_px"), encoder(runs)]
        row += ["" if check is None else f"{check['rise']:.3g} x", seeds(runs), f"{shown['rigs']:,}"]
        row += [
            f"{took['alone_p50']:.1f} / {took['alone_p99']:.1f}",
            f"{took['refined_p50']:.1f} / {took['refined_p99']:.1f}",
        ]
        return [*row, _millions(shown["parameters"]), f"{shown['bytes'] / 1e6:.1f}", *training_cells(runs)]

    return _of_trained(head, experiments, results, cells)


def robustness_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Success rate and median with outliers, all methods on the same rigs."""
    columns = ("MAP, true inliers", NETWORK, REFINED, ROBUST, WITHOUT, "5 LM steps from the factory", FACTORY)

    def cells(experiment: RigExperiment, runs: Runs) -> list[str]:
        def cell(name: str) -> str:
            share = _mean(runs, name, "share_under_one_px", part="robustness")
            median = _px(_mean(runs, name, "median", part="robustness"))
            return median if share is None else f"{100 * share:.1f} % / {median}"

        return [experiment.name, *map(cell, columns), seeds(runs)]

    tried = {name: runs for name, runs in results.items() if runs[0].get("robustness") is not None}
    return _of_trained(("model", *columns, "seeds"), experiments, tried, cells)


def mean(runs: Runs, stage: str) -> str:
    """Mean RE and its spread over training seeds, or over trials for one seed; empty if it was not measured."""
    found = [run["exact"][stage] for run in runs if stage in run["exact"]]
    if not found:
        return ""
    means = [column["mean"] for column in found]
    share = fmean(column.get("found", 1.0) for column in found)
    if None in means:
        return "not finite" if share == 1 else "none found"
    spread = stdev(means) if len(means) > 1 else found[0]["spread"]
    refined = "" if share == 1 else f" ({100 * share:.1f} % of rigs)"
    return _px(fmean(means)) + ("" if spread is None else f" ± {spread:.1g}") + refined


def seeds(runs: Runs) -> str:
    """Number of trainings behind a line, and whether the measured networks still exist."""
    count = "one seed" if len(runs) == 1 else f"{len(runs)} seeds"
    if any(run["shipped"] for run in runs):
        return f"{count}, shipped"
    return count if "seed" in runs[0] else f"{count}, measured earlier, model not kept"


def encoder(runs: Runs) -> str:
    """Whether the network of each seed needs its encoder; empty if it has none."""
    checks = [run.get("encoder") for run in runs]
    used = [check["used"] for check in checks if check is not None]
    if not used:
        return ""
    return "used" if all(used) else "**not used**" if not any(used) else f"used by {sum(used)} of {len(used)}"


def training_cells(runs: Runs) -> list[str]:
    """Minutes, steps, start and machine of the first seed's training."""
    training = runs[0]["training"]
    steps = f"{training['steps']:,} x {training['batch_size']}"
    return [f"{training['minutes']:.0f}", steps, training["started_from"] or "", training["machine"]]


def _rigs(runs: Runs) -> str:
    """Number of rigs that each seed was measured on; the fewest if they differ."""
    return f"{min(run['rigs'] for run in runs):,}"


def row_of(experiment: RigExperiment) -> int:
    """Row of the paper's table."""
    return experiment.paper.row if experiment.paper else 0


def _what(experiment: RigExperiment, runs: Runs) -> str:
    """Describe an experiment as it was trained, perhaps at a reduced size."""
    return str(runs[0].get("label") or label(experiment))


def _paper(experiment: RigExperiment) -> str:
    return f"{experiment.paper.re_px:g}" if experiment.paper and experiment.paper.re_px else ""


def _mean(runs: Runs, stage: str, *keys: str, part: str = "exact") -> float | None:
    """Mean of a stage's number over seeds; None if a seed lacks it."""
    found = []
    for run in runs:
        value: Any = run.get(part, {}).get(stage)
        for key in keys:
            value = None if value is None else value.get(key)
        found.append(value)
    return None if None in found else fmean(found)


def _shares(runs: Runs, stages: Iterable[str], key: str) -> str:
    shares = [_mean(runs, stage, key) for stage in stages]
    return " / ".join("?" if share is None else _percent(share) for share in shares)


def _of_trained(
    head: Iterable[str],
    experiments: Sequence[RigExperiment],
    results: Results,
    cells: Callable[[RigExperiment, Runs], list[str]],
) -> str:
    """Make a table of the experiments that have results, and list those that have none."""
    rows = [cells(experiment, results[experiment.name]) for experiment in experiments if experiment.name in results]
    missing = [experiment.name for experiment in experiments if experiment.name not in results]
    note = f"{MISSING.capitalize()}: {', '.join(missing)}." if missing else ""
    return "\n\n".join(filter(None, (markdown(head, rows) if rows else "", note)))


def _px(value: float | None) -> str:
    if value is None:
        return ""
    if value < 1e-9:  # rounding
        return "0"
    return f"{value:.0f}" if 100 <= value < 1e5 else f"{value:.3g}"


def _percent(share: float) -> str:
    return "100 %" if share == 1 else f"{100 * share:.1f} %"


def _millions(count: int) -> str:
    return f"{count / 1e6:.2f} M"
