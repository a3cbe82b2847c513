"""How long do `imgcal.calibrate` from labels and live updates take, compared with another checkout of imgcal?

Run as `python -m scripts.benchmarks.calibration_speed [--beside FOLDER]`. Both run in turn, for a tenth of a second
each, on one thread unless noted. CPU time is reported, because other processes affect it least.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from imgcal import Detections, RigidTransform, load_object, load_rig
from imgcal.geometry.rotations import rotation_from_vector
from imgcal.io import save_rig
from scripts.benchmarks.camera_faults import blobs, object_before_a_ring
from scripts.output import ROOT, command, fill, markdown, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "calibration_speed.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
WORKER = Path(__file__).with_name("calibration_speed_worker.py")
NOISE = 0.07  # px
CAPTURES = 12  # calibrated in turn: chance decides which checks a capture needs
STREAM = 40  # snapshots of a live stream, which is played forwards and backwards
HERE, THERE = "this checkout", "the other"
AT_ONCE = 0.1  # seconds per turn

TITLES = {
    "calibrate1": "calibrate, 1 labelled snapshot, O10",
    "calibrate20": "calibrate, 20 labelled snapshots, O10",
    "calibrate100": "calibrate, 100 labelled snapshots, O10",
    "live1": "update, window 1, O10",
    "live20": "update, window 20, O10",
    "wand1": "update, window 1, wand in a room",
    "wand5": "update, window 5, wand in a room",
    "wand20": "update, window 20, wand in a room",
    "live20 on 2": "update, window 20, O10, two threads",
    "wand20 on 2": "update, window 20, wand in a room, two threads",
}


def write_cases(folder: Path) -> None:
    """Write the worker's input files."""
    for snapshots in (1, 20, 100):
        captures = [
            blobs(object_before_a_ring(snapshots, seed)[-1], seed, clutter=0.0, labelled=True)
            for seed in range(1, CAPTURES + 1)
        ]
        first = np.arange(CAPTURES).repeat([len(capture) for capture in captures])
        columns = _columns(Detections.join(captures)) | {"capture": first}
        columns["snapshot"] = columns["snapshot"] % snapshots
        _write(folder, f"calibrate{snapshots}", ("O10", "asymmetric8", 0), columns)
    for name, rig, held, windows in (("live", "O10", "asymmetric8", (1, 20)), ("wand", "room10", "wand4", (1, 5, 20))):
        columns = carried(rig, held)
        for window in windows:
            _write(folder, f"{name}{window}", (rig, held, window), columns)


def _write(folder: Path, name: str, case: tuple[str, str, int], columns: Mapping[str, np.ndarray]) -> None:
    rig, obj = folder / f"{case[0]}.yaml", ROOT / "data" / "objects" / f"{case[1]}.csv"
    save_rig(replace(load_rig(case[0]), volume=None), rig)  # older checkouts cannot read a volume
    (folder / f"{name}.json").write_text(json.dumps({"rig": str(rig), "object": str(obj), "window": case[2]}))
    np.savez(folder / f"{name}.npz", **columns)  # type: ignore[arg-type]


def _columns(table: Detections) -> dict[str, np.ndarray]:
    names = ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
    return {name: getattr(table, name) for name in names}


def carried(rig_name: str, object_name: str, snapshots: int = STREAM) -> dict[str, np.ndarray]:
    """Move an object smoothly in front of a drifted rig: unlabelled blobs, as columns."""
    rig, obj, draw = load_rig(rig_name), load_object(object_name), np.random.default_rng(3)
    rig = rig.to(torch.float64)
    step = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
    step[:, :3] = torch.from_numpy(draw.normal(0, np.radians(0.2), (rig.num_cameras, 3)))
    step[:, 3:6] = torch.from_numpy(draw.normal(0, 2.0, (rig.num_cameras, 3)))
    true = rig.retract(step)
    in_room = rig_name == "room10"
    far = [1900.0, 1900.0, 850.0] if in_room else [25.0, 25.0, 40.0]
    turn = [2.0, 2.0, 3.0] if in_room else [0.25, 0.25, 0.4]
    middle = torch.tensor([0.0, 0.0, 1150.0 if in_room else float(rig.working_distance or 0.0)], dtype=torch.float64)
    phase, pace = draw.uniform(0, 6.28, 6), (0.02 if in_room else 0.05) * draw.uniform(0.6, 1.6, 6)
    sway = torch.from_numpy(np.sin(pace * np.arange(snapshots)[:, None] + phase))
    rotation = rotation_from_vector(sway[:, :3] * torch.tensor(turn, dtype=torch.float64))
    centre = middle + sway[:, 3:] * torch.tensor(far, dtype=torch.float64)
    poses = RigidTransform(rotation, centre - rotation @ obj.points.double().mean(0))
    seen = true.expand(snapshots).project(poses.apply(obj.points.double()), obj.radius)
    snapshot, camera, fiducial = np.nonzero(seen.visible.numpy())
    count = len(snapshot)
    return {
        "uv": seen.uv.numpy()[snapshot, camera, fiducial] + draw.normal(0, NOISE, (count, 2)),
        "sigma": np.full(count, NOISE),
        "camera": camera,
        "snapshot": snapshot,
        "fiducial": np.full(count, -1),
        "radius": np.full(count, np.nan),
        "flags": np.zeros(count, dtype=np.uint8),
    }


