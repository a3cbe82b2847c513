"""How good is a calibration from scratch? Compares it with one from a factory calibration, COLMAP and OpenCV.

Run as `python -m scripts.benchmarks.from_scratch`. Captures of IMGCAL_CAPTURES are included if it is set.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro

from imgcal.association import to_observations
from imgcal.detection import DetectionOptions, detect
from imgcal.errors import InputError, RefusedError
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, object_from_text, open_capture, read_frame
from imgcal.pipeline import calibrate, calibrate_from_scratch, score
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior
from scripts.benchmarks.from_scratch_cases import Case, make_case, point_errors
from scripts.benchmarks.peer import peer
from scripts.benchmarks.peers import colmap_from_scratch, opencv_multiview
from scripts.benchmarks.peers.rig_task import RigAnswer
from scripts.output import ROOT, command, fill, markdown, read_json, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "from_scratch.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
FACTORY, LABELS, BLOBS = "imgcal from the factory", "imgcal from scratch", "imgcal from scratch, blobs"
COLMAP, OPENCV = "COLMAP incremental mapping", "OpenCV calibrateMultiview"
SLOW = (BLOBS, OPENCV)
GATE = 1.1
"""Limit of the geometric mean of the errors from scratch, relative to those from the factory calibration."""
WRONG = 2.0
"""Multiple of the error from the factory calibration above which a result is wrong."""
OPENCV_SNAPSHOTS = 40
"""Snapshots for OpenCV: its time grows faster than linearly."""
COARSE = 0.02  # mm, least error of a wrong result

Solver = Callable[[Case], CameraRig]


def solvers() -> dict[str, Solver]:
    """All methods."""

    def by_peer(solve: Callable[..., RigAnswer], snapshots: int | None) -> Solver:
        def run(case: Case) -> CameraRig:
            seen = to_observations(case.labelled, case.cameras, case.obj)
            uv, mask = seen.uv[:snapshots].numpy(), seen.seen[:snapshots].numpy()
            cameras = case.cameras
            found = solve(uv, mask, case.obj.points.numpy(), cameras.focal_length.numpy(), cameras.image_size.numpy())
            parts = (found.focal_length, found.principal_point, found.distortion, found.rotation, found.translation)
            focal, centre, distortion, rotation, translation = map(torch.from_numpy, parts)
            places = RigidTransform(rotation, translation)
            return replace(
                cameras, focal_length=focal, principal_point=centre, distortion=distortion, cam_from_rig=places
            )

        return run

    found: dict[str, Solver] = {
        FACTORY: lambda case: calibrate(case.labelled, case.factory, case.obj).rig,
        LABELS: lambda case: calibrate_from_scratch(case.labelled, case.cameras, case.obj).rig,
        BLOBS: lambda case: calibrate_from_scratch(case.blobs, case.cameras, case.obj).rig,
    }
    if peer("pycolmap"):
        found[COLMAP] = by_peer(colmap_from_scratch.solve, None)
    if hasattr(cv2, "calibrateMultiview"):
        found[OPENCV] = by_peer(opencv_multiview.solve, OPENCV_SNAPSHOTS)
    return found


def judge(case: Case, solve: Solver) -> dict[str, Any]:
    """Calibrate one case with one method, and score the result."""
    began = time.perf_counter()
    try:
        rig = solve(case)
        error = point_errors(rig, case.truth.rig, case.volume)
    except RefusedError as reason:
        return {"outcome": "refused", "reason": reason.for_command, "seconds": time.perf_counter() - began}
    except (cv2.error, ValueError, RuntimeError, np.linalg.LinAlgError) as fault:
        return {
            "outcome": "gave up",
            "reason": " ".join(str(fault).split())[-120:],
            "seconds": time.perf_counter() - began,
        }
    seconds, median = time.perf_counter() - began, float(np.median(error))
    return {"outcome": "answered", "median_mm": median, "p95_mm": float(np.quantile(error, 0.95)), "seconds": seconds}


def measure(rigs: range, snapshots: int, slow_ones: int = 1, peers: bool = True) -> list[dict[str, Any]]:
    """Run all methods on rigs with these numbers, those of `SLOW` only on every `slow_ones`-th."""
    rows = []
    for number in rigs:
        case = make_case(number, snapshots)
        row: dict[str, Any] = {"case": case.name, "cameras": case.cameras.num_cameras, "methods": {}}
        for name, solve in solvers().items():
            if (name in SLOW and number % slow_ones) or not (peers or name.startswith("imgcal")):
                continue
            row["methods"][name] = judge(case, solve)
            print(case.name, name, row["methods"][name], file=sys.stderr, flush=True)
        rows.append(row)
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Compare the results of each method with those from the factory calibration."""
    found = {}
    for name in rows[0]["methods"]:
        tried = [row["methods"] for row in rows if name in row["methods"]]
        answers, base = [methods[name] for methods in tried], [methods[FACTORY] for methods in tried]
        pairs = [(a, b) for a, b in zip(answers, base, strict=True) if "median_mm" in a and "median_mm" in b]
        ratios = np.array([[a[key] / b[key] for key in ("median_mm", "p95_mm")] for a, b in pairs]).reshape(-1, 2)
        wrong = [a["median_mm"] > max(WRONG * b["median_mm"], COARSE) for a, b in pairs]
        found[name] = {
            "rigs": len(answers),
            "good": len(pairs) - sum(wrong),
            "wrong": sum(wrong),
            "refused": sum(a["outcome"] != "answered" for a in answers),
            "median_mm": float(np.median([a["median_mm"] for a, _ in pairs])) if pairs else None,
            "ratio": float(np.exp(np.log(ratios[:, 0]).mean())) if pairs else None,
            "ratio_p95": float(np.exp(np.log(ratios[:, 1]).mean())) if pairs else None,
            "seconds": float(np.median([a["seconds"] for a in answers])),
        }
    return found


