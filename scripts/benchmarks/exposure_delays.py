"""Cameras that expose at other times: how good are calibrations with and without the correction of delays?

Run as `python -m scripts.benchmarks.exposure_delays`: some minutes on one core. Ten simulated cameras see a moving body
for three seconds, without labels. Other errors, which are no delays, must not be taken for some.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import imgcal
from imgcal.evaluation.detectors import judge
from imgcal.types import CameraRig, Detections
from scripts.benchmarks.lights import normalized_error
from scripts.benchmarks.rig_streams import Conditions, Stream
from scripts.output import ROOT, command, markdown, publish, surroundings

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "exposure_delays.json", ROOT / "docs" / "method.md"
RATE, COUNT = 20.0, 60
CONDITIONS = Conditions(rate=RATE, clutter=0.2, hidden=0.1)
DELAYS = {
    "together": ("none", 0.0),
    "one camera late by 0.02 of an interval": ("one", 0.02),
    "one camera late by 0.1": ("one", 0.1),
    "all differ, by 0.02 at most": ("all", 0.02),
    "all differ, by 0.1 at most": ("all", 0.1),
    "one clock runs away, from 0.05 to 0.15": ("drift", 0.1),
    "random, 0.03 (standard deviation)": ("random", 0.03),
}
"""How exposure times differ, and by what share of the interval between snapshots."""
OTHER = {
    "0.3 px of noise more than stated": replace(CONDITIONS, noisy=0.3),
    "0.2 px of unmodelled lens errors": replace(CONDITIONS, lens=0.2),
    "0.2 px of shaking": replace(CONDITIONS, shake=0.2),
}
"""Errors of cameras that expose together."""
FEW = "one camera late by 0.1, twelve snapshots"


@dataclass(frozen=True)
class Options:
    """Calibrate with and without the correction of delays."""

    seeds: int = 12
    out: Path = RESULT
    page: Path = PAGE


def delays_of(kind: str, size: float, cameras: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Delay of each camera in each snapshot, as a share of the interval: (S, C)."""
    if kind == "random":
        return size * rng.standard_normal((COUNT, cameras))
    late = np.zeros(cameras)
    if kind == "drift":
        late = np.zeros((COUNT, cameras))
        late[:, rng.integers(cameras)] = np.linspace(0.5 * size, 1.5 * size, COUNT)
    elif kind == "one":
        late[rng.integers(cameras)] = size
    elif kind == "all":
        late = rng.permutation(np.linspace(0.0, size, cameras))
    return np.broadcast_to(late, (COUNT, cameras))


def capture(conditions: Conditions, kind: str, size: float, seed: int) -> tuple[Detections, CameraRig]:
    """Simulate a capture; also return the true rig."""
    made = Stream(imgcal.load_rig("O10"), imgcal.load_object("asymmetric8"), seed, replace(conditions, labelled=True))
    late = torch.from_numpy(delays_of(kind, size, made.rig.num_cameras, np.random.default_rng(seed)).copy())
    parts = []
    for number in range(COUNT):
        now = made.snapshot(number)
        at_once = made.rig.project_values(made.pose_at(number / RATE)[0].apply(made.obj.points)).uv
        moments = made.poses_at((number + late[number]) / RATE).apply(made.obj.points)
        later = torch.stack([made.rig.project_values(points).uv[c] for c, points in enumerate(moments)])
        moved, known = (later - at_once).numpy(), now.fiducial >= 0
        uv = now.uv.copy()
        uv[known] += moved[now.camera[known], now.fiducial[known]]
        parts.append(replace(now, uv=uv, fiducial=np.full(len(now), -1)))
    return Detections.join(parts), made.rig


@contextmanager
def correcting(does: bool) -> Iterator[None]:
    """Correct delays in the block, or not."""
    with patch("imgcal.pipeline.recalibration.find_delays", lambda *_: None) if not does else patch.dict({}):
        yield


def calibrated(blobs: Detections, truth: CameraRig, corrects: bool) -> dict[str, Any]:
    """Calibrate and compare with the truth."""
    rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    with correcting(corrects):
        try:
            result = imgcal.calibrate(blobs, rig, obj)
        except imgcal.RefusedError as error:
            return {"refused": str(error)}
    wrong, rms, worst, claimed = judge(result, truth)
    delays = None if result.delays is None else result.delays.snapshots
    nees = normalized_error(result.estimate, truth)
    return {"delays": delays, "nees": nees, "rms_px": rms, "p95_px": worst, "claimed_p95_px": claimed, "wrong": wrong}


def measure(seeds: int) -> dict[str, Any]:
    """Run all captures."""
    cases = {name: (CONDITIONS, *how) for name, how in DELAYS.items()}
    cases |= {FEW: (CONDITIONS, "one", 0.1)}
    cases |= {name: (conditions, "none", 0.0) for name, conditions in OTHER.items()}
    found: dict[str, Any] = {"seeds": seeds, **surroundings(), "cases": {}}
    for name, (conditions, kind, size) in cases.items():
        runs = []
        for seed in range(seeds):
            blobs, truth = capture(conditions, kind, size, seed)
            blobs = blobs.of_snapshots(0, 12) if name == FEW else blobs
            runs.append({"with": calibrated(blobs, truth, True), "without": calibrated(blobs, truth, False)})
        found["cases"][name] = runs
        print(name, *_cells(runs), sep=" | ", flush=True)
    return found


def _cells(runs: list[dict[str, Any]]) -> list[str]:
    cells = [str(sum(run["with"].get("delays") is not None for run in runs))]
    for arm in ("with", "without"):
        done = [run[arm] for run in runs if "refused" not in run[arm]]
        cells.append(str(len(runs) - len(done)))
        cells.append(f"{median(one['rms_px'] for one in done):.3f}" if done else "-")
        nees = [one["nees"] for one in done]
        cells.append(f"{fmean(nees):.2f} ({max(nees):.2f})" if done else "-")
    return cells


def table(result: dict[str, Any]) -> str:
    """Make the page's table."""
    head = ("exposures", "delays found", "refused", "RMS, px", "NEES (worst)", "refused without", "RMS", "NEES (worst)")
    return markdown(head, [[name, *_cells(runs)] for name, runs in result["cases"].items()])


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    result = measure(options.seeds)
    publish(result, options.out, RESULT, options.page, "exposure delays", table(result))


if __name__ == "__main__":
    command(main)
