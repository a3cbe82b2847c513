"""Evaluate trained networks and rewrite docs/results/tables.md: ``python -m scripts.results.table out/runs``.

Reads out/runs/*/model.safetensors, as written by `imgcal train`, and data/models. The results of a network are kept in
docs/results/<experiment>-seed<K>.json with the hash of its file, so another call evaluates only new networks. All seeds
of an experiment make one line.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from imgcal.errors import InputError
from imgcal.fleet import StoredResults, workers
from imgcal.io import shipped_names, write_text
from imgcal.training import RigExperiment, load_experiment
from scripts.output import RESULTS, ROOT, WORK, command, read_json, replaced, write_json
from scripts.results.charts import over_time, sweeps
from scripts.results.headline import headline_tables, measure_headline, time_headline
from scripts.results.measuring import Effort, Source, find, latency_of, measure, swept, without_network
from scripts.results.pages import (
    STEPS,
    accuracy_table,
    background_table,
    comparison_table,
    paper_table,
    parameters_table,
    robustness_table,
    row_of,
    shipped_table,
)

REDUCED = "-reduced"
"""Suffix of the names of experiments that were trained at another size than that in their file."""
HEADLINE, BASELINES = "headline.json", "baselines.json"


@dataclass(frozen=True)
class Options:
    """Evaluate trained networks and rewrite the page of results."""

    runs: Annotated[Path, tyro.conf.Positional] = Path("out/runs")  #: folder of training runs
    models: Path = ROOT / "data" / "models"  #: folder of shipped networks
    page: Path = ROOT / "docs" / "results" / "tables.md"  #: page whose tables are rewritten
    results: Path = RESULTS  #: folder of JSON results and plots
    effort: Annotated[Effort, tyro.conf.arg(name="")] = field(default_factory=Effort)
    only: tuple[str, ...] = ()  #: evaluate these experiments only; the page gets all known ones
    headline: str = "points-O10-cube8"  #: shipped network to compare with Levenberg-Marquardt steps at every drift
    sweep: str = "shipped-points-cube8"  #: experiment whose error is drawn over perturbation and angle
    times: bool = False  #: only repeat the timings, on an idle machine
    sweep_count: int = 1000  #: rigs at each point of those curves
    machine: str = "2 CPU cores shared, 1 thread a training"  #: machine that new runs were trained on
    device: str = "cpu"  #: device of the networks; refinement always runs on the CPU
    address: str | None = None  #: running Ray cluster to measure on; None = this machine
    cores: int = 1  #: cores of this machine; 1 = this process alone
    work: Path = WORK / "table"  #: progress of a call that was stopped


def main(arguments: list[str] | None = None) -> None:
    """Evaluate new networks, then write the page and the plots."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    _read(options.page)  # fail now, not after all measurements, if it cannot be read
    shipped = {name: load_experiment(name) for name in shipped_names("experiments", ".yaml")}
    experiments = {name: one for name, one in shipped.items() if isinstance(one, RigExperiment)}
    sources = find(options.runs, options.models)
    _check_names(options.only, sources)
    for source in sources:
        if source.experiment.removesuffix(REDUCED) not in experiments:
            print(f"{source.path}: {source.experiment} is not in data/experiments: left out", file=sys.stderr)
            continue
        if options.only and source.experiment not in options.only:
            continue
        place = options.results / f"{source.experiment}-seed{source.seed}.json"
        if options.times:
            _time_anew(options, source, place)
        elif not _known(place, source, options.effort):
            _measure(options, source, place)
        if source.experiment == options.sweep:
            _sweep(options, source)
        if source.path.stem == options.headline and not options.times:
            _headline(options, source)
    results = {name: _runs(options.results, name) for one in experiments for name in (one, f"{one}{REDUCED}")}
    results = {name: runs for name, runs in results.items() if runs}
    _complete(results, experiments, options)
    over_time({name: runs[0] for name, runs in results.items()}, options.results / "training.png")
    texts = sections(list(experiments.values()), results) | pictures(options.results)
    texts["headline"] = _headline_text(options.results)
    write_text(options.page, replaced(_read(options.page), texts, options.page))


