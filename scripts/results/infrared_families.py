"""Compare ViT and CNN encoders on infrared frames, by training images, operations and difficulty.

`python -m scripts.results.infrared_families --runs out/runs --train` trains every encoder of `ENCODERS` with every
seed, as `imgcal train ir-cnn --set network.encoder=NAME training.seed=K` does, in RUNS/ir-NAME-seedK (existing runs are
kept). It then measures all, writes `docs/results/infrared_families.json` and its picture, and rewrites the tables of
`docs/results/infrared.md`.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from torch.utils.flop_counter import FlopCounterMode

import imgcal
from imgcal.association import Snapshot
from imgcal.errors import InputError
from imgcal.networks import InfraredNetwork, load_infrared
from imgcal.networks.infrared_encoders import ENCODERS
from imgcal.pipeline.learned_proposer import LearnedProposer
from imgcal.synthesis import DIFFICULTIES
from imgcal.training import InfraredTask, change_experiment, load_experiment
from imgcal.types import Detections
from scripts.output import (
    BLUE,
    RED,
    RESULTS,
    command,
    figure,
    fill,
    markdown,
    read_json,
    surroundings,
    write_json,
)
from scripts.results.infrared import HARDER, NEARLY, Case, Tally, ask, cases

JSON, PICTURE, PAGE = (
    RESULTS / "infrared_families.json",
    RESULTS / "infrared_families.png",
    RESULTS / "infrared.md",
)
EXPERIMENT = "ir-cnn"  # its schedule and data are used for all
ON_FRAMES = ("cnn", "vit", "vit-stem")  # in the size that is shipped
BATCH = 12


@dataclass(frozen=True)
class Options:
    """Compare encoders of infrared crops."""

    runs: Path = Path("out/runs")  #: folder of the training runs
    seeds: int = 3
    train: bool = False  #: first train missing networks
    crops: int = 3_000  #: crops that were not used for training
    count: int = 4  #: snapshots per difficulty, of ten cameras each
    again: bool = False  #: measure nothing: rewrite tables and picture from the existing JSON


def main(options: Options) -> None:
    """Train, measure and write the results."""
    if options.train:
        train(options)
    if not options.again:
        write_json(JSON, measured(options))
    result = read_json(JSON)
    draw(result, PICTURE)
    made = tables(result)
    print("\n\n".join(made.values()))
    fill(PAGE, made)


def train(options: Options) -> None:
    """Run missing trainings, one after the other."""
    for seed in range(options.seeds):
        for name in ENCODERS:
            out = folder(options, name, seed)
            if not (out / "model.safetensors").is_file():
                values = [f"network.encoder={name}", f"training.seed={seed}", f"name=ir-{name}"]
                call = [sys.executable, "-m", "imgcal", "train", EXPERIMENT, "--out", str(out), "--set", *values]
                subprocess.run(call, check=True)


def folder(options: Options, encoder: str, seed: int) -> Path:
    """Folder of a training run."""
    return options.runs / f"ir-{encoder}-seed{seed}"


@torch.no_grad()
def measured(options: Options) -> dict[str, Any]:
    """Measure every existing training run."""
    encoders: dict[str, Any] = {}
    networks: dict[tuple[str, int], InfraredNetwork] = {}
    for name in ENCODERS:
        found = [seed for seed in range(options.seeds) if (folder(options, name, seed) / "model.safetensors").is_file()]
        for seed in found:
            out = folder(options, name, seed)
            networks[name, seed] = load_infrared(out / "model.safetensors").network
            row = encoders.setdefault(name, size_of(networks[name, seed]) | {"seeds": {}})
            row["seeds"][str(seed)] = on_crops(networks[name, seed], options.crops) | {"curve": curve(out)}
            print(
                name, seed, {key: round(value, 4) for key, value in row["seeds"][str(seed)].items() if key != "curve"}
            )
    if not networks:
        raise InputError(f"{options.runs}: found no folder ir-ENCODER-seedK, expected trainings: --train makes them")
    shown = {key: network for key, network in networks.items() if key[0] in ON_FRAMES}
    kept = {"encoders": encoders, "crops": options.crops, "snapshots": options.count}
    return surroundings() | kept | {"frames": on_frames(shown, options.count)}


def size_of(network: InfraredNetwork) -> dict[str, Any]:
    """Weights and operations of the encoder, for one crop."""
    size = network.config.crop
    with FlopCounterMode(display=False) as counter:
        network.encoder(torch.zeros(1, 1, size, size))
    return {"parameters": sum(p.numel() for p in network.encoder.parameters()), "flops": counter.get_total_flops()}


def on_crops(network: InfraredNetwork, crops: int) -> dict[str, float]:
    """Right of the visible, wrong of the claimed, NEES: on crops as hard as in training, the same for all."""
    values = [f"network.encoder={network.config.encoder}", f"training.validation_rigs={crops}"]
    experiment = change_experiment(load_experiment(EXPERIMENT), *values)
    task = experiment.make_task(torch.device("cpu"), BATCH, torch.Generator(), fresh=False)
    assert isinstance(task, InfraredTask)
    said = task.validate(lambda batch: task.predict(network, batch))
    return {name.removeprefix("validation_"): value for name, value in said.items()}


def curve(run: Path) -> list[tuple[int, float]]:
    """Crops seen and share of missed and wrong in validation, from the training log."""
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text("utf-8").splitlines()]
    return sorted({(BATCH * row["step"], row["validation_missed"]) for row in rows if "validation_missed" in row})


def on_frames(networks: dict[tuple[str, int], InfraredNetwork], count: int) -> dict[str, Any]:
    """Right and wrong in captured frames by difficulty, with an approximate pose; each network alone proposes."""
    rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    made: dict[str, Any] = {}
    for level, difficulty in {**DIFFICULTIES, **HARDER}.items():
        shots: list[Case] = list(cases(rig, obj, difficulty, count))
        made[level] = {}
        for (name, seed), network in networks.items():
            tally, proposer = Tally(), LearnedProposer(network)
            for number, case in enumerate(shots):
                ask(partial(_proposed, proposer), case, NEARLY, number, tally)
            made[level].setdefault(name, {})[str(seed)] = tally.result()
        means = {name: round(_mean(of_level(made[level], name, "right_percent"))) for name in made[level]}
        print(level, means, flush=True)
    return made


def _proposed(proposer: LearnedProposer, snapshot: Snapshot) -> Detections:
    return proposer.propose(snapshot).detections


def of_level(level: dict[str, Any], name: str, what: str) -> list[float]:
    """One value of an encoder, for each seed."""
    return [said[what] for said in level[name].values()]


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Make the tables, by the names of their markers."""
    crops = []
    for name, row in result["encoders"].items():
        said = row["seeds"].values()
        right, wrong, nees = ([one[key] for one in said] for key in ("right", "wrong", "nees"))
        crops.append([
            name, f"{row['parameters'] / 1e3:.0f} k", f"{row['flops'] / 1e6:.0f} M", str(len(said)),
            _spread(right, 100), _spread(wrong, 100), _spread(nees, 1, 2),
        ])  # fmt: skip
    frames = []
    for level, by in result["frames"].items():
        cells = [
            f"{_spread(of_level(by, name, 'right_percent'))} / {_spread(of_level(by, name, 'wrong_percent'))}"
            for name in by
        ]
        frames.append([level, *cells])
    names = list(next(iter(result["frames"].values())))
    head = ["encoder", "weights", "operations per crop", "seeds", "right, % of visible", "wrong, % of claimed", "NEES"]
    return {
        "infrared families": markdown(head, crops),
        "infrared families frames": markdown(["right % of visible / wrong % of claimed", *names], frames),
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw three panels: over crops seen, operations and difficulty."""
    encoders, frames = result["encoders"], result["frames"]
    with figure(path, panels=3, size=(11.0, 3.6)) as [learning, cost, hard]:
        for name in (name for name in ON_FRAMES if name in encoders):
            curves = [one["curve"] for one in encoders[name]["seeds"].values()]
            steps = [crops for crops, _ in curves[0]]
            missed = [[100 * one[i][1] for one in curves if len(one) == len(steps)] for i in range(len(steps))]
            learning.plot(steps, [_mean(row) for row in missed], marker="o", markersize=3, **_style(name))
            learning.fill_between(steps, [min(row) for row in missed], [max(row) for row in missed], **_fill(name))
            ranks = range(len(frames))
            hard.plot(ranks, [_mean(of_level(by, name, "right_percent")) for by in frames.values()], marker="o",
                      markersize=3, **_style(name))  # fmt: skip
        for name, row in encoders.items():
            missed_last = [100 * one["missed"] for one in row["seeds"].values()]
            cost.errorbar(row["flops"] / 1e6, _mean(missed_last), _deviation(missed_last), marker="o", capsize=2,
                          color=_style(name)["color"])  # fmt: skip
            cost.annotate(name, (row["flops"] / 1e6, _mean(missed_last)), fontsize=7, xytext=(4, 4),
                          textcoords="offset points")  # fmt: skip
        learning.set(xlabel="crops seen in training", ylabel="missed + wrong (%)")
        learning.legend(fontsize=7)
        cost.set(xlabel="operations per crop (M)", ylabel="missed + wrong (%)", xlim=(0, 420))
        hard.set(ylabel="right (%), whole frames")
        short = [level if level in DIFFICULTIES else f"{level.partition(',')[0]} +" for level in frames]
        hard.set_xticks(range(len(frames)), short, rotation=60, ha="right", fontsize=6)


def _style(name: str) -> dict[str, Any]:
    colour = RED if name.startswith("vit") else BLUE
    return {"color": colour, "label": name, "linestyle": "--" if name.endswith("stem") else "-"}


def _fill(name: str) -> dict[str, Any]:
    return {"color": _style(name)["color"], "linewidth": 0, "alpha": 0.15}


def _mean(values: Sequence[float]) -> float:
    return statistics.fmean(values)


def _deviation(values: Sequence[float]) -> float:
    return statistics.stdev(values) if len(values) > 1 else 0.0


def _spread(values: Sequence[float], factor: float = 1.0, digits: int = 1) -> str:
    """Mean and standard deviation over seeds."""
    scaled = [factor * value for value in values]
    spread = f" ± {_deviation(scaled):.{digits}f}" if len(scaled) > 1 else ""
    return f"{_mean(scaled):.{digits}f}{spread}"


if __name__ == "__main__":
    command(lambda: main(tyro.cli(Options, description=__doc__)))
