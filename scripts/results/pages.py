"""Turns results into the tables of docs/results.md, between its markers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from imgcal.networks import Images, PaperImages
from imgcal.synthesis import RelativeDrift
from imgcal.training import RigExperiment
from scripts.output import markdown
from scripts.results.measuring import FACTORY, NETWORK, ROBUST, WITHOUT

Results = Mapping[str, dict[str, Any]]

MISSING = "not trained yet"
TRAINING = ("minutes", "steps x rigs", "started from", "machine")
REFINED = f"{NETWORK} + refinement"

# RE in pixels that was aimed at, by row of table 1: network alone, and refined on exact points or 8-bit images.
GOALS = {1: 2.0, 2: 3.0, 3: 5.0, 4: 3.0, 5: 3.0, 6: 2.0, 7: 0.2, 8: 1.0, 9: 3.0, 10: 1.5, 11: 1.5, 12: 2.5, 13: 4.0}
REFINED_GOALS = {"points": 0.02, "images": 0.1}


def accuracy_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Table 1, our networks: both columns beside the paper's."""
    head = (
        "row",
        "what",
        "paper's RE",
        "goal, network alone",
        "network alone",
        "goal, refined",
        "network + refinement",
        "p99",
        "share <= 0.5 px",
    )
    rows = []
    for experiment in experiments:
        row, kind = row_of(experiment), variant(experiment)
        cells = [str(row), label(experiment), _paper(experiment), _px(GOALS.get(row))]
        result = results.get(experiment.name)
        if result is None:
            cells += [MISSING, _px(REFINED_GOALS[kind]), "", "", ""]
        else:
            alone, refined = result["exact"][NETWORK], result["exact"][REFINED]
            cells += [
                f"**{mean(alone)}**",
                _px(REFINED_GOALS[kind]),
                f"**{mean(refined)}**",
                _px(refined["p99"]),
                _percent(refined["share_under_half_px"]),
            ]
        rows.append(cells)
    return markdown(head, rows)


def background_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Table 1, second half: noise, what other methods get there, and what each training took."""
    head = (
        "row",
        "what",
        "factory rig, pose fitted",
        "MAP without network",
        "0.1 px noise: alone",
        "refined",
        "refined / Cramer-Rao bound",
        "rigs",
        *TRAINING,
    )

    def cells(experiment: RigExperiment, result: dict[str, Any]) -> list[str]:
        exact, noise = result["exact"], result["noise"]
        row = [str(row_of(experiment)), label(experiment), _px(exact[FACTORY]["mean"]), _px(exact[WITHOUT]["mean"])]
        row += [_px(noise[NETWORK]["mean"]), _px(noise[REFINED]["mean"]), _bound(noise[REFINED])]
        return [*row, f"{result['rigs']:,}", *training_cells(result)]

    return _of_trained(head, experiments, results, cells)


def paper_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Trained networks of the paper's own design."""
    head = ("row", "what", "paper's RE", "network alone", REFINED, "parameters", *TRAINING)

    def cells(experiment: RigExperiment, result: dict[str, Any]) -> list[str]:
        exact = result["exact"]
        row = [str(row_of(experiment)), label(experiment), _paper(experiment)]
        return [
            *row,
            mean(exact[NETWORK]),
            mean(exact[REFINED]),
            _millions(result["parameters"]),
            *training_cells(result),
        ]

    return _of_trained(head, experiments, results, cells)


def comparison_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """What single decisions are worth, in equal minutes from nothing."""
    head = ("what", "network alone", "median", "parameters", *TRAINING)

    def cells(experiment: RigExperiment, result: dict[str, Any]) -> list[str]:
        alone = result["exact"][NETWORK]
        row = [experiment.description.partition(":")[0], mean(alone), _px(alone["median"])]
        return [*row, _millions(result["parameters"]), *training_cells(result)]

    return _of_trained(head, experiments, results, cells)


