"""How long does the first `imgcal calibrate` on a machine take? Runs that of `scripts/demo` with an empty cache.

Run as `python -m scripts.benchmarks.compilation`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from imgcal.cli import compiling
from imgcal.cli.main import main as imgcal
from scripts.output import ROOT, command, markdown, read_json, surroundings, write_json

SAMPLE = ROOT / "data" / "samples" / "O10"
RESULT = ROOT / "docs" / "benchmarks" / "compilation.json"
WAYS = {"alone": False, "with a second process": True}
LONGEST = 600.0
"""Seconds to wait at most for the second process to end."""


def calibrate(helped: bool) -> dict[str, Any]:
    """Calibrate the sample in this process, with its NUMBA_CACHE_DIR.

    Returns:
        Functions compiled here, CPU seconds for that (total and by module) and of everything; seconds.
    """
    from numba.core import event

    if helped:
        compiling._load = lambda: 0.0  # what else runs on the machine does not count
    else:
        compiling.is_useful = compiling.is_helped = lambda: False
    times: list[list[float]] = []
    count = 0
    by_module: dict[str, float] = {}

    class Clock(event.Listener):
        """CPU time of each compilation, without nested ones."""

        def on_start(self, happening: event.Event) -> None:
            nonlocal count
            count += 1
            times.append([time.thread_time(), 0.0])

        def on_end(self, happening: event.Event) -> None:
            started, inner = times.pop()
            taken = time.thread_time() - started
            if times:
                times[-1][1] += taken
            name = happening.data["dispatcher"].py_func.__module__
            by_module[name] = by_module.get(name, 0.0) + taken - inner

    event.register("numba:compile", Clock())
    started, before = time.perf_counter(), os.times()
    with tempfile.TemporaryDirectory() as folder:
        files = ("--rig", str(SAMPLE / "rig.yaml"), "--object", str(SAMPLE / "object.csv"), "--out", f"{folder}/out")
        if imgcal(["calibrate", str(SAMPLE), *files]):
            raise SystemExit("the sample was not calibrated")
    after = os.times()
    return {
        "functions": count,
        "compiling_cpu_s": sum(by_module.values()),
        "cpu_s": after.user + after.system - before.user - before.system,
        "seconds": time.perf_counter() - started,
        "by_module": dict(sorted(by_module.items(), key=lambda item: -item[1])),
    }


def measure() -> dict[str, Any]:
    """Calibrate alone and helped, in new processes: with an empty cache, at once again, and with the complete cache."""
    rows = {}
    for name, helped in WAYS.items():
        with tempfile.TemporaryDirectory() as cache:
            for again in ("", ", at once again") if helped else ("",):
                rows[name + again] = _in_a_process(helped, cache)
            started = time.monotonic()
            while helped and not [*Path(cache).glob("complete-*")] and time.monotonic() < started + LONGEST:
                time.sleep(0.5)
            rows[name + ", later"] = _in_a_process(helped, cache)
    return {"cores": len(os.sched_getaffinity(0)), "rows": rows}


def _in_a_process(helped: bool, cache: str) -> dict[str, Any]:
    code = (
        f"import json; from scripts.benchmarks import compilation; print(json.dumps(compilation.calibrate({helped})))"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True)
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def table(result: Mapping[str, Any]) -> str:
    """Make the table, as Markdown."""
    head = ["", "functions compiled", "compiling, CPU s", "command, CPU s", "command, s"]
    keys = ("compiling_cpu_s", "cpu_s", "seconds")
    rows = [[name, str(row["functions"]), *(f"{row[key]:.1f}" for key in keys)] for name, row in result["rows"].items()]
    return markdown(head, rows)


@dataclass(frozen=True)
class Options:
    """Measure the first calibration: a minute on an idle machine."""

    out: Path = RESULT  #: file of the result


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    before = surroundings()
    write_json(options.out, before | measure())
    print(table(read_json(options.out)))


if __name__ == "__main__":
    command(main)
