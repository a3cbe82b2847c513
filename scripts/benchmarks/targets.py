"""Simulated captures of sticks and several objects without labels: how many are calibrated, refused and wrong?

Run as `python -m scripts.benchmarks.targets`. A quarter of the markers are hidden, and every camera has three false
blobs. Sticks of a real recording: `python -m scripts.benchmarks.lights stream`.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from imgcal import RefusedError, calibrate, load_object, load_rig
from imgcal.estimation import camera_covariance, estimate
from imgcal.pipeline import Calibration
from imgcal.synthesis import PhysicalDrift, simulate_volume, true_detections
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations
from renderers import palette
from scripts.output import ROOT, command, commit, read_json, surroundings, write_json

HIDDEN, FALSE, NOISE = 0.25, 3, 0.1
"""Share of hidden markers; false blobs per camera; noise, px."""
PLACES = 300
"""Points in the rig's volume that are triangulated to compare a rig with the truth."""
WRONG = 3.0
"""Multiple of the predicted error (95 %) beyond which an accepted rig is wrong."""
POINTS = {
    "stick2": [[0, 0, 0], [500, 0, 0]],
    "stick3": [[0, 0, 0], [200, 0, 0], [500, 0, 0]],
    "body5": [[0, 0, 0], [120, 0, 10], [0, 170, 0], [60, 90, -80], [-70, 40, 50]],
    "light": [[0, 0, 0]],
    "body6": [[0, 0, 0], [150, 20, 0], [30, 190, 20], [80, 60, -90], [-60, 80, 70], [-90, -50, 30]],
}
SCENES: dict[str, tuple[tuple[str, ...], int]] = {
    "stick of two": (("stick2",), 150),
    "stick of three": (("stick3",), 150),
    "two objects": (("wand4", "body5"), 8),
    "two equal objects": (("body5", "body5"), 8),
    "object and stick": (("body5", "stick3"), 10),
    "one object": (("body5",), 10),
    "object and unknown markers": (("body5", "light", "light", "light"), 20),
}
COMMAND = "python -m scripts.benchmarks.targets"
RESULT = ROOT / "docs" / "benchmarks" / "targets.json"


def named_object(name: str) -> CalibrationObject:
    """Make an object of the campaign."""
    if name not in POINTS:
        return load_object(name)
    points = torch.tensor(POINTS[name], dtype=torch.float64)
    return CalibrationObject(points, palette(len(points)).double(), name=name)


def capture(
    objects: tuple[CalibrationObject, ...], moments: int, drift: float, seed: int
) -> tuple[CameraRig, CameraRig, Detections]:
    """Simulate one capture: factory rig, true rig, and blobs with true labels counted over all objects."""
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    spread = PhysicalDrift(**{name: drift * value for name, value in vars(PhysicalDrift()).items()})
    factory = load_rig("room10")
    truth, tables, first = factory, list[Detections](), 0
    for number, obj in enumerate(objects):
        found = simulate_volume(truth, obj, moments, generator, None if number else spread)
        truth, table = found.rig, true_detections(found)
        table = table.select(rng.random(len(table)) > HIDDEN)
        table.uv[:] += NOISE * rng.standard_normal(table.uv.shape)
        tables.append(replace(table, fiducial=table.fiducial + first))
        first += obj.num_fiducials
    size, cameras = factory.image_size.numpy(), factory.num_cameras
    camera = np.tile(np.repeat(np.arange(cameras), FALSE), moments)
    count = len(camera)
    false = replace(
        tables[0],
        uv=rng.random((count, 2)) * size[camera],
        sigma=np.full(count, NOISE),
        camera=camera,
        snapshot=np.repeat(np.arange(moments), cameras * FALSE),
        fiducial=np.full(count, -1),
        radius=np.full(count, np.nan),
        flags=np.zeros(count, dtype=np.uint8),
    )
    columns = ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
    joined: dict[str, Any] = {n: np.concatenate([getattr(t, n) for t in (*tables, false)]) for n in columns}
    table = replace(false, **joined)
    inside = ((table.uv > -0.5) & (table.uv < size[table.camera] - 0.5)).all(1)
    return factory, truth, table.select(rng.permutation(np.flatnonzero(inside)))


