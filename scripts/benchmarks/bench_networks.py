"""Measure networks: ``python scripts/benchmarks/bench_networks.py`` prints a table, writes results/networks.json.

One rig at a time through each shipped network and its refinement, on exact points or 8-bit images of them, and
the throughput of a training step (synthesis, drawing, forward, loss, backward, optimizer) of each preset that ships.
"""

import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from imgcal.networks import Views
from imgcal.networks.rendering import render_views
from imgcal.refinement import refine_images, refine_points
from imgcal.resources import data_path
from imgcal.synthesis import synthesize
from imgcal.training.checkpoint import load_checkpoint
from imgcal.training.engine import prepare, train_step
from imgcal.training.experiment import load_experiment

REPEATS, WARM_UP, STEPS = 200, 20, 12


def percentiles(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Milliseconds of one call."""
    for _ in range(WARM_UP):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    times.sort()
    return {"p50_ms": statistics.median(times), "p99_ms": times[int(0.99 * len(times))]}


@torch.inference_mode()
def latency(path: Path) -> dict[str, object]:
    """Forward, refinement, and both, for one rig at a time."""
    trained = load_checkpoint(path)
    network, obj, experiment = trained.network, trained.obj, trained.experiment
    factory, drift = trained.rig.to(torch.float32), experiment.drift.drift()
    made = synthesize(factory, obj, 1, torch.Generator().manual_seed(0), drift=drift)
    uv, seen = made.projection.uv, made.projection.visible
    views = Views(uv=uv, seen=seen)
    if network.image_options is not None:
        size = factory.image_size
        views = Views(images=render_views(uv, seen, size, obj, network.image_options, quantise=True))

    def refine() -> None:
        if views.images is None:
            refine_points(guess, views, trained.rig, obj, trained.drift_std, 0.1)
        else:
            refine_images(guess, views.images, trained.rig, obj, trained.drift_std)

    def both() -> None:
        nonlocal guess
        guess = network(views)[-1]
        refine()

    guess = network(views)[-1]
    return {
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "megabytes": path.stat().st_size / 1e6,
        "forward": percentiles(lambda: network(views), REPEATS),
        "refinement": percentiles(refine, REPEATS // 2),
        "forward_and_refinement": percentiles(both, REPEATS // 2),
    }


def throughput(name: str) -> dict[str, float]:
    """Rigs a second of training."""
    with tempfile.TemporaryDirectory() as folder:
        experiment = load_experiment(name, ["training.validation_rigs=0", "training.device=cpu"])
        run = prepare(experiment, Path(folder))
        for _ in range(2):
            train_step(run)
        start = time.perf_counter()
        for _ in range(STEPS):
            train_step(run)
        seconds = time.perf_counter() - start
    batch = experiment.training.batch_size
    return {"batch_size": batch, "rigs_per_s": STEPS * batch / seconds}


def main() -> None:
    torch.set_num_threads(1)
    paths = sorted(data_path("models").glob("*.safetensors"))
    result = {
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count(), "threads": 1},
        "versions": {"python": platform.python_version(), "torch": torch.__version__},
        "load_before": os.getloadavg()[0],
        "one_rig": {path.stem: latency(path) for path in paths},
        "training": {name: throughput(f"shipped-{name}-cube8") for name in ("points", "vit", "cnn")},
    }
    columns = ("parameters", "MB", "forward ms", "refine ms", "both p50", "p99")
    widths = (10, 5, 11, 10, 9, 7)
    print(f"{'network':28s}", *(f"{column:>{width}s}" for column, width in zip(columns, widths, strict=True)))
    for name, row in result["one_rig"].items():
        both = row["forward_and_refinement"]
        print(
            f"{name:28s} {row['parameters']:10,d} {row['megabytes']:5.1f} {row['forward']['p50_ms']:11.2f} "
            f"{row['refinement']['p50_ms']:10.2f} {both['p50_ms']:9.2f} {both['p99_ms']:7.2f}"
        )
    for name, row in result["training"].items():
        print(f"training {name:19s} {row['rigs_per_s']:8.0f} rigs/s, {row['batch_size']} a step")
    out = Path(__file__).parent / "results" / "networks.json"
    out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