def shipped_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Size, speed and accuracy of the models that ship."""
    head = (
        "model",
        "parameters",
        "file, MB",
        "network alone",
        REFINED,
        "p99",
        "share <= 0.5 px",
        "alone, ms p50 / p99",
        "refined, ms p50 / p99",
        *TRAINING,
    )
    rows = []
    for experiment in experiments:
        result = results.get(experiment.name)
        if result is None:
            rows.append([experiment.name, MISSING])
            continue
        exact, took = result["exact"], result["latency_ms"]
        name = experiment.name if result["shipped"] else f"{experiment.name} (float32 run)"
        cells = [name, _millions(result["parameters"]), f"{result['bytes'] / 1e6:.1f}"]
        cells += [mean(exact[NETWORK]), mean(exact[REFINED]), _px(exact[REFINED]["p99"])]
        cells += [_percent(exact[REFINED]["share_under_half_px"])]
        cells += [f"{took['alone_p50']:.1f} / {took['alone_p99']:.1f}"]
        cells += [f"{took['refined_p50']:.1f} / {took['refined_p99']:.1f}", *training_cells(result)]
        rows.append(cells)
    return markdown(head, rows)


def robustness_table(experiments: Sequence[RigExperiment], results: Results) -> str:
    """Median RE with outliers, everybody on the same rigs."""
    columns = ("MAP, true inliers", NETWORK, REFINED, ROBUST, WITHOUT, FACTORY)

    def cells(experiment: RigExperiment, result: dict[str, Any]) -> list[str]:
        medians = {name: result["robustness"][name]["median"] for name in columns}
        return [experiment.name, *map(_px, medians.values()), f"{medians[REFINED] / medians[columns[0]]:.2f}"]

    tried = {name: result for name, result in results.items() if result.get("robustness") is not None}
    return _of_trained(("model", *columns, "network + refinement / true inliers"), experiments, tried, cells)


def variant(experiment: RigExperiment) -> str:
    """Tell what the network of an experiment takes: points or images."""
    return "images" if isinstance(experiment.network.variant(), Images | PaperImages) else "points"


def label(experiment: RigExperiment) -> str:
    """Say in a few words what an experiment is about."""
    drift, poses = experiment.drift, experiment.poses
    where = "overhead" if poses.phi_deg == (0.0, 0.0) else "hemisphere"
    kappas = "physical drift"
    if isinstance(drift, RelativeDrift):
        kappas = f"kappa {100 * drift.kappa_intrinsics:g} / {100 * drift.kappa_extrinsics:g} %"
    changes = ", ".join(f"{key} {value}" for key, value in experiment.network.change.items())
    if experiment.loss.kind == "paper" and experiment.loss.paper.lambda_scale == 1:
        changes = ", ".join(filter(None, (changes, "no value scaling")))
    network = experiment.network.preset + (f" ({changes})" if changes else "")
    return f"{network}, {where}, {experiment.rig} {experiment.object}, {kappas}"


def mean(column: Mapping[str, Any]) -> str:
    """Mean RE, and the spread of that mean over trials."""
    if column["mean"] is None:
        return "not finite"
    deviation = column["spread"]
    return _px(column["mean"]) + ("" if deviation is None else f" ± {deviation:.1g}")


def training_cells(result: Mapping[str, Any]) -> list[str]:
    """What a training took: minutes, steps, start, machine."""
    training = result["training"]
    steps = f"{training['steps']:,} x {training['batch_size']}"
    return [f"{training['minutes']:.0f}", steps, training["started_from"] or "", training["machine"]]


def row_of(experiment: RigExperiment) -> int:
    """Row of the paper's table."""
    return experiment.paper.row if experiment.paper else 0


def _paper(experiment: RigExperiment) -> str:
    return f"{experiment.paper.re_px:g}" if experiment.paper and experiment.paper.re_px else ""


def _of_trained(
    head: Iterable[str],
    experiments: Sequence[RigExperiment],
    results: Results,
    cells: Callable[[RigExperiment, dict[str, Any]], list[str]],
) -> str:
    """A table of the experiments that have results, and the names of those that have none."""
    rows = [cells(experiment, results[experiment.name]) for experiment in experiments if experiment.name in results]
    missing = [experiment.name for experiment in experiments if experiment.name not in results]
    return markdown(head, rows) + (f"\n\nNot trained yet: {', '.join(missing)}." if missing else "")


def _px(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if 100 <= value < 1e5 else f"{value:.3g}"


def _percent(share: float) -> str:
    return "100 %" if share == 1 else f"{100 * share:.2f} %"


def _millions(count: int) -> str:
    return f"{count / 1e6:.2f} M"


def _bound(column: Mapping[str, Any]) -> str:
    ratio = column.get("times_cramer_rao", {}).get("re")
    return "" if ratio is None else f"{ratio:.2f}"
