"""Targets of many small dots, real and simulated: what each detector makes of them.

`IMGCAL_CAPTURES=... python -m scripts.results.many_dots` rewrites `docs/results/many-dots.json` and the tables of
`docs/infrared.md`. Factory rigs are disturbed by some pixels in each camera; what comes out is scored on dots that
took no part in the factory calibration (real), or on the exact places of the dots at another pose (simulated).
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
from imgcal.detection import Frame, detect_snapshot, to_detections
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_frame
from imgcal.synthesis import Difficulty, FrameModel, Truth, simulate_shots
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior
from renderers import BlobRange, ClutterModel
from scripts.output import RESULTS, ROOT, command, fill, markdown, read_json, surroundings, write_json
from tests.captures import test_cavity_two_cameras as cavity
from tests.captures import test_three_cameras_dots as dots
from tests.captures.conftest import Points, as_detections, at_own_centres, disturbed, fit_rig, read_points

JSON, PAGE = RESULTS / "many-dots.json", ROOT / "docs" / "infrared.md"
NEAR = 3.0  # px within which a place is right
WRONG = 2.0  # px: held-out RMS of a rig that is none; dots are 35 and more apart
PIXELS = (9.0, 12.0, 14.0)  # that factory rigs are off
PITCH = (((0,), (22, 0)), ((0,), (-35, 0)), ((0, 2), (0, 22)), ((1,), (30, 10)), ((0, 1, 2), (-25, 0)))
"""Cameras of the lattice of 437 dots, and px that their images are aside: more than half of a pitch."""
IMAGE = (1280, 1024)
VISIBLE = 0.25  # share of a dot that must be seen for it to count
CLUTTER = ClutterModel(
    reflections=BlobRange(4, (6.0, 30.0), (2.0, 6.0), (0.5, 2.0)),
    blobs=BlobRange(1500, (0.6, 3.0), (1.0, 1.5), (0.1, 1.5)),
)
HARD = Difficulty(peak_snr=(3.0, 6.0), clutter=CLUTTER, hidden=0.1)
DETECTORS = ("classical", "matched", "learned, one crop a camera", "learned")


@dataclass(frozen=True)
class Case:
    """Frames, a factory rig that is off, and what is known of the truth."""

    name: str  # of the table's row
    frames: Mapping[str, Frame]
    rig: CameraRig
    obj: CalibrationObject
    uv: NDArray[np.float64]  # (C, N, 2) px, nan = unknown
    held_out: Detections


def real(captures: Path) -> Iterator[Case]:
    """Both real targets, each disturbed several times."""
    for folder, module, seed in (
        (captures / "cavity-two-cameras", cavity, 1),
        (captures / "three-cameras-dots", dots, 0),
    ):
        obj = load_object(folder / "object.csv")
        points = _published(folder, obj.points.numpy())
        half = np.random.default_rng(seed).random(len(points.uv)) < 0.5
        factory = fit_rig(points.select(half), module.CAMERAS, IMAGE, module.PRIOR)
        frames = {name: read_frame(next((folder / "frames").glob(f"{name}.*"))) for name in module.CAMERAS}
        found = to_detections([detect_snapshot(frames, imgcal.DetectionOptions())], module.CAMERAS, ("0",))
        held_out = as_detections(at_own_centres(points.select(~half), found)[0], module.CAMERAS)
        uv = np.full((len(module.CAMERAS), obj.num_fiducials, 2), np.nan)
        uv[points.camera, points.fiducial] = points.uv
        for draw, pixels in enumerate(PIXELS):
            rig = disturbed(factory, points, pixels, draw)
            yield Case(folder.name, frames, rig, obj, uv, held_out)
        for cameras, shift in PITCH if module is dots else ():
            step = torch.zeros(3, 15, dtype=torch.float64)
            step[list(cameras), 8:10] = torch.tensor(shift, dtype=torch.float64)
            yield Case(f"{folder.name}, more than half a pitch aside", frames, factory.retract(step), obj, uv, held_out)


def _published(folder: Path, object_points: NDArray[np.float64]) -> Points:
    if folder.name == "three-cameras-dots":
        return read_points(folder / "correspondences.csv", object_points, dots.CAMERAS)
    points = cavity.published_dots(folder, object_points)
    # Two places are a particle beside the dot: they stand out of a first fit.
    near = cavity.residuals(fit_rig(points, cavity.CAMERAS, IMAGE, cavity.PRIOR), points) < 2.5
    return points.select(near)


def simulated(count: int) -> Iterator[Case]:
    """Make two cameras that look at 90 dots amid 1500 false ones, as bright as they or dimmer, a tenth hidden."""
    x, y = np.meshgrid(5.0 * np.arange(15) - 35, 8.0 * np.arange(6) - 20)
    xyz = np.stack((x, y, 8.0 * (np.arange(6)[:, None] % 3) + 0 * x - 8), -1).reshape(-1, 3)
    obj = CalibrationObject(torch.from_numpy(xyz), torch.zeros(90, 3, dtype=torch.float64), name="plate90")
    turns = torch.tensor([[0.0, 0.3, 0.0], [0.05, -0.25, 0.0]], dtype=torch.float64)
    true = CameraRig(
        torch.full((2, 2), 5000.0, dtype=torch.float64), torch.tensor([[640.0, 512.0]] * 2, dtype=torch.float64),
        torch.zeros(2, 5, dtype=torch.float64),
        RigidTransform(rotation_from_vector(turns), torch.tensor([[0.0, 0.0, 500.0]] * 2, dtype=torch.float64)),
        torch.tensor([IMAGE] * 2), ("a", "b"), "true", None,
        RigPrior(focal_length=0.01, principal_point=20.0, distortion=0.05, rotation=0.005, position=3.0),
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
    """Calibrate, and count what the labels of the estimate are worth."""
    known = ~np.isnan(case.uv[..., 0])
    started = time.process_time()
    try:
        result = imgcal.calibrate(dict(case.frames), case.rig, case.obj, detector=name.partition(",")[0])
    except RefusedError as refused:
        said = {"status": "refused", "reason": str(refused), "right": 0, "wrong": 0}
        return said | {"known": int(known.sum()), "seconds": time.process_time() - started}
    seconds = time.process_time() - started
    labelled = result.labelled.detections
    labelled = labelled.select(labelled.fiducial >= 0)
    rows = labelled.camera, labelled.fiducial
    off = np.linalg.norm(labelled.uv - case.uv[rows], axis=1)[known[rows]]
    scored = imgcal.score(case.held_out, result.rig, case.obj)
    rms = float(scored.distances.square().mean().sqrt())
    return {
        "status": "wrong" if rms > WRONG else "calibrated", "held_out_px": rms, "right": int((off < NEAR).sum()),
        "wrong": int((off >= NEAR).sum()), "known": int(known.sum()), "seconds": seconds,
    }  # fmt: skip


def measure(cases: Iterator[Case], detectors: tuple[str, ...]) -> list[dict[str, Any]]:
    """Ask all detectors about all cases."""
    outcomes: list[dict[str, Any]] = []
    for case in cases:
        for name in detectors:
            if "one crop" in name and "pitch" in case.name:
                continue  # it finds nothing where less is asked
            # A network that takes no marker for too small looks at one crop a camera.
            least = 0.0 if "one crop" in name else 0.5
            with patch("imgcal.networks.tiles.LEAST_RADIUS", least):
                outcomes.append({"case": case.name, "detector": name} | asked(name, case))
            print(outcomes[-1], flush=True)
    return outcomes


def table(outcomes: list[dict[str, Any]]) -> str:
    """One row for each target and detector."""
    rows = []
    for case in dict.fromkeys(one["case"] for one in outcomes):
        for name in dict.fromkeys(one["detector"] for one in outcomes):
            mine = [one for one in outcomes if (one["case"], one["detector"]) == (case, name)]
            if not mine:
                continue
            share = 100 / sum(one["known"] for one in mine)
            right, wrong = (share * sum(one[key] for one in mine) for key in ("right", "wrong"))
            status = [sum(one["status"] == each for one in mine) for each in ("calibrated", "refused", "wrong")]
            px = [one["held_out_px"] for one in mine if one["status"] == "calibrated"]
            rms = f"{median(px):.3f} / {max(px):.3f}" if px else ""
            seconds = median(one["seconds"] for one in mine)
            shares = f"{right:.1f} / {wrong:.1f} / {100 - right - wrong:.1f}"
            rows.append([case, name, shares, " / ".join(map(str, status)), rms, f"{seconds:.2g}"])
    head = ["target", "detector", "right / wrong / absent %", "calibrated / refused / wrong"]
    return markdown([*head, "held-out RMS px, median / worst", "CPU s"], rows)


def main(count: int = 6, part: str = "all") -> None:
    """Measure, write the JSON, and rewrite the table.

    Args:
        count: simulated captures.
        part: all, simulated, real, or tables; the rest stays as the JSON has it.
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
