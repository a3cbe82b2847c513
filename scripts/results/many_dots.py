"""Compare detectors on targets of many small dots, real and simulated.

`IMGCAL_CAPTURES=... python -m scripts.results.many_dots` rewrites `docs/results/many-dots.json` and the tables of
`docs/results/infrared.md`. Factory rigs are perturbed by some pixels in each camera. The result is scored on dots that
were not used for the factory calibration (real), or on the exact positions of the dots at another pose (simulated).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import imgcal
from imgcal.detection import Frame
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis import Difficulty, FrameModel, Truth, simulate_shots
from imgcal.types import CalibrationObject, CameraRig, Detections
from renderers import BlobRange, ClutterModel
from scripts.output import RESULTS, command, fill, markdown, read_json, surroundings, write_json
from tests.captures.conftest import Points, as_detections, disturbed
from tests.captures.sets import PRIOR, SIZE, cavity_two_cameras, three_cameras_dots

JSON, PAGE = RESULTS / "many-dots.json", RESULTS / "infrared.md"
NEAR = 3.0  # px within which a position is right
WRONG = 2.0  # px: held-out RMS of a wrong rig; dots are at least 35 px apart
PIXELS = (9.0, 12.0, 14.0)  # errors of the factory rigs
PITCH = (((0,), (22, 0)), ((0,), (-35, 0)), ((0, 2), (0, 22)), ((1,), (30, 10)), ((0, 1, 2), (-25, 0)))
"""Cameras of the lattice of 437 dots, and px by which their images are shifted: more than half a pitch."""
VISIBLE = 0.25  # share of a dot that must be visible for it to count
CLUTTER = ClutterModel(
    reflections=BlobRange(4, (6.0, 30.0), (2.0, 6.0), (0.5, 2.0)),
    blobs=BlobRange(1500, (0.6, 3.0), (1.0, 1.5), (0.1, 1.5)),
)
HARD = Difficulty(peak_snr=(3.0, 6.0), clutter=CLUTTER, hidden=0.1)
STATUS = ("calibrated", "left to blobs", "refused", "wrong")
DETECTORS = ("classical", "matched", "learned, one crop a camera", "learned")


@dataclass(frozen=True)
class Case:
    """Frames, a perturbed factory rig, and the known ground truth."""

    name: str  # of the row in the table
    frames: Mapping[str, Frame]
    rig: CameraRig
    obj: CalibrationObject
    uv: NDArray[np.float64]  # (C, N, 2) px, nan = unknown
    held_out: Detections


def real(captures: Path) -> Iterator[Case]:
    """Yield both real targets, each with several perturbed factory rigs."""
    for name, read in (("cavity-two-cameras", cavity_two_cameras), ("three-cameras-dots", three_cameras_dots)):
        known = read(captures)
        frames = {camera: shots[0] for camera, shots in known.frames.items()}
        uv = np.full((len(frames), known.obj.num_fiducials, 2), np.nan)
        uv[known.points.camera, known.points.fiducial] = known.points.uv
        for draw, pixels in enumerate(PIXELS):
            rig = disturbed(known.factory, known.points, pixels, draw)
            yield Case(name, frames, rig, known.obj, uv, known.held_out)
        for cameras, shift in PITCH if name == "three-cameras-dots" else ():
            step = torch.zeros(len(frames), 15, dtype=torch.float64)
            step[list(cameras), 8:10] = torch.tensor(shift, dtype=torch.float64)
            rig = known.factory.retract(step)
            yield Case(f"{name}, more than half a pitch aside", frames, rig, known.obj, uv, known.held_out)


def simulated(count: int) -> Iterator[Case]:
    """Simulate two cameras that see 90 dots, a tenth hidden, among 1500 false ones of at most their brightness."""
    x, y = np.meshgrid(5.0 * np.arange(15) - 35, 8.0 * np.arange(6) - 20)
    xyz = np.stack((x, y, 8.0 * (np.arange(6)[:, None] % 3) + 0 * x - 8), -1).reshape(-1, 3)
    obj = CalibrationObject(torch.from_numpy(xyz), torch.zeros(90, 3, dtype=torch.float64), name="plate90")
    turns = torch.tensor([[0.0, 0.3, 0.0], [0.05, -0.25, 0.0]], dtype=torch.float64)
    true = CameraRig(
        torch.full((2, 2), 5000.0, dtype=torch.float64), torch.tensor([[640.0, 512.0]] * 2, dtype=torch.float64),
        torch.zeros(2, 5, dtype=torch.float64),
        RigidTransform(rotation_from_vector(turns), torch.tensor([[0.0, 0.0, 500.0]] * 2, dtype=torch.float64)),
        torch.tensor([SIZE] * 2), ("a", "b"), "true", None, PRIOR,
    )  # fmt: skip
    poses = RigidTransform(rotation_from_vector(torch.tensor([[0.0, 0.0, 0.0], [0.1, -0.1, 0.05]]).double()),
                           torch.zeros(2, 3, dtype=torch.float64))  # fmt: skip
    uv = true.project(poses.apply(obj.points)).uv
    rows = np.indices((2, 90)).reshape(2, -1)
    points = Points(uv[0].reshape(-1, 2).numpy(), xyz[rows[1]], rows[0], rows[1])
    held_out = as_detections(replace(points, uv=uv[1].reshape(-1, 2).numpy()), true.camera_names)
    for seed in range(count):
        draw = torch.Generator().manual_seed(seed)
        model = FrameModel(difficulty=HARD, marker_radius=0.45)
        shot = next(iter(simulate_shots(Truth(true, poses[:1], uv[:1]), obj, model, draw)))
        there = np.where((shot.seen > VISIBLE).numpy()[..., None], uv[0].numpy(), np.nan)
        rig = disturbed(true, points, PIXELS[seed % len(PIXELS)], seed)
        yield Case("simulated, 90 dots", shot.frames, rig, obj, there, held_out)


def asked(name: str, case: Case) -> dict[str, Any]:
    """Calibrate, and score the labels of the estimate if they are this detector's own."""
    known, detector = ~np.isnan(case.uv[..., 0]), name.partition(",")[0]
    nothing = {"right": 0, "wrong": 0, "known": int(known.sum())}
    started = time.process_time()
    try:
        result = imgcal.calibrate(dict(case.frames), case.rig, case.obj, detector=detector)
    except RefusedError as refused:
        seconds = time.process_time() - started
        return {"status": "refused", "reason": str(refused), "seconds": seconds} | nothing
    seconds = time.process_time() - started
    if detector not in result.detectors:
        return {"status": "left to blobs", "seconds": seconds} | nothing
    labelled = result.labelled.detections
    labelled = labelled.select(labelled.fiducial >= 0)
    rows = labelled.camera, labelled.fiducial
    off = np.linalg.norm(labelled.uv - case.uv[rows], axis=1)[known[rows]]
    scored = imgcal.score(case.held_out, result.rig, case.obj)
    rms = float(scored.distances.square().mean().sqrt())
    status = "wrong" if rms > WRONG else "calibrated"
    labels = {"right": int((off < NEAR).sum()), "wrong": int((off >= NEAR).sum())}
    return {"status": status, "held_out_px": rms, "seconds": seconds} | nothing | labels