def error_mm(rig: CameraRig, truth: CameraRig) -> tuple[float, float]:
    """Median error (mm) of triangulated points after the best rigid alignment, and relative error of the scale."""
    assert truth.volume is not None
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (truth.volume.low, truth.volume.high))
    places = low + (high - low) * torch.rand(PLACES, 3, generator=torch.Generator().manual_seed(0), dtype=low.dtype)
    image = truth.project(places)
    seen = image.visible.T[:, :, None]
    kept = seen.sum(1)[:, 0] >= 2
    light = CalibrationObject(torch.zeros(1, 3, dtype=torch.float64), torch.ones(1, 3))
    uv = image.uv.permute(1, 0, 2)[:, :, None]
    observations = Observations(uv[kept], torch.ones_like(uv[kept][..., 0]), seen[kept])
    held = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
    found = estimate(observations, rig, light, prior_std=held).rig_from_object.translation
    a, b = found - found.mean(0), places[kept] - places[kept].mean(0)
    u, _, vh = torch.linalg.svd(a.T @ b)
    turn = vh.T @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(vh.T @ u.T).sign())], dtype=a.dtype)) @ u.T
    scale = float((b * (a @ turn.T)).sum() / a.square().sum())
    return float((a @ turn.T - b).norm(dim=1).median()), 1 / scale - 1


def nees(found: Calibration, truth: CameraRig) -> float:
    """Normalized squared error of all parameters, per parameter."""
    error = truth.local(found.estimate.rig).flatten()
    covariance = camera_covariance(found.estimate, curved=False)
    return float(error @ torch.linalg.solve(covariance, error)) / len(error)


def outcome(scene: str, drift: float, seed: int) -> dict[str, Any]:
    """Calibrate one capture, and compare it with the truth."""
    names, moments = SCENES[scene]
    objects = tuple(map(named_object, names))
    factory, truth, blobs = capture(objects, moments, drift, seed)
    known = [obj for obj in objects if obj.num_fiducials > 1]
    given = known if len(known) == len(objects) else [*known, load_object("lights")]
    values: dict[str, Any] = {"scene": scene, "drift": drift, "seed": seed, "commit": commit()}
    values["factory_mm"] = error_mm(factory, truth)[0]
    started = time.process_time()
    try:
        found = calibrate(replace(blobs, fiducial=np.full(len(blobs), -1)), factory, given)
    except RefusedError as refusal:
        return values | {"status": "refused", "reason": refusal.reason, "seconds": time.process_time() - started}
    seconds, (error, scale), predicted = (
        time.process_time() - started,
        error_mm(found.rig, truth),
        found.predicted_error,
    )
    labels = found.labelled.detections.fiducial
    assert len(labels) == len(blobs)
    return values | {
        "status": "wrong" if error > WRONG * predicted.p95_mm else "calibrated",
        "error_mm": error,
        "predicted_mm": predicted.median_mm,
        "scale_percent": 100 * scale,
        "nees": nees(found, truth),
        "rows": len(found.labelled.used),
        "labelled": int((labels >= 0).sum()),
        "clutter_labelled": int(((labels >= 0) & (blobs.fiducial < 0)).sum()),
        "markers": int((blobs.fiducial >= 0).sum()),
        "seconds": seconds,
    }


def table_of(outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    """Count outcomes by scene and drift."""
    table: dict[str, Any] = {}
    for scene in SCENES:
        for drift in sorted({o["drift"] for o in outcomes}):
            own = [o for o in outcomes if (o["scene"], o["drift"]) == (scene, drift)]
            good = [o for o in own if o["status"] != "refused"]
            if own:
                table[f"{scene}, drift {drift:g}"] = {
                    **{
                        status: sum(o["status"] == status for o in own) for status in ("calibrated", "refused", "wrong")
                    },
                    **{
                        name: float(np.median([o[name] for o in good])) if good else None
                        for name in ("error_mm", "predicted_mm", "nees")
                    },
                    "factory_mm": float(np.median([o["factory_mm"] for o in own])),
                }
    return table


@dataclass(frozen=True)
class Simulated:
    """Calibrate simulated captures, and count those that are calibrated, refused and wrong."""

    captures: int = 3  #: per scene and drift
    drifts: tuple[float, ...] = (0.3, 1.0, 2.0)  #: multiples of half a degree, 2 mm, 1 % and 5 px
    scenes: tuple[str, ...] = tuple(SCENES)  #: which
    first: int = 0  #: first seed
    out: Path = RESULT  #: result file; captures in it are kept

    def run(self) -> None:
        """Run, and write after each capture."""
        done = read_json(self.out)["captures"] if self.out.is_file() else []
        for seed in range(self.first, self.first + self.captures):
            for drift in self.drifts:
                for scene in self.scenes:
                    if any((o["scene"], o["drift"], o["seed"]) == (scene, drift, seed) for o in done):
                        continue
                    done.append(outcome(scene, drift, seed))
                    print({k: v for k, v in done[-1].items() if k != "reason"}, file=sys.stderr, flush=True)
                    result = {
                        "command": COMMAND,
                        **surroundings(),
                        "table": table_of(done),
                        "captures": done,
                    }
                    write_json(self.out, result)


def main() -> None:
    """Run from the command line."""
    command(lambda: tyro.cli(Simulated, description=__doc__).run())


if __name__ == "__main__":
    main()
