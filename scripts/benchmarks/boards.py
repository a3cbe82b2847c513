"""Real captures of printed boards: held-out errors with and without the bend, compared with other calibrations.

Run as `python -m scripts.benchmarks.boards`; writes docs/benchmarks/boards.json. Needs IMGCAL_CAPTURES. Rigs are fitted
on odd snapshots and scored on even ones unless noted: poses by plain least squares, RMS over all points.
"""

from __future__ import annotations

import csv
import gzip
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from imgcal.association import accepted_observations, associate
from imgcal.detection import detect
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import EstimationOptions, estimate
from imgcal.formats import load_rig
from imgcal.io import load_detections, load_object, read_frame
from imgcal.pipeline import calibrate
from imgcal.types import Board, CalibrationObject, CameraRig, Detections
from scripts.output import ROOT, command, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "boards.json"
MRCAL_SIGMA = 0.3  # px, sigma of a corner of weight one
PLAIN = EstimationOptions(threshold=1e6)


def held_out(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> dict[str, float]:
    """Fit only the poses by least squares; return the errors (px) of all points."""
    observations, poses = accepted_observations(associate(detections, rig, obj), rig, obj)
    even = replace(observations, sigma=torch.ones_like(observations.sigma))
    fixed = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
    fit = estimate(even, rig, obj.as_exact(), poses, prior_std=fixed, options=PLAIN)
    distance = fit.residual.norm(dim=-1)[observations.seen]
    return {"rms": float(distance.square().mean().sqrt()), "median": float(distance.median()), "n": len(distance)}


def part(detections: Detections, parity: int) -> Detections:
    """Keep the snapshots whose names are odd or even numbers."""
    chosen = [k for k, name in enumerate(detections.snapshot_names) if int(name) % 2 == parity]
    number = np.full(len(detections.snapshot_names), -1)
    number[chosen] = np.arange(len(chosen))
    some = detections.select(number[detections.snapshot] >= 0)
    names = tuple(detections.snapshot_names[k] for k in chosen)
    return replace(some, snapshot=number[some.snapshot], snapshot_names=names)


def large_board(folder: Path, work: Path) -> dict[str, Any]:
    """One camera, 186 views of a board that is bent by a millimetre."""
    rig = replace(load_rig(folder / "opencv8.cameramodel"), camera_names=("camera",))
    lines = ["snapshot,camera,u,v,sigma,fiducial"]
    with gzip.open(folder / "detections.csv.gz", "rt") as file:
        for row in csv.DictReader(file):
            if (weight := float(row["weight"])) > 0:
                lines += [f"{row['snapshot']},camera,{row['u']},{row['v']},{MRCAL_SIGMA / weight},{row['fiducial']}"]
    path = work / "board-186-views.csv"
    path.write_text("\n".join(lines))
    seen, result = load_detections(path, rig), {}
    for name, warp in (("flat", 0.0), ("bend estimated", None)):
        obj = CalibrationObject.of_board(Board("checkerboard", 11, 11, 77.0, warp=warp))
        found = calibrate(part(seen, 1), rig, obj)
        bend = None if found.bend is None else vars(found.bend)
        result[name] = {"even": held_out(part(seen, 0), found.rig, found.object.as_exact()), "bend_mm": bend}
    return result


def webcams(folder: Path) -> dict[str, Any]:
    """Four webcams without a common clock."""
    rig = load_rig(folder / "camera_array.toml")
    rig = replace(rig, camera_names=tuple(f"cam_{name}" for name in rig.camera_names))
    obj = load_object(folder / "object.csv")
    seen = load_detections(folder / "detections.csv", rig, obj.rows)
    result: dict[str, Any] = {"caliscope": {"all": held_out(seen, rig, obj), "even": held_out(part(seen, 0), rig, obj)}}
    found = calibrate(seen, rig, obj)
    even = held_out(part(seen, 0), found.rig, obj)
    result["imgcal, all snapshots"] = {"all": held_out(seen, found.rig, obj), "even": even}
    result["limited by"] = str(found.unsynchronized)
    try:
        found = calibrate(part(seen, 1), rig, obj)
        result["imgcal, odd snapshots"] = {"even": held_out(part(seen, 0), found.rig, obj)}
    except RefusedError as error:
        result["imgcal, odd snapshots"] = {"refused": str(error)}
    board = CalibrationObject.of_board(Board("charuco", 4, 5, 54.0, 40.5, "DICT_4X4_1000", inverted=True))
    known = {
        (seen.snapshot_names[s], seen.camera_names[c], n): uv
        for s, c, n, uv in zip(seen.snapshot, seen.camera, seen.fiducial, seen.uv, strict=True)
    }
    apart, sigma = [], []
    for path in sorted((folder / "frames").glob("*.jpg")):
        number, _, camera = path.stem.split("_")
        corners = detect({"frame": read_frame(path)}, board=board.board)
        sigma += corners.sigma.tolist()
        for uv, n in zip(corners.uv, corners.fiducial.tolist(), strict=True):
            there = known.get((str(int(number)), f"cam_{camera}", n))
            apart += [] if there is None else [float(np.linalg.norm(uv - there))]
    result["corners of 14 frames"] = {
        "common": len(apart),
        "rms_to_published_px": float(np.sqrt(np.square(apart).mean())),
        "sigma_px": float(np.median(sigma)),
    }
    return result


@dataclass(frozen=True)
class Options:
    """Measure real captures of printed boards."""

    out: Path = RESULT


def main() -> None:
    """Measure, and write the results.

    Raises:
        InputError: no captures.
    """
    options = tyro.cli(Options, description=__doc__)
    folder = os.environ.get("IMGCAL_CAPTURES")
    if not folder:
        raise InputError("IMGCAL_CAPTURES: found nothing, expected the folder of the captures")
    captures, work = Path(folder), ROOT / "out" / "work"
    work.mkdir(parents=True, exist_ok=True)
    figures = {
        "board-186-views": large_board(captures / "board-186-views", work),
        "charuco-four-cameras": webcams(captures / "charuco-four-cameras"),
    }
    write_json(options.out, {**surroundings(), "unit": "px", **figures})


if __name__ == "__main__":
    command(main)
