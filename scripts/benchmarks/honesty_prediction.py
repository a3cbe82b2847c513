"""Does the predicted error of a rig match the true one? Ratios at held-out points of simulated captures.

Run as `python -m scripts.benchmarks.honesty_prediction`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from imgcal import InputError, PipelineOptions, RefusedError, calibrate, load_object, load_rig, predicted_error
from imgcal.evaluation.true_error import true_error
from imgcal.fleet import Mapper, StoredResults, workers
from imgcal.io import write_text
from imgcal.synthesis import PoseRange, Truth, simulate_volume, true_detections
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior
from scripts.output import ROOT, WORK, command, markdown, read_json, replaced, surroundings, write_json

RIGS = {"O10": "asymmetric8", "U7": "asymmetric8", "T4": "asymmetric8", "room10": "wand4"}
SNAPSHOTS = (1, 5, 20)
NOISE = 0.02  # px, each axis: of blobs
HELD_OUT = 100  # points, uniform in the working volume, at which each calibration is scored
GATE = (0.9, 1.1)  # permitted RMS of the ratios
RESULT = ROOT / "docs" / "benchmarks" / "honesty_prediction.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"


@dataclass(frozen=True)
class Case:
    """A kind of capture: drift from the rig's prior, an object within its tolerances, known labels."""

    rig: CameraRig  # factory calibration, with its prior
    obj: CalibrationObject
    snapshots: int
    noise: float = NOISE

    def draw(self, generator: torch.Generator) -> tuple[CameraRig, Detections]:
        """Draw a true rig and its detections."""
        rig, obj = self.rig, self.true_object(generator)
        prior_std = (rig.prior or RigPrior()).std(rig)
        true_rig = rig.retract(prior_std * torch.randn(prior_std.shape, generator=generator, dtype=prior_std.dtype))
        if rig.working_distance is None:
            truth = simulate_volume(true_rig, obj, self.snapshots, generator, None)
        else:
            centroid = obj.points.mean(0)
            poses = sample_rig_from_object(self.snapshots, rig.working_distance, centroid, PoseRange(), generator)
            seen = true_rig.expand(self.snapshots).project(poses.apply(obj.points), obj.radius)
            truth = Truth(true_rig, poses, seen.uv, seen.visible)
        table = true_detections(truth)
        noise = torch.randn(table.uv.shape, generator=generator, dtype=torch.float64).numpy()
        return true_rig, replace(table, uv=table.uv + self.noise * noise, sigma=np.full(len(table), self.noise))

    def true_object(self, generator: torch.Generator) -> CalibrationObject:
        """Draw a true object within the tolerances."""
        obj = self.obj
        if obj.exact:
            return obj
        tolerance = torch.zeros(obj.num_fiducials) if obj.tolerance is None else obj.tolerance
        shift = tolerance[:, None] * torch.randn(obj.points.shape, generator=generator, dtype=obj.points.dtype)
        scale = 1 + obj.scale_tolerance * torch.randn(1, generator=generator, dtype=obj.points.dtype)
        return replace(obj, points=scale * obj.points + shift)


def judge(case: Case, captures: int, seed: int, options: PipelineOptions) -> dict[str, Any]:
    """Calibrate captures, and compare true and predicted errors at held-out points.

    Returns:
        For px and mm: RMS over captures and points of the true error over the predicted one (`ratio`), its standard
        error (`ratio_std`), and the median predicted error; `refused`, captures without a result.
    """
    generator = torch.Generator().manual_seed(seed)
    squares: dict[str, list[float]] = {"px": [], "mm": []}
    sizes: dict[str, list[float]] = {"px": [], "mm": []}
    refused = 0
    for _ in range(captures):
        truth, table = case.draw(generator)
        shares = torch.rand(HELD_OUT, 3, generator=generator, dtype=torch.float64)
        try:
            predicted = predicted_error(calibrate(table, case.rig, case.obj, options).estimate)
        except RefusedError:
            refused += 1
            continue
        volume, uncertainty = predicted.volume, predicted.uncertainty
        points = torch.lerp(volume.low, volume.high, shares)
        seen = uncertainty.rig.project(points).visible
        expected = (uncertainty.pixel_error(points), uncertainty.point_error(points, seen))
        for unit, true, stated in zip(squares, true_error(uncertainty, truth, points), expected, strict=True):
            ratio = (true / stated).square()
            squares[unit].append(float(ratio[ratio.isfinite()].mean()))
        sizes["px"].append(predicted.median_px)
        sizes["mm"].append(predicted.median_mm)
    return {"captures": captures, "refused": refused} | {
        unit: _ratio(np.array(squares[unit])) | {"median": float(np.nanmedian(sizes[unit]))} for unit in squares
    }