def on_captures(folder: Path) -> dict[str, Any]:
    """Real frames: calibrate from half of the views and score on the others, or say why this failed."""
    found = {}
    for name, run in (("dot-grid-10x10", _dot_grid), ("cavity-two-cameras", _cavity), ("three-cameras-dots", _dots)):
        try:
            found[name] = run(folder / name)
        except RefusedError as reason:
            found[name] = {"outcome": "refused", "reason": reason.for_command}
        print(name, found[name], file=sys.stderr, flush=True)
    return found


def _dot_grid(folder: Path) -> dict[str, Any]:
    """One camera, fifteen views of a flat grid."""
    rows = [f"{25.4 * x:.6g},{25.4 * y:.6g},0" for y in range(10) for x in range(10)]
    obj = object_from_text("\n".join(["x,y,z", *rows, ""]), "grid")
    cameras = _cameras({"cam": (640, 480)}, 550.0)
    files = sorted((folder / "frames").glob("*.png"))
    blobs = detect({"cam": [read_frame(file) for file in files]}, DetectionOptions(polarity="dark"))
    even, odd = (blobs.select(blobs.snapshot % 2 == half) for half in (0, 1))
    factory = replace(cameras, prior=RigPrior(0.02, 10.0, 0.05, 0.01, 10.0))
    rigs = {FACTORY: calibrate(even, factory, obj).rig, BLOBS: calibrate_from_scratch(even, cameras, obj).rig}
    held_out = {name: _rms(odd, rig, obj) for name, rig in rigs.items()}
    return {"outcome": "answered", "held_out_rms_px": held_out}


def _rms(blobs: Detections, rig: CameraRig, obj: CalibrationObject) -> float:
    return float(score(blobs, rig, obj).distances.square().mean().sqrt())


def _cavity(folder: Path) -> dict[str, Any]:
    """Two cameras and one snapshot, the object among thousands of particles."""
    return _from_frames(folder, {"cam3": (1280, 1024), "cam4": (1280, 1024)})


def _dots(folder: Path) -> dict[str, Any]:
    """Three cameras and one snapshot, through the walls of a tank."""
    return _from_frames(folder, {f"cam{number}": (1280, 1024) for number in (1, 2, 3)})


