"""Evaluate one trained network: everything that the tables show, as plain values."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from safetensors import SafetensorError, safe_open

from imgcal.errors import InputError
from imgcal.evaluation import (
    BASELINES,
    QUICK_BASELINES,
    REFERENCE,
    Conditions,
    Evaluation,
    Method,
    Model,
    Protocol,
    Scores,
    check_encoder,
    evaluate,
    latency,
    load_models,
    sweep,
)
from imgcal.fleet import Mapper
from imgcal.io import read_metrics, read_texts
from imgcal.networks.checkpoint import FORMAT
from imgcal.synthesis import Corruption, RelativeDrift
from imgcal.training import RigExperiment, checkpoint_experiment
from scripts.output import surroundings

NOISE = Corruption(noise=0.1)
ROBUSTNESS = Corruption(noise=0.1, missing=0.2, swapped=0.1)
FACTORY, WITHOUT, ROBUST = "factory, pose fitted", "MAP from PnP", "PnP + robust bundle adjustment"
NETWORK = "network"
ONE_PASS = f"{NETWORK}, one pass"
HISTORY = 60  # points of the curve over training time


@dataclass(frozen=True)
class Effort:
    """How many rigs are evaluated."""

    count: int = 20_000  # rigs per trial
    image_count: int = 20_000  # rigs per trial of image models, which take about 20 times as long
    trials: int = 3
    extra: int = 1000  # rigs per trial with noise, with outliers, and for methods without a network

    def rigs(self, images: bool) -> int:
        """Number of rigs in all trials."""
        return self.trials * (min(self.count, self.image_count) if images else self.count)


@dataclass(frozen=True)
class Source:
    """A checkpoint on disk."""

    path: Path
    experiment: str
    seed: int
    sha256: str
    shipped: bool
    log: Path  # folder of the training run


def find(runs: Path, models: Path) -> list[Source]:
    """Find checkpoints: those of training runs, and shipped ones, which replace the runs that they come from.

    Raises:
        InputError: a file that cannot be used, or two of the same experiment and seed.
    """
    found: dict[tuple[str, int], Source] = {}
    files = [(path, False) for path in sorted(runs.glob("*/model.safetensors"))]
    files += [(path, True) for path in sorted(models.glob("*.safetensors"))]
    for path, shipped in files:
        known, digest = _experiment_and_seed(path), hashlib.sha256(path.read_bytes()).hexdigest()
        if known is None:
            continue
        name, seed = known
        before = found.get((name, seed))
        if before is not None and before.shipped == shipped:
            raise InputError(f"{path}: found another run of {name} with seed {seed} in {before.path}, expected one")
        log = path.parent if before is None else before.log
        found[name, seed] = Source(path, name, seed, digest, shipped, log)
    return list(found.values())


def measure(
    source: Source, effort: Effort, device: str, trained_on: str, mapped: Mapper = map, known: Mapping[str, Any] = {}
) -> dict[str, Any]:
    """Evaluate one network.

    Args:
        source: its file.
        effort: how many rigs.
        device: device to run it on.
        trained_on: the machine of its training, in words.
        mapped: runs the evaluations (`imgcal.fleet.workers`).
        known: earlier results for the same weights; their times, training and history are kept.
    """
    [model] = load_models([source.path], device=device)
    name, images = checkpoint_experiment(model.checkpoint.experiment).name, model.method.images is not None
    count = min(effort.count, effort.image_count) if images else effort.count
    exact = Protocol(count, effort.trials)
    few = Protocol(min(effort.extra, count), effort.trials)
    methods = {NETWORK: model.method}
    methods |= {name: replace(method, most=few.count) for name, method in QUICK_BASELINES.items()}
    check = check_encoder(model.checkpoint.network, model.conditions)
    result = {
        "experiment": name,
        "label": label(checkpoint_experiment(model.checkpoint.experiment)),
        "seed": source.seed,
        "encoder": None if check is None else vars(check) | {"rise": check.rise, "used": check.used},
        "sha256": source.sha256,
        "shipped": source.shipped,
        "bytes": model.size,
        "parameters": model.parameters,
        "training": known.get("training") or training_of(model, trained_on),
        "surroundings": surroundings(device),
        "images": images,
        "rigs": effort.rigs(images),
        "exact": columns(evaluated(methods, model.conditions, exact, f"{name}, exact", mapped), methods),
        "noise": columns(
            evaluated(
                {NETWORK: model.method}, replace(model.conditions, corruption=NOISE), few, f"{name}, noise", mapped
            ),
            {NETWORK: model.method},
        ),
        "latency_ms": known.get("latency_ms") or vars(latency(model.method, model.conditions)),
        "history": known.get("history") or history_of(read_metrics(source.log / "metrics.jsonl")),
    }
    if name.startswith("shipped"):
        all_methods = {NETWORK: model.method} | QUICK_BASELINES | {ROBUST: BASELINES[ROBUST]}
        conditions = replace(model.conditions, corruption=ROBUSTNESS)
        result["robustness"] = columns(
            evaluated(all_methods, conditions, few, f"{name}, outliers", mapped), all_methods
        )
    return result


def latency_of(source: Source, device: str) -> dict[str, Any]:
    """Milliseconds per rig."""
    [model] = load_models([source.path], device=device)
    return vars(latency(model.method, model.conditions))


def without_network(experiment: RigExperiment, count: int) -> dict[str, Any]:
    """Evaluate the methods without a network, on exact points from an experiment's distribution."""
    rig, obj = experiment.load_rig(), experiment.load_object()
    conditions = Conditions(rig, obj, experiment.poses, experiment.drift)
    return columns(
        evaluated(QUICK_BASELINES, conditions, Protocol(count, 3), f"{experiment.name}, no network"), QUICK_BASELINES
    )