def _ratio(squares: np.ndarray) -> dict[str, float]:
    squares = squares[np.isfinite(squares)]
    ratio = float(np.sqrt(squares.mean()))
    return {"ratio": ratio, "ratio_std": float(squares.std() / np.sqrt(len(squares)) / (2 * ratio))}


def _row(item: tuple[str, str, int, int, int]) -> dict[str, Any]:
    rig, obj, snapshots, captures, seed = item
    options = PipelineOptions(blind_cameras=True)  # in one snapshot, not every camera sees the wand
    return judge(Case(load_rig(rig), load_object(obj), snapshots), captures, seed, options)


def measure(
    captures: int = 200,
    snapshots: Sequence[int] = SNAPSHOTS,
    rigs: Mapping[str, str] = RIGS,
    seed: int = 1,
    mapped: Mapper = map,
) -> dict[str, Any]:
    """Run all rigs and numbers of snapshots: rig -> snapshots -> result of `judge`."""
    items = [
        (rig, obj, count, captures, seed + 1000 * number + count)
        for number, (rig, obj) in enumerate(rigs.items())
        for count in snapshots
    ]
    rows: dict[str, Any] = {}
    for (rig, _, count, *_), row in zip(items, mapped(_row, items), strict=True):
        rows.setdefault(rig, {})[str(count)] = row
        print(rig, count, row, file=sys.stderr, flush=True)
    return {"noise_px": NOISE, "held_out_points": HELD_OUT, "gate": list(GATE), "rigs": rows}


def table(result: Mapping[str, Any]) -> str:
    """Make the table, as Markdown."""
    head = ["rig", "snapshots", "median predicted, px", "true / predicted", "median predicted, mm", "true / predicted"]
    rows = []
    for rig, sizes in result["rigs"].items():
        for count, row in sizes.items():
            cells = [f"{row[u]['median']:.2g}|{row[u]['ratio']:.2f} ± {row[u]['ratio_std']:.2f}" for u in ("px", "mm")]
            rows.append([rig, count, *"|".join(cells).split("|")])
    return markdown(head, rows)


@dataclass(frozen=True)
class Options:
    """Compare predicted with true errors over simulated captures."""

    captures: int = 200
    snapshots: tuple[int, ...] = SNAPSHOTS
    rigs: tuple[str, ...] = tuple(RIGS)
    address: str | None = None  #: running Ray cluster to run on; None = this machine
    cores: int | None = None  #: of this machine; 1 = this process alone; None = all
    out: Path = RESULT  #: only this path also rewrites the table in docs/benchmarks/tables.md


def main() -> None:
    """Measure, write and print.

    Raises:
        InputError: unknown rig.
    """
    options = tyro.cli(Options, description=__doc__)
    if unknown := [name for name in options.rigs if name not in RIGS]:
        raise InputError(f"--rigs: found {', '.join(unknown)}, expected some of {', '.join(RIGS)}")
    began, before, kept = (
        time.monotonic(),
        surroundings(),
        StoredResults(WORK / "honesty_prediction", Path(__file__).read_text("utf-8")),
    )
    with workers(options.address, options.cores, kept) as mapped:
        chosen = {name: RIGS[name] for name in options.rigs}
        result = measure(options.captures, options.snapshots, chosen, mapped=mapped)
    write_json(options.out, before | {"seconds": round(time.monotonic() - began)} | result)
    kept.clear()
    if options.out.resolve() == RESULT:
        page = replaced(PAGE.read_text("utf-8"), {"honesty prediction": table(read_json(RESULT))}, PAGE)
        write_text(PAGE, page)
    print(table(result))


if __name__ == "__main__":
    command(main)