def _from_frames(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    cameras = _cameras(sizes, 5000.0)
    obj = load_object(folder / "object.csv")
    found = calibrate_from_scratch(_series(folder, cameras), cameras, obj)
    return {"outcome": "answered", "rms_px": float(found.rms)}


def _cameras(sizes: Mapping[str, tuple[int, int]], focal: float) -> CameraRig:
    """Make cameras with approximately known focal length (px)."""
    count, like, size = len(sizes), torch.float64, torch.tensor(list(sizes.values()))
    lens = (torch.full((count, 2), focal, dtype=like), (size - 1).to(like) / 2, torch.zeros(count, 5, dtype=like))
    places, spread = RigidTransform.identity(count, dtype=like), RigPrior(0.15, 0.02 * float(size.max()), 0.1, 1.0, 1e6)
    return CameraRig(*lens, places, size, tuple(sizes), prior=spread)


def _series(folder: Path, rig: CameraRig) -> dict[str, list[Any]]:
    frames: dict[str, list[Any]] = {name: [] for name in rig.camera_names}
    for _, some in open_capture(folder, rig).snapshots():
        for name, frame in some.items():
            frames[name].append(frame)
    return frames


def tables(result: Mapping[str, Any]) -> str:
    """Make the text of the page: simulated rigs, then real frames."""
    head = [
        "",
        "rigs",
        "good",
        "wrong",
        "refused or gave up",
        "error, mm",
        "error / with factory",
        "the same, 95 % quantile",
        "s",
    ]
    rows = []
    for name, row in result["summary"].items():
        cells = [row[key] for key in ("rigs", "good", "wrong", "refused")]
        cells += [
            "–" if row[key] is None else f"{row[key]:.3g}" for key in ("median_mm", "ratio", "ratio_p95", "seconds")
        ]
        rows.append([name, *map(str, cells)])
    lines = [markdown(head, rows)]
    for name, row in result.get("captures", {}).items():
        said = row.get("reason") or row.get("held_out_rms_px") or f"{row['rms_px']:.2f} px"
        if isinstance(said, Mapping):
            said = ", ".join(f"{method} {rms:.3f} px" for method, rms in said.items()) + " (RMS, held-out views)"
        lines.append(f"\n{name}: {row['outcome']}: {said}.")
    return "\n".join(lines)


@dataclass(frozen=True)
class Options:
    """Calibrate simulated rigs, and real frames, without a factory calibration."""

    rigs: int = 20
    first: int = 20  #: number of the first rig; rigs 0 to 19 were used to choose settings
    snapshots: int = 300
    peers: bool = True  #: also measure COLMAP and OpenCV
    slow_ones: int = 1  #: run OpenCV, and blobs without labels, only on every n-th rig
    only_frames: bool = False  #: keep the simulated rigs of `out`, and only calibrate from the real frames again
    out: Path = RESULT  #: only this path also rewrites the table in docs/benchmarks/tables.md


def main() -> None:
    """Measure, write and print.

    Raises:
        InputError: no rigs.
    """
    options = tyro.cli(Options, description=__doc__)
    if min(options.rigs, options.snapshots, options.slow_ones, options.first + 1) < 1:
        found = f"{options.rigs} rigs, {options.snapshots} snapshots, {options.slow_ones}"
        raise InputError(f"found {found}, expected one or more of each")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if options.only_frames:
        result = read_json(options.out) | {"captures": on_captures(Path(os.environ["IMGCAL_CAPTURES"]))}
    else:
        began, before = time.monotonic(), surroundings()
        numbers = range(options.first, options.first + options.rigs)
        rows = measure(numbers, options.snapshots, options.slow_ones, options.peers)
        result = before | {"snapshots": options.snapshots, "gate": GATE, "summary": summary(rows), "rigs": rows}
        with suppress(KeyError):
            result["captures"] = on_captures(Path(os.environ["IMGCAL_CAPTURES"]))
        result["seconds"] = round(time.monotonic() - began)
    write_json(options.out, result)
    if options.out.resolve() == RESULT:
        fill(PAGE, {"from scratch": tables(read_json(RESULT))})
    print(tables(result))


if __name__ == "__main__":
    command(main)
