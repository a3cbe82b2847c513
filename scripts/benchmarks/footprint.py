"""A user's first impression: start-up time of commands, memory of a calibration, installed megabytes."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from scripts.benchmarks.effort import Effort
from scripts.output import BLUE, GREY, ROOT, figure, markdown
from scripts.timing import timing_of

SAMPLE = ROOT / "data" / "samples" / "O10"
IMGCAL = (sys.executable, "-m", "imgcal")
PYTHON = (sys.executable, "-c")
COMMANDS = {
    "imgcal --help": (*IMGCAL, "--help"),
    "imgcal calibrate --help": (*IMGCAL, "calibrate", "--help"),
    "imgcal calibrate, an argument is missing": (*IMGCAL, "calibrate", str(SAMPLE)),
    "import imgcal": (*PYTHON, "import imgcal"),
    "python alone": (*PYTHON, "pass"),
    "python, import cv2 and scipy.optimize": (*PYTHON, "import cv2, scipy.optimize"),
    "python, import torch": (*PYTHON, "import torch"),
}
CALIBRATE = "imgcal calibrate, the sample capture"
MEMORY = (CALIBRATE, "imgcal calibrate --help", "python, import torch", "python alone")
LARGEST = 8
"""Packages with their own row in the table of installed sizes."""


def measure(effort: Effort) -> dict[str, Any]:
    """Run commands in turn, each in a new process, and add up the installed sizes."""
    rounds = effort.pick(7, 1)
    chosen = COMMANDS if effort.pick(1, 0) else {name: COMMANDS[name] for name in ("imgcal --help", "python alone")}
    seconds: dict[str, list[float]] = {name: [] for name in chosen}
    for name in chosen:  # one uncounted run, to load files into the page cache
        _run(chosen[name])
    for _ in range(rounds):
        for name, command in chosen.items():
            seconds[name].append(_run(command)[0])
    with tempfile.TemporaryDirectory() as folder:
        sample = [*IMGCAL, "calibrate", str(SAMPLE), "--rig", str(SAMPLE / "rig.yaml")]
        sample += ["--object", str(SAMPLE / "object.csv"), "--out", folder]
        commands = {**chosen, CALIBRATE: sample} if effort.pick(1, 0) else chosen
        memory = {name: {"memory_mb": _run(commands[name])[1]} for name in MEMORY if name in commands}
    return {
        "start-up": {name: timing_of(taken).values() for name, taken in seconds.items()},
        "memory": memory,
        "installed": installed(),
    }


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables of start-up, memory, and the largest installed packages."""
    start = [
        (
            name,
            f"{row['p50']:.0f}",
            f"{row['best']:.0f}",
            f"{row['p50'] / result['start-up']['python alone']['p50']:.1f}",
        )
        for name, row in result["start-up"].items()
    ]
    memory = [(name, f"{row['memory_mb']:.0f}") for name, row in result["memory"].items()]
    sizes = result["installed"]
    parts = sorted(sizes["packages"].items(), key=lambda part: -part[1]["megabytes"])
    rest = sum(part["megabytes"] for _, part in parts[LARGEST:])
    rows = [(name, f"{part['megabytes']:.1f}") for name, part in parts[:LARGEST]]
    rows += [("everything else", f"{rest:.1f}"), ("imgcal", f"{sizes['imgcal']['megabytes']:.1f}")]
    rows += [("**a core install**", f"**{sizes['core']['megabytes']:.0f}**")]
    return {
        "footprint start-up": markdown(("command", "ms", "best, ms", "times Python alone"), start),
        "footprint memory": markdown(("command", "peak memory, MB"), memory),
        "footprint installed": markdown(("package", "MB"), rows),
    }


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw start-up times as bars."""
    with figure(path, size=(7.0, 2.6)) as (axes,):
        rows = list(reversed(result["start-up"].items()))
        colours = [BLUE if "imgcal" in name else GREY for name, _ in rows]
        axes.barh([name for name, _ in rows], [row["p50"] for _, row in rows], color=colours)
        axes.set_xlabel("ms")


LAUNCHER = """import os, sys
begin, null = __import__("time").perf_counter(), os.open(os.devnull, os.O_WRONLY)
files = [(os.POSIX_SPAWN_DUP2, null, 1), (os.POSIX_SPAWN_DUP2, null, 2)]
_, _, usage = os.wait4(os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ, file_actions=files), 0)
print(__import__("time").perf_counter() - begin, usage.ru_maxrss)
"""
"""Starts a command; if this process did, the system would count its memory as the command's."""


def _run(command: Sequence[str]) -> tuple[float, float]:
    """Run a command, discarding its output: wall time in seconds, and peak memory in MB."""
    launched = subprocess.run([*PYTHON, LAUNCHER, *command], cwd=ROOT, capture_output=True, text=True, check=True)
    seconds, most = launched.stdout.split()
    return float(seconds), float(most) / (1024**2 if sys.platform == "darwin" else 1024)


def installed() -> dict[str, Any]:
    """Megabytes of imgcal's own files, of each package in a core install, and in total."""
    packages = {name: {"megabytes": _megabytes(found)} for name, found in sorted(needed("imgcal").items())}
    own = sum(_folder(ROOT / part) for part in ("imgcal", "renderers", "data"))
    total = own + sum(part["megabytes"] for part in packages.values())
    return {"imgcal": {"megabytes": own}, "core": {"megabytes": total}, "packages": packages}


def needed(name: str) -> dict[str, Distribution]:
    """Collect a package's dependencies, recursively, without extras."""
    found: dict[str, Distribution] = {}
    waiting = list(_requirements(distribution(name)))
    while waiting:
        one = waiting.pop()
        if one in found:
            continue
        try:
            found[one] = distribution(one)
        except PackageNotFoundError:  # for another system
            continue
        waiting += _requirements(found[one])
    return found


def _requirements(of: Distribution) -> Iterator[str]:
    for requirement in of.requires or ():
        words = re.match(r"[\w.-]+", requirement)
        if words is not None and "extra ==" not in requirement:
            yield re.sub(r"[-_.]+", "-", words[0]).lower()


def _megabytes(of: Distribution) -> float:
    places = (Path(str(of.locate_file(file))) for file in of.files or () if file.suffix != ".pyc")
    return sum(place.stat().st_size for place in places if place.is_file()) / 1e6


def _folder(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file() and file.suffix != ".pyc") / 1e6