def swept(source: Source, count: int, device: str) -> dict[str, Any]:
    """Evaluate one network over perturbation and angle, with everything else as in training."""
    [model] = load_models([source.path], device=device)
    methods = {NETWORK: model.method, WITHOUT: BASELINES[WITHOUT]}
    drift = model.conditions.drift
    result: dict[str, Any] = {
        "experiment": checkpoint_experiment(model.checkpoint.experiment).name,
        "sha256": source.sha256,
        "rigs": count,
        "trained_kappa": drift.kappa_intrinsics if isinstance(drift, RelativeDrift) else None,
        "surroundings": surroundings(device),
    }
    for axis in ("kappa", "phi"):
        found = sweep(methods, model.conditions, axis, Protocol(count, 1))
        rows = [columns(evaluation, methods) for evaluation in found.evaluations]
        result[axis] = {"values": list(found.values), "rows": rows}
    return result


def label(experiment: RigExperiment) -> str:
    """Describe an experiment in a few words."""
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


def training_of(model: Model, trained_on: str) -> dict[str, Any]:
    """Length and conditions of a training."""
    metrics, experiment = model.checkpoint.metrics, checkpoint_experiment(model.checkpoint.experiment)
    start = experiment.training.init_from
    starts = [start] if isinstance(start, str) else start or []
    return {
        "minutes": metrics.get("seconds", 0.0) / 60,
        "steps": metrics.get("step", 0),
        "batch_size": experiment.training.batch_size,
        "started_from": None if start is None else ", ".join(_name_of_start(Path(path)) for path in starts),
        "machine": trained_on,
    }


def history_of(rows: list[dict[str, Any]]) -> list[list[float]]:
    """Minutes and training RE in pixels, thinned out."""
    told = [[row["seconds"] / 60, row["re_px"]] for row in rows if "seconds" in row and "re_px" in row]
    every = max(1, -(-len(told) // HISTORY))
    return told[::-1][::every][::-1]


def _name_of_start(path: Path) -> str:
    return path.parent.name if path.stem == "model" else path.stem


def _experiment_and_seed(path: Path) -> tuple[str, int] | None:
    """Experiment and seed of a checkpoint; None if it was trained for another task than rigs."""
    with suppress(OSError, SafetensorError), safe_open(path, framework="pt") as file:
        kind = (file.metadata() or {}).get("format", "")
        if kind.startswith("imgcal-") and kind != FORMAT:
            return None
    try:
        experiment = json.loads(read_texts(path, FORMAT)["experiment"])
        if experiment.get("task", "rig") != "rig":
            return None
        return str(experiment["name"]), int(experiment.get("training", {}).get("seed", 0))
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable experiment in it: the file is damaged") from error


def columns(evaluation: Evaluation, methods: Mapping[str, Method]) -> dict[str, Any]:
    """Results of every stage of every method as plain values, and of MAP from the true inliers."""
    found: dict[str, Any] = {REFERENCE: _scores(evaluation.reference)}
    for name in methods:
        row = evaluation.rows[name]
        if row.one_pass is not None:
            found[f"{name}, one pass"] = _scores(row.one_pass) | {"passes": 1}
        found[name] = _scores(row.alone) | {"passes": row.passes}
        if row.refined is not None:
            found[f"{name} + refinement"] = _scores(row.refined)
    return found


def _scores(scores: Scores) -> dict[str, Any]:
    found: dict[str, Any] = dict(scores.statistics()) | {"parameters": scores.parameters()}
    found["held_out"] = dict(scores.statistics("held_out"))
    for told in (found, found["held_out"]):
        told.pop("trial_means")
    if scores.bounds:
        found["times_cramer_rao"] = scores.cramer_rao_ratios()
    return found


def evaluated(
    methods: Mapping[str, Method], conditions: Conditions, protocol: Protocol, what: str, mapped: Mapper = map
) -> Evaluation:
    """Evaluate, and report progress and duration on standard error."""
    began = monotonic()
    found = evaluate(methods, conditions, protocol, _progress(what, protocol, len(methods)), mapped)
    print(f"\r{what}: {protocol.trials} x {protocol.count} rigs, {monotonic() - began:.0f} s", file=sys.stderr)
    return found


def _progress(what: str, protocol: Protocol, methods: int) -> Callable[[int], None]:
    """Make a progress display for an evaluation, if standard error is a terminal."""
    total, done = protocol.count * protocol.trials * (methods + 1), [0]

    def show(rigs: int) -> None:
        done[0] += rigs
        if sys.stderr.isatty():
            print(f"\r{what}: {100 * done[0] / total:.0f} %", end="", file=sys.stderr, flush=True)

    return show
