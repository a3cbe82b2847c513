"""Latency of one rig with each shipped network and its refinement, and with the paper's; training throughput."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from imgcal.io import data_path
from imgcal.networks import Checkpoint, Network, NetworkConfig, build, load_checkpoint
from imgcal.refinement import refine_images, refine_points
from imgcal.synthesis import render_views, synthesize
from imgcal.training import load_experiment, prepare, train_step
from imgcal.types import Views
from scripts.benchmarks.effort import Effort
from scripts.output import BLUE, GREY, figure, markdown
from scripts.timing import Timing, side_by_side

# The paper's networks are untrained, because full-size training needs a GPU; time does not depend on the weights.
PAPERS = {"points": "paper-points", "cnn1d": "paper-cnn1d", "vit": "paper-vit", "cnn": "paper-cnn2d"}
LATENCY, TRAINING = "networks latency", "networks training"
Calls = dict[str, Callable[[], object]]


def measure(effort: Effort) -> dict[str, Any]:
    """Time all networks in turn, with one thread and one rig."""
    torch.set_num_threads(1)
    # Names that end in rig and object; the others are parts of detectors, without a rig and object.
    paths = sorted(data_path("models").glob("*-*-*.safetensors"))
    if effort.smoke:
        paths = [path for path in paths if path.stem.startswith("points")]
    trained = {path.stem: load_checkpoint(path) for path in paths}
    calls: dict[str, Calls] = {name: _calls(one) for name, one in trained.items()}
    networks = {name: one.network for name, one in trained.items()}
    for kind, preset in PAPERS.items():
        if effort.pick(True, kind == "cnn1d"):
            networks[preset] = _untrained(preset, next(iter(trained.values())))
            calls[preset] = {"alone": _forward(networks[preset], next(iter(trained.values())))}
    with torch.inference_mode():
        flat = {f"{name}\n{part}": call for name, parts in calls.items() for part, call in parts.items()}
        timings = side_by_side(flat, effort.pick(60.0, 2.0))
    rows = {name: _row(networks[name], parts, timings, name) for name, parts in calls.items()}
    for path in paths:
        rows[path.stem]["megabytes"] = path.stat().st_size / 1e6
    kinds = effort.pick(("points", "vit", "cnn"), ("points",))
    training = {kind: _throughput(f"shipped-{kind}-cube8", effort.pick(12, 1)) for kind in kinds}
    return {"networks": rows, "training": training}


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables: latency of one rig, and training throughput."""
    head = ("network", "parameters, M", "file, MB", "alone, ms p50 / p99", "refined, ms p50 / p99")
    rows = [
        (
            f"**{name}**" if "megabytes" in row else f"{name}, as in the paper",
            f"{row['parameters'] / 1e6:.2f}",
            f"{row['megabytes']:.1f}" if "megabytes" in row else "",
            *(
                f"{row[part]['p50']:.1f} / {row[part]['p99']:.1f}" if part in row else ""
                for part in ("alone", "refined")
            ),
        )
        for name, row in result["networks"].items()
    ]
    trained = [(name, str(row["batch_size"]), f"{row['rigs_per_s']:.0f}") for name, row in result["training"].items()]
    return {
        LATENCY: markdown(head, rows),
        TRAINING: markdown(("shipped encoder", "rigs per step", "rigs/s of training"), trained),
    }


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw latency over the number of parameters."""
    with figure(path, size=(6.0, 3.4)) as [axes]:
        for name, row in result["networks"].items():
            ours = "megabytes" in row
            time_ms = row["refined" if ours else "alone"]["p50"]
            axes.plot(row["parameters"] / 1e6, time_ms, "o", color=BLUE if ours else GREY, markersize=5)
            if not name.endswith("cube8"):  # same size and speed as its sibling
                place = (row["parameters"] / 1e6, time_ms)
                axes.annotate(name.split("-O10")[0], place, fontsize=7, xytext=(5, 3), textcoords="offset points")
        axes.set(xscale="log", yscale="log", xlabel="parameters, millions", ylabel="one rig: ms, 1 thread")
        axes.margins(x=0.3)


def _row(network: torch.nn.Module, parts: Calls, timings: Mapping[str, Timing], name: str) -> dict[str, Any]:
    count = sum(parameter.numel() for parameter in network.parameters())
    return {"parameters": count} | {part: timings[f"{name}\n{part}"].values() for part in parts}


def _views(trained: Checkpoint, network: Network) -> Views:
    """Simulate the views of one drifted rig."""
    factory, drift = trained.rig.to(torch.float32), trained.experiment.drift
    seen = synthesize(factory, trained.obj, 1, torch.Generator().manual_seed(0), drift=drift).projection
    options = network.image_options
    if options is None:
        return Views(uv=seen.uv, seen=seen.visible)
    images = render_views(seen.uv, seen.visible, factory.image_size, trained.obj, options, quantise=True)
    return Views(images=images)


def _forward(network: Network, trained: Checkpoint) -> Callable[[], object]:
    views = _views(trained, network)
    return lambda: network(views)


def _calls(trained: Checkpoint) -> Calls:
    """Make the calls to time: forward pass alone, and with refinement."""
    network, views = trained.network, _views(trained, trained.network)
    given = (trained.rig, trained.obj, trained.drift_std)

    def refined() -> object:
        guess = network(views)[-1]
        return (
            refine_points(guess, views, *given, 0.1)
            if views.images is None
            else refine_images(guess, views.images, *given)
        )

    return {"alone": lambda: network(views), "refined": refined}


def _untrained(preset: str, like: Checkpoint) -> Network:
    rig, spread, weights = like.rig.to(torch.float32), like.drift_std.float(), torch.Generator()
    return build(NetworkConfig(preset=preset), rig, like.obj, spread, weights).eval()


def _throughput(name: str, steps: int) -> dict[str, float]:
    """Time full training steps: synthesis, drawing, forward, loss, backward, optimizer."""
    experiment = load_experiment(name, ["training.validation_rigs=0", "training.device=cpu", "training.threads=1"])
    run = prepare(experiment)
    train_step(run)
    start = time.perf_counter()
    for _ in range(steps):
        train_step(run)
    seconds = time.perf_counter() - start
    batch = experiment.training.batch_size
    return {"batch_size": batch, "rigs_per_s": steps * batch / seconds}