def sections(experiments: list[RigExperiment], results: dict[str, list[dict[str, Any]]]) -> dict[str, str]:
    """Make all tables, by the names of their markers."""
    reduced = [one.model_copy(update={"name": f"{one.name}{REDUCED}"}) for one in experiments]
    experiments = [*experiments, *(one for one in reduced if one.name in results)]
    table1 = [e for e in experiments if e.paper is not None and e.paper.table == "1"]
    ours = sorted((e for e in table1 if "-paper" not in e.name), key=_order)
    theirs = sorted((e for e in table1 if "-paper" in e.name), key=_order)
    ablation = sorted((e for e in experiments if e.paper is not None and e.paper.table == "ablation"), key=_order)
    shipped = [e for e in experiments if e.name.startswith("shipped-")]
    return {
        "table 1": accuracy_table(ours, results),
        "table 1 parameters": parameters_table(ours, results),
        "table 1 background": background_table(ours, results),
        "paper's networks": paper_table(theirs, results),
        "ablation": paper_table(ablation, results),
        "comparison": comparison_table([e for e in experiments if e.name.startswith("comparison-")], results),
        "shipped": shipped_table(shipped, results),
        "robustness": robustness_table(shipped, results),
    }


def pictures(folder: Path) -> dict[str, str]:
    """Link the existing figures, by the names of their markers."""
    texts = {"training": "RE over training time", "sweep": "RE against kappa and phi"}
    there = {name: (folder / f"{name}.png").is_file() for name in texts}
    return {name: f"![{text}]({name}.png)" if there[name] else "Not made yet." for name, text in texts.items()}


def _order(experiment: RigExperiment) -> tuple[int, str]:
    return (row_of(experiment), experiment.name)


def _measure(options: Options, source: Source, place: Path) -> None:
    """Evaluate a network; the progress of a stopped call is kept until the evaluation is complete."""
    known = read_json(place) if place.is_file() else {}
    same = known if known.get("sha256") == source.sha256 else {}
    kept = StoredResults(options.work / source.sha256[:16], source.sha256)
    with workers(options.address, options.cores, kept) as mapped:
        write_json(place, measure(source, options.effort, options.device, options.machine, mapped, same))
    kept.clear()


def _known(place: Path, source: Source, effort: Effort) -> bool:
    """Tell whether a network has already been evaluated, on at least as many rigs."""
    if not place.is_file():
        return False
    found = read_json(place)
    return bool(found["sha256"] == source.sha256 and found["rigs"] >= effort.rigs(found["images"]))


def _runs(folder: Path, name: str) -> list[dict[str, Any]]:
    """Results of an experiment by seed; if there are none, results from before seeds were distinguished."""
    places = sorted(folder.glob(f"{name}-seed*.json")) or [folder / f"{name}.json"]
    return [read_json(place) for place in places if place.is_file()]


def _complete(
    results: dict[str, list[dict[str, Any]]], experiments: dict[str, RigExperiment], options: Options
) -> None:
    """Add steps from the factory to older results of networks that no longer exist."""
    place = options.results / BASELINES
    known = read_json(place) if place.is_file() else {}
    for name, runs in results.items():
        for run in runs:
            if name.startswith("table1") and STEPS[0] not in run["exact"]:
                if name not in known:
                    known[name] = without_network(experiments[name], options.effort.extra)
                run["exact"] = known[name] | run["exact"]
    if known:
        write_json(place, known)


def _time_anew(options: Options, source: Source, place: Path) -> None:
    """Repeat the timings of an evaluated network, and of the steps beside it."""
    if place.is_file() and (known := read_json(place))["sha256"] == source.sha256:
        write_json(place, known | {"latency_ms": latency_of(source, options.device)})
    place = options.results / HEADLINE
    if source.path.stem == options.headline and place.is_file():
        write_json(place, read_json(place) | {"latency_ms": time_headline(source, 200, options.device)})


def _headline(options: Options, source: Source) -> None:
    place = options.results / HEADLINE
    known = read_json(place) if place.is_file() else {}
    if known.get("sha256") != source.sha256 or known["rigs"] < 3 * options.effort.count:
        write_json(place, measure_headline(source, options.effort.count, options.device))


def _headline_text(folder: Path) -> str:
    place = folder / HEADLINE
    return headline_tables(read_json(place)) if place.is_file() else "Not made yet."


def _sweep(options: Options, source: Source) -> None:
    place = options.results / "sweep.json"
    known = read_json(place) if place.is_file() else {}
    if known.get("sha256") != source.sha256 or known["rigs"] < options.sweep_count:
        known = swept(source, options.sweep_count, options.device)
        write_json(place, known)
    sweeps(known, options.results / "sweep.png")


def _check_names(only: Iterable[str], sources: list[Source]) -> None:
    there = [source.experiment for source in sources]
    for name in only:
        if name not in there:
            raise InputError(f"--only: found {name}, expected one of {', '.join(there) or 'the runs: there are none'}")


def _read(page: Path) -> str:
    try:
        return page.read_text("utf-8")
    except OSError as error:
        raise InputError(f"{page}: cannot be read: {error.strerror or error}") from error


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
