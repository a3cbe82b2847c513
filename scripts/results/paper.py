"""Train the paper's own networks, row by row of its tables, in chunks: python -m scripts.results.paper [row ...].

Trains unfinished networks for at most the given minutes; the next call resumes exactly there. `scripts/results/gpu`
runs this at full size, `scripts/results/train --reduced` at a size and length for minutes on a CPU core. Runs are
RUNS/<experiment>-seed<K>, or RUNS/<experiment>-reduced-seed<K> at reduced size.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Annotated, Literal

import torch
import tyro

from imgcal.cli.training_folder import STATE, train_in
from imgcal.errors import InputError
from imgcal.io import shipped_names
from imgcal.training import RigExperiment, change_experiment, is_finished, load_experiment
from scripts.output import command

Size = Literal["full", "reduced", "toy"]

ROWS = tuple(
    name
    for name in shipped_names("experiments", ".yaml")
    if name.startswith("ablation-row") or (name.startswith("table1-row") and name.endswith("-paper"))
)

# Changes for a GPU: rounding, memory order, compilation; the method stays the same.
FULL = {
    "points": ("training.compile=true", "training.tf32=true"),
    "images": ("training.compile=true", "training.tf32=true", "training.channels_last=true"),
}
EVERY = ("training.log_every=500", "training.validate_every=5000", "training.save_every=5000")

# For minutes on a CPU core: an eighth of the width, fewer layers, float32, and a schedule for few steps.
SHORT = (
    "optimizer.lr=0.003",
    "schedule={kind: cosine, warmup: 0.05}",
    "training.precision=float32",
    "training.device=cpu",
    "training.threads=1",
    "training.validation_rigs=256",
)
SMALL_VIT = "{patch_size: 16, img_size: 112, embed_dim: 96, depth: 3, num_heads: 3}"
SMALL_CNN = "{layers: [1, 1, 1, 1], channels: [12, 24, 48, 160], stem_width: 12}"
REDUCED = {
    "points": ("network.change.width=64", "network.change.depth=2", "network.change.head_widths=[128]"),
    "vit": (
        "network.change.backbone=vit_tiny_patch16_224",
        f"network.change.options={SMALL_VIT}",
        "images={size: 112, dot: 1.0}",
        "optimizer.lr=3e-4",  # at the CNN's 3e-3 it hardly learns
    ),
    "cnn": (
        "network.change.backbone=resnet10t",
        f"network.change.options={SMALL_CNN}",
        "training.channels_last=true",
        "images={size: 112, dot: 1.0}",
    ),
}
TOY = {
    "points": ("network.change.width=16", "network.change.depth=1", "network.change.head_widths=[16]"),
    "vit": (
        "network.change.backbone=vit_tiny_patch16_224",
        "network.change.options={patch_size: 16, img_size: 32, embed_dim: 12, depth: 1, num_heads: 2}",
    ),
    "cnn": (
        "network.change.backbone=resnet10t",
        "network.change.options={layers: [1, 1, 1, 1], channels: [8, 8, 8, 8], stem_width: 8}",
    ),
}


@dataclass(frozen=True)
class Options:
    """Train the paper's own networks."""

    rows: Annotated[tuple[str, ...], tyro.conf.Positional] = ()  #: experiments; none = all of the paper's rows
    size: Size = "reduced"  #: of the networks, and the length of their training
    runs: Path = Path("out/runs")  #: folder of training runs
    seeds: int = 1  #: trainings of each row, seeds 1 and up
    steps: int | None = None  #: of every training, instead of the number for its size
    minutes: float | None = None  #: time limit; None = until all are trained
    device: Literal["auto", "cpu"] = "auto"  #: device of the networks; "auto" = a GPU if there is one


def main(arguments: list[str] | None = None) -> None:
    """Train, and list what is unfinished."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    for row in options.rows:
        if row not in ROWS:
            raise InputError(f"found {row}, expected some of {', '.join(ROWS)}")
    for name in train(options):
        print(f"unfinished: {name}", file=sys.stderr)


def train(options: Options) -> list[str]:
    """Resume the trainings, seed by seed; return the names of the unfinished ones."""
    began = monotonic()

    def out_of_time() -> bool:
        return options.minutes is not None and monotonic() - began > 60 * options.minutes

    left = []
    for seed in range(1, options.seeds + 1):
        for row in options.rows or ROWS:
            experiment = sized(row, options, seed)
            folder = folder_of(experiment, options.runs)
            if (folder / "done").exists():
                continue
            if not out_of_time():
                if experiment.training.tf32:
                    torch.set_float32_matmul_precision("high")
                if experiment.training.threads is not None:
                    torch.set_num_threads(experiment.training.threads)
                run = train_in(folder, experiment, (folder / STATE).exists(), out_of_time)
                if is_finished(run, run.seconds):
                    (folder / "done").touch()
                    continue
            left.append(folder.name)
    return left


def folder_of(experiment: RigExperiment, runs: Path) -> Path:
    """Folder of a training run."""
    return runs / f"{experiment.name}-seed{experiment.training.seed}"


def name_of(row: str, size: Size) -> str:
    """Name of a row's experiment at a size."""
    return row if size == "full" else f"{row}-{size}"


def sized(row: str, options: Options, seed: int) -> RigExperiment:
    """The experiment of a row at a size."""
    experiment = load_experiment(row, kind=RigExperiment)
    kind = {"paper-vit": "vit", "paper-cnn2d": "cnn"}.get(experiment.network.preset, "points")
    images = kind != "points"
    changes = [f"training.seed={seed}", f"name={name_of(row, options.size)}"]
    if options.device == "cpu":
        changes.append("training.device=cpu")
    match options.size:
        case "full":
            changes += [*FULL["images" if images else "points"], *EVERY]
            steps = options.steps or experiment.training.steps or 1
        case "reduced":
            steps = options.steps or (1200 if images else 500)
            changes += [*SHORT, *REDUCED[kind], f"training.batch_size={8 if images else 64}"]
            changes += ["training.save_every=250", "training.validate_every=250"]
        case "toy":
            steps = options.steps or 4
            changes += [*SHORT, *TOY[kind], "training.batch_size=4", "training.validation_rigs=4", "optimizer.lr=1e-3"]
            changes += ["images={size: 32, dot: 1.0}"] if images else []
    if options.size != "full" or options.steps is not None:
        # The paper's second stage begins after 10,000 of its 300,000 steps.
        changes.append(f"loss.paper.reprojection_from={steps // 3}")
    return change_experiment(experiment, *changes, f"training.steps={steps}")


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