class Worker:
    """A separate process that runs the imgcal of a checkout."""

    def __init__(self, checkout: Path, folder: Path, threads: int) -> None:
        """Start the process."""
        surely = {"PYTHONPATH": str(checkout)} | {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "NUMBA")}
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(WORKER), str(folder), str(threads)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=checkout, env=os.environ | surely,
        )  # fmt: skip

    def run(self, case: str, seconds: float) -> list[float]:
        """CPU time of each call, ms."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(case, seconds, file=self._process.stdin, flush=True)
        return list(json.loads(self._process.stdout.readline()))

    def end(self) -> None:
        """End the process."""
        self._process.communicate()


def measure(checkouts: Mapping[str, Path], rounds: int, cases: tuple[str, ...]) -> dict[str, Any]:
    """Measure CPU times (ms) by case and checkout: median, mean and best."""
    with tempfile.TemporaryDirectory() as name:
        write_cases(Path(name))
        threads = {case: 2 if case.endswith(" on 2") else 1 for case in cases}
        pairs = [(title, count) for title in checkouts for count in sorted(set(threads.values()))]
        workers = {(title, count): Worker(checkouts[title], Path(name), count) for title, count in pairs}
        taken: dict[str, dict[str, list[float]]] = {case: {title: [] for title in checkouts} for case in cases}
        for number in range(rounds + 1):
            for case in cases:
                for title in checkouts:
                    times = workers[title, threads[case]].run(case.partition(" ")[0], AT_ONCE)
                    taken[case][title] += times if number else []  # the first round compiles
        for worker in workers.values():
            worker.end()
    return {
        case: {
            title: {"p50": float(np.median(ms)), "mean": float(np.mean(ms)), "best": min(ms), "calls": len(ms)}
            for title, ms in row.items()
        }
        for case, row in taken.items()
    }


def table(result: Mapping[str, Any]) -> str:
    """Make the table, as Markdown."""
    rows = []
    for case, row in result["cases"].items():
        here, there = row[HERE], row.get(THERE)
        cells = [TITLES[case], *(f"{here[key]:.3g}" for key in ("p50", "mean", "best"))]
        if there is not None:
            cells += [f"{there[key]:.3g}" for key in ("p50", "mean", "best")]
            cells += [f"{here[key] / there[key]:.2f}" for key in ("p50", "mean")]
        rows.append(cells)
    head = [
        "CPU time, ms",
        "median",
        "mean",
        "best",
        "the other: median",
        "mean",
        "best",
        "ratio of medians",
        "of means",
    ]
    return markdown(head if any(len(row) > 4 for row in rows) else head[:4], rows)


@dataclass(frozen=True)
class Options:
    """Time calibration and live updates."""

    beside: Path | None = None  #: another checkout to compare with
    revision: str = ""  #: name of that checkout, for the result
    rounds: int = 10
    cases: tuple[str, ...] = tuple(TITLES)
    out: Path | None = None  #: a result file; docs/benchmarks/calibration_speed.json rewrites its table in the page


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    before = surroundings() | {"threads": 1}
    checkouts = {HERE: ROOT} | ({} if options.beside is None else {THERE: options.beside.resolve()})
    result = before | {"other": options.revision, "cases": measure(checkouts, options.rounds, options.cases)}
    if options.out is not None:
        write_json(options.out, result)
    if options.out is not None and options.out.resolve() == RESULT:
        fill(PAGE, {"calibration speed": table(result)})
    print(table(result))


if __name__ == "__main__":
    command(main)
