"""How long do the detectors `matched` and `learned` take for one snapshot of ten cameras, by stage?

Run as `python -m scripts.benchmarks.detector_speed [--threads 1 2]`: full frames (O10, asymmetric8) and a pose with an
error of a degree, as in `imgcal calibrate`: blobs, the detector, data association. CPU time is the sum over all
threads; other processes affect it least. Two threads help only on idle cores: elsewhere torch's threads wait for each
other, which takes CPU time too.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro

from imgcal import DetectionOptions, load_object, load_rig
from imgcal.association import IdentityOptions, Proposer, judge
from imgcal.cli.common import keep_memory
from imgcal.detection import detect_snapshot
from imgcal.matching import MatchedFilter, matched_filter, refinement
from imgcal.pipeline import learned_proposer
from imgcal.pipeline.learned_proposer import load_proposer
from imgcal.synthesis import DIFFICULTIES
from scripts.output import ROOT, command, fill, markdown, read_json, surroundings, write_json
from scripts.results.infrared import NEARLY, Case, cases

RESULT = ROOT / "docs" / "benchmarks" / "detector_speed.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
ERROR = 0.3  # px, as in `calibrate`
BLOBS, REST, IDENTITY = "blobs", "rest", "identity"
STAGES: Mapping[str, tuple[tuple[Any, str], ...]] = {
    "maps": (
        (matched_filter, "surprise_maps"),
        (matched_filter.Maps, "pool"),
        (matched_filter.Maps, "dilate"),
    ),
    "poses": ((matched_filter.View, "search_known"),),
    "encoder": ((learned_proposer._View, "of"),),
    "looks": ((learned_proposer._View, "ask"),),
    "measurer": ((learned_proposer._View, "_measure_by_network"),),
    "marker fits": ((refinement, "_measure"), (learned_proposer._View, "_fit")),
    "rig fits": ((refinement, "_fit"), (learned_proposer._View, "fit")),
}
"""Functions that are timed, by stage and owner; none of them calls another."""
COLUMNS = (BLOBS, *STAGES, REST, IDENTITY, "all")
Clocks = dict[str, tuple[float, float]]  # ms of CPU time and wall time, by stage


@dataclass(frozen=True)
class Options:
    """Time the detectors."""

    threads: tuple[int, ...] = (1,)  #: numbers of cores, measured one after the other; several must be idle
    levels: tuple[str, ...] = ("clean", "combined")  #: of difficulty
    snapshots: int = 2  #: per level
    rounds: int = 5
    out: Path | None = None  #: a result file; docs/benchmarks/detector_speed.json rewrites its table in the page
    again: bool = False  #: measure nothing: rewrite the table from the existing JSON


class Stopwatch:
    """CPU time and wall time of the stages of one snapshot."""

    def __init__(self) -> None:
        self.taken: Clocks = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent in the `with` block to a stage."""
        cpu, clock = time.process_time(), time.perf_counter()
        yield
        before = self.taken.get(name, (0.0, 0.0))
        cpu, clock = time.process_time() - cpu, time.perf_counter() - clock
        self.taken[name] = before[0] + 1e3 * cpu, before[1] + 1e3 * clock

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function so that it is timed."""

        def call(*arguments: Any, **options: Any) -> Any:
            with self.stage(name):
                return function(*arguments, **options)

        return call


def timed(proposer: Proposer, case: Case, seed: int) -> Clocks:
    """Time one snapshot: blobs, the detector's stages, data association."""
    watch, snapshot = Stopwatch(), case.believed(NEARLY, seed)
    with watch.stage(BLOBS):
        detect_snapshot(dict(snapshot.frames), DetectionOptions())
    with ExitStack() as stack:
        for name, places in STAGES.items():
            for owner, attribute in places:
                function = watch.timed(name, getattr(owner, attribute))
                # A class method is already bound.
                made = staticmethod(function) if isinstance(vars(owner)[attribute], classmethod) else function
                stack.enter_context(patch.object(owner, attribute, made))
        with watch.stage("detector"):
            proposal = proposer.propose(snapshot)
    with watch.stage(IDENTITY):
        judge(proposal, snapshot, IdentityOptions(), error=ERROR, pose_known=False)
    taken = watch.taken
    staged = np.sum([taken.get(name, (0.0, 0.0)) for name in STAGES], axis=0)
    whole = np.sum([taken[name] for name in (BLOBS, "detector", IDENTITY)], axis=0)
    rest = np.subtract(taken.pop("detector"), staged)
    return taken | {REST: tuple(rest.tolist()), "all": tuple(whole.tolist())}


def measure(options: Options) -> dict[str, Any]:
    """Measure median CPU time and wall time (ms) of every stage, by threads, level and detector."""
    keep_memory()
    rig, obj = load_rig("O10"), load_object("asymmetric8")
    shots = {level: list(cases(rig, obj, DIFFICULTIES[level], options.snapshots)) for level in options.levels}
    proposers: dict[str, Proposer] = {"matched": MatchedFilter(), "learned": load_proposer(finder=MatchedFilter())}
    made: dict[str, Any] = {}
    for threads in options.threads:
        with of_threads(threads):
            made[str(threads)] = {
                level: {name: summary(proposer, shots[level], options.rounds) for name, proposer in proposers.items()}
                for level in options.levels
            }
    return {"snapshots": options.snapshots, "rounds": options.rounds, "by_threads": made}


def summary(proposer: Proposer, shots: list[Case], rounds: int) -> dict[str, dict[str, float]]:
    """Median times of the stages, without the first round, which compiles."""
    runs = [timed(proposer, case, seed) for _ in range(rounds + 1) for seed, case in enumerate(shots)][len(shots) :]
    medians = {name: np.median([run[name] for run in runs], axis=0) for name in COLUMNS if name in runs[0]}
    return {name: {"cpu_ms": float(cpu), "clock_ms": float(clock)} for name, (cpu, clock) in medians.items()}


@contextmanager
def of_threads(count: int) -> Iterator[None]:
    """Limit this process to `count` cores, and torch to as many threads."""
    threads, cores = torch.get_num_threads(), os.sched_getaffinity(0)
    torch.set_num_threads(count)
    for task in _tasks():
        os.sched_setaffinity(task, sorted(cores)[:count])
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        for task in _tasks():
            os.sched_setaffinity(task, cores)


def _tasks() -> list[int]:
    """Threads of this process: each has its own set of cores."""
    return [int(entry.name) for entry in Path("/proc/self/task").iterdir()]


def table(result: Mapping[str, Any]) -> str:
    """Make the table, as Markdown."""
    rows = [
        [f"{name}, {level}, {threads}", *(_cell(row.get(column)) for column in COLUMNS)]
        for threads, levels in result["by_threads"].items()
        for level, said in levels.items()
        for name, row in said.items()
    ]
    return markdown(["ms CPU / wall; threads", *COLUMNS], rows)


def _cell(taken: Mapping[str, float] | None) -> str:
    return "" if taken is None else f"{taken['cpu_ms']:.1f} / {taken['clock_ms']:.1f}"


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    out = RESULT if options.again else options.out
    result = read_json(RESULT) if options.again else surroundings() | measure(options)
    if out is not None:
        write_json(out, result)
    if out is not None and out.resolve() == RESULT:
        fill(PAGE, {"detector speed": table(result)})
    print(table(result))


if __name__ == "__main__":
    command(main)
