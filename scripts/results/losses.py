"""Repeat the paper's loss figure: ``python -m scripts.results.losses`` writes docs/results/losses.json and .png.

Trains a point network with the paper's loss alone, and tracks on fixed rigs the other terms that the paper tried: they
fall to their values for the true cameras without being minimized. The network is a narrower version of the paper's, so
that a CPU suffices. The second stage, with reprojection, begins after a third of the time.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, cast

import torch
import tyro
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.nn import project_fiducials
from imgcal.training import RigExperiment, RigTask, change_experiment, load_experiment, prepare, train_step
from imgcal.training.engine import check_finite
from imgcal.training.losses import (
    distortion_size,
    focal_ratio,
    geodesic,
    inverse_focal,
    l1_norm,
    log_cosh,
    parameter_rmse,
    principal_point_shift,
    reprojection_rmse,
)
from imgcal.types import CalibrationObject, Prediction
from scripts.output import BLUE, GREY, RESULTS, command, figure, surroundings, write_json

PROPOSED = ("parameter RMSE", "geodesic", "reprojection RMSE")
NETWORK = "network={preset: paper-points, change: {width: 128, depth: 3, head_widths: [256]}}"
NEVER = 10**9  # a step that no run reaches


@dataclass(frozen=True)
class Options:
    """Track auxiliary losses during a short training."""

    minutes: float = 5.0
    experiment: str = "table1-row01"
    set: tuple[str, ...] = (NETWORK, "optimizer={lr: 5.0e-4, ema: null}")  #: changes of the experiment
    every: int = 20  #: steps between two evaluations
    rigs: int = 256  #: rigs in each evaluation
    out: Path = RESULTS  #: folder of losses.json and losses.png


def main(arguments: list[str] | None = None) -> None:
    """Train, track the terms, and write the results."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if not options.minutes > 0:
        raise InputError(f"--minutes: found {options.minutes:g}, expected more than 0")
    loss = f"loss={{kind: paper, paper: {{reprojection_from: {NEVER}}}}}"
    chosen = load_experiment(options.experiment, kind=RigExperiment)
    experiment = change_experiment(chosen, *options.set, loss, "training.validation_rigs=0")
    result = surroundings() | watched(experiment, options)
    write_json(options.out / "losses.json", result)
    draw(result, options.out / "losses.png")
    for name, values in result["losses"].items():
        at_truth = result["truth"].get(name)
        print(f"{name:20s} {values[0]:12.5g} -> {values[-1]:12.5g}" + ("" if at_truth is None else f"  {at_truth:.5g}"))


def watched(experiment: RigExperiment, options: Options) -> dict[str, Any]:
    """Train for some minutes; return all terms, every few steps."""
    run = prepare(experiment)
    task = cast(RigTask, run.task)
    batch = task.batch(options.rigs, torch.Generator(task.prior_std.device).manual_seed(1))
    truth, obj = batch.truth, task.source.obj
    steps: list[int] = []
    found: dict[str, list[float]] = {}
    second_stage: int | None = None
    began = monotonic()

    def look() -> None:
        with torch.no_grad():
            run.plain.eval()
            values = terms(run.plain(batch.views)[-1], truth, obj, experiment.loss.paper.lambda_scale, run.plain)
            run.plain.train()
        steps.append(run.step)
        for name, value in values.items():
            found.setdefault(name, []).append(float(value))

    look()
    while (part := (monotonic() - began) / (60 * options.minutes)) < 1:
        if part > 1 / 3 and second_stage is None:
            second_stage = run.step
            task.experiment = change_experiment(task.experiment, f"loss.paper.reprojection_from={run.step}")
        run.schedule.set_progress(part)
        train_step(run)
        if run.step % options.every == 0:
            look()
    check_finite(run)
    look()
    own = terms(truth, truth, obj, 1.0, run.plain)
    return {
        "experiment": options.experiment,
        "changes": list(options.set),
        "minutes": options.minutes,
        "batch_size": run.batch_size,
        "second_stage_from": second_stage,
        "steps": steps,
        "losses": found,
        "truth": {name: float(own[name]) for name in found if name not in (*PROPOSED, "log-cosh", "L1 of weights")},
    }


def terms(
    predicted: Prediction, truth: Prediction, obj: CalibrationObject, scale: float, network: nn.Module
) -> dict[str, Tensor]:
    """Compute all terms, the paper's own first."""
    cameras, true_cameras = predicted.cameras_from_object, truth.cameras_from_object
    return {
        "parameter RMSE": parameter_rmse(cameras, true_cameras, scale),
        "geodesic": geodesic(cameras, true_cameras).mean(),
        "reprojection RMSE": reprojection_rmse(project_fiducials(cameras, obj) - project_fiducials(true_cameras, obj)),
        "log-cosh": log_cosh(cameras, true_cameras, scale),
        "distortion": distortion_size(cameras),
        "focal ratio": focal_ratio(cameras),
        "principal point": principal_point_shift(cameras),
        "large focal": inverse_focal(cameras),
        "L1 of weights": l1_norm(network.parameters()),
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw one small panel per term: the paper's own in blue, others in grey; dashed: values of the true cameras."""
    losses = result["losses"]
    with figure(path, rows=3, panels=3, size=(8.5, 6.0)) as panels:
        for axes, (name, values) in zip(panels, losses.items(), strict=True):
            axes.plot(result["steps"], values, color=BLUE if name in PROPOSED else GREY, linewidth=1.2)
            axes.set_yscale("linear" if name.startswith("L1") else "log")
            axes.set_title(name + (" (minimized)" if name in PROPOSED else ""), fontsize=8)
            axes.tick_params(labelsize=7)
            if name in result["truth"]:
                axes.axhline(result["truth"][name], color="black", linestyle="--", linewidth=0.8)
            if result["second_stage_from"] is not None:
                axes.axvline(result["second_stage_from"], color="#bbbbbb", linewidth=0.8)
        panels[-2].set_xlabel("steps", fontsize=8)


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
