"""Does learning from a running rig slow the loop, and does it help? Updates while the process learns and is stopped.

Run as `python -m scripts.benchmarks.watch_learning`. Rig T4 at half its size, asymmetric8 with rings as markers, among
discs that are no markers (`scripts.results.unlike_markers`). Blocks of updates take turns: in every second one the
process of `imgcal watch --learn` is stopped by a signal. Between the measured blocks the process gets the usual
priority, if that is permitted, so that a busy machine comes to an end.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import imgcal
from imgcal.cli.watch import LEARNING_CODE
from imgcal.detection import DetectionOptions
from imgcal.networks import Expectation
from imgcal.synthesis import SimulatedRig
from imgcal.watch import CANDIDATE, LEARNING, LOWEST, SUBJECTS, Learning, LearningPlan, LearningTask
from scripts.output import ROOT, command, fill, markdown, read_json, surroundings, write_json
from scripts.results.unlike_markers import draw_frames

RESULT = ROOT / "docs" / "benchmarks" / "watch_learning.json"
PAGE = ROOT / "docs" / "watch.md"
LOW, HIGH = torch.tensor([[-250.0, -150.0, 750.0], [250.0, 150.0, 950.0]], dtype=torch.float64)
SIZE = (1024, 544)
RATE = 5.0  # snapshots a second of the simulated clock


@dataclass(frozen=True)
class Options:
    """How much is measured."""

    out: Path = RESULT  #: file of the result
    shape: str = "rings"  #: of the markers
    blocks: int = 8  #: with and without learning, each, while it trains
    updates: int = 25  #: of each block
    minutes: float = 60.0  #: at most, for the whole
    least_held_out: int = 8  #: snapshots for a comparison
    changes: tuple[str, ...] = ()  #: to the training, as for `imgcal train --set`


def measure(options: Options) -> dict[str, Any]:
    """Take turns; times of an update with what learning adds to it, ms."""
    torch.set_num_threads(1)
    rig, obj = imgcal.load_rig("T4").resized(torch.tensor(SIZE)), imgcal.load_object("asymmetric8")
    running, random = SimulatedRig(rig, obj, LOW, HIGH), np.random.default_rng(0)
    rows: dict[str, list[tuple[float, float]]] = {f"{phase}, {kind}": [] for phase in ("harvest", "training")
                                                  for kind in ("stopped", "learning")}  # fmt: skip
    clock, ends = iter(range(10**9)), time.monotonic() + 60 * options.minutes
    counts = {"snapshots": 0, "refused": 0}
    plan = LearningPlan(least_held_out=options.least_held_out, changes=options.changes)
    with tempfile.TemporaryDirectory() as folder:
        task = LearningTask(Path(folder), obj, DetectionOptions(), plan, SUBJECTS)
        candidate = Path(folder) / LEARNING / CANDIDATE
        with imgcal.RigKeeper(rig, obj, detector="learned") as keeper, Learning(task, LEARNING_CODE) as learning:

            def block() -> Iterator[tuple[float, float]]:
                for _ in range(options.updates):
                    seconds = next(clock) / RATE
                    expected = Expectation.of(rig, obj, running.pose(seconds).reshape(1))
                    frames = draw_frames(rig, expected, options.shape, random)
                    wall, cpu = time.perf_counter(), time.thread_time()
                    state = keeper.update(frames, 1e9 + seconds)
                    learning.offer(state, frames)
                    yield 1e3 * (time.perf_counter() - wall), 1e3 * (time.thread_time() - cpu)
                    counts["snapshots"] += 1
                    counts["refused"] += state.refused is not None

            def turn(phase: str) -> None:
                for kind, number in (("stopped", signal.SIGSTOP), ("learning", signal.SIGCONT)):
                    os.kill(learning.process_id, number)
                    rows[f"{phase}, {kind}"] += list(block())

            def hurry(priority: int) -> None:
                with contextlib.suppress(PermissionError):  # only an administrator may raise it again
                    os.setpriority(os.PRIO_PROCESS, learning.process_id, priority)

            list(block())  # the first ones learn the rig, and wait for the compiler
            for _ in range(options.blocks):
                turn("harvest")
            hurry(0)
            while not candidate.exists() and time.monotonic() < ends:
                list(block())
            hurry(LOWEST)
            for _ in range(options.blocks):
                if candidate.exists():
                    turn("training")
            hurry(0)
            while not (found := learning.outcomes()) and time.monotonic() < ends:
                time.sleep(1.0)
            card = Path(folder) / LEARNING / "adapted" / "README.md"
            said = [outcome.message.replace(folder, "OUT") for outcome in found]
            lines = card.read_text().splitlines() if card.is_file() else []
    return {
        "markers": options.shape,
        **counts,
        "outcomes": said,
        "card": [line for line in lines if line.startswith("| ") and "%" not in line],
        "rows": {name: _quantiles(np.array(times)) for name, times in rows.items() if times},
    }


def _quantiles(times: NDArray[np.float64]) -> dict[str, float]:
    wall, cpu = times.T
    return {
        "updates": len(wall),
        **{f"p{q}_ms": float(np.quantile(wall, q / 100)) for q in (50, 99)},
        **{f"cpu_p{q}_ms": float(np.quantile(cpu, q / 100)) for q in (50, 99)},
    }


def table(result: dict[str, Any]) -> str:
    """Markdown."""
    keys = ("updates", "p50_ms", "p99_ms", "cpu_p50_ms", "cpu_p99_ms")
    rows = [[name, *(f"{row[key]:.4g}" for key in keys)] for name, row in result["rows"].items()]
    return markdown(["update, ms", "updates", "p50", "p99", "CPU p50", "CPU p99"], rows)


def main() -> None:
    """Measure, write, print; put the committed result on its page."""
    options = tyro.cli(Options, description=__doc__)
    before = surroundings()
    write_json(options.out, before | measure(options))
    found = read_json(options.out)
    print(table(found), *found["outcomes"], sep="\n")
    if options.out.resolve() == RESULT:
        fill(PAGE, {"watch learning": table(found)})


if __name__ == "__main__":
    command(main)