def measure(cases: Iterator[Case], detectors: tuple[str, ...]) -> list[dict[str, Any]]:
    """Run all detectors on all cases."""
    outcomes: list[dict[str, Any]] = []
    for case in cases:
        for name in detectors:
            if "one crop" in name and "pitch" in case.name:
                continue  # it fails on easier cases already
            # If no marker counts as too small for the network, it gets one crop per camera.
            least = 0.0 if "one crop" in name else 0.5
            with patch("imgcal.networks.tiles.LEAST_RADIUS", least):
                outcomes.append({"case": case.name, "detector": name} | asked(name, case))
            print(outcomes[-1], flush=True)
    return outcomes


def table(outcomes: list[dict[str, Any]]) -> str:
    """Make one row for each target and detector."""
    rows = []
    for case in dict.fromkeys(one["case"] for one in outcomes):
        for name in dict.fromkeys(one["detector"] for one in outcomes):
            mine = [one for one in outcomes if (one["case"], one["detector"]) == (case, name)]
            if not mine:
                continue
            share = 100 / sum(one["known"] for one in mine)
            right, wrong = (share * sum(one[key] for one in mine) for key in ("right", "wrong"))
            status = [sum(one["status"] == each for one in mine) for each in STATUS]
            px = [one["held_out_px"] for one in mine if one["status"] == "calibrated"]
            rms = f"{median(px):.3f} / {max(px):.3f}" if px else ""
            seconds = median(one["seconds"] for one in mine)
            shares = f"{right:.1f} / {wrong:.1f} / {100 - right - wrong:.1f}"
            rows.append([case, name, shares, " / ".join(map(str, status)), rms, f"{seconds:.2g}"])
    head = ["target", "detector", "right / wrong / absent %", " / ".join(STATUS)]
    return markdown([*head, "held-out RMS px, median / worst", "CPU s"], rows)


def main(count: int = 6, part: str = "all") -> None:
    """Measure, write the JSON, and rewrite the table.

    Args:
        count: simulated captures.
        part: all, simulated, real, or tables; the rest stays as it is in the JSON.
    """
    known = read_json(JSON)["outcomes"] if JSON.is_file() else []
    if part != "tables":
        torch.set_num_threads(1)
        parts: dict[str, Callable[[], Iterator[Case]]] = {
            "simulated": lambda: simulated(count), "real": lambda: real(Path(os.environ["IMGCAL_CAPTURES"])),
        }  # fmt: skip
        for name in [part] if part in parts else parts:
            fresh = measure(parts[name](), DETECTORS)
            names = {one["case"] for one in fresh}
            known = [one for one in known if one["case"] not in names] + fresh
            write_json(JSON, surroundings() | {"count": count, "outcomes": known})
    fill(PAGE, {"many dots": table(known)})


if __name__ == "__main__":
    command(lambda: tyro.cli(main))
