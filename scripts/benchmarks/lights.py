"""Markers without labels: how many captures are calibrated, refused and wrong, and how good the rigs are.

Run as `python -m scripts.benchmarks.lights campaign|moves|accuracy|bound|stream`; each writes its part of
docs/benchmarks/lights.json and resumes where it was stopped (out/work/lights.jsonl). Rig room10; errors of the factory
values: half a degree, 2 mm, 1 % and 5 px times the drift; blobs with a noise of 0.1 px, a quarter of them hidden, three
false ones in each image, no labels. `accuracy` compares with an estimate that is given all labels and reaches the
Cramér-Rao bound, and times 2,000 lights. `moves` turns one camera in the middle of the capture. `bound` says what
errors that bound allows. `stream` needs IMGCAL_CAPTURES.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor

import imgcal
from imgcal import CalibrationObject, CameraRig, Detections, Observations, RefusedError, RigPrior, estimate
from imgcal.estimation import camera_covariance, relative_covariance, relative_difference
from imgcal.geometry import RigidTransform
from imgcal.messages import list_names
from imgcal.synthesis import PhysicalDrift, simulate_volume
from imgcal.types import MovedError
from scripts.benchmarks.camera_faults import turned
from scripts.benchmarks.wand_recording import CALIBRATED, calibrated, recording
from scripts.output import ROOT, WORK, command, commit, make_folder, read_json, surroundings, write_json

RESULT, DONE = ROOT / "docs" / "benchmarks" / "lights.json", WORK / "lights.jsonl"
LIGHTS = CalibrationObject.unknown()
NOISE, HIDDEN, FALSE = 0.1, 0.25, 3
BODY = (500.0, 400.0, 1700.0)
"""mm, box that contains the markers of a body."""
COUNTS, DRIFTS, SEEDS = (5, 15, 40, 100), (0.3, 1.0, 2.0), 5
MOMENTS = {5: 60, 15: 40, 40: 24, 100: 12}
WRONG_MM, WRONG_TIMES = 2.0, 5.0
"""A rig is wrong if its median error exceeds this, and this multiple of its stated error."""
POINTS = 300
DRAWN = 40
"""Rigs drawn from the bound for each capture."""
STICKS = {"stick of two": (-250.0, 250.0), "stick of three": (-250.0, -80.0, 250.0)}
"""mm, positions of the markers along the stick."""
MOVING, TURNS = {1: 120, 15: 40}, (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Number of snapshots by number of markers, and turns of one camera in the middle, degrees."""
TARGETS = {"1 marker": (450, 2000), "40 markers": (50,), "stick of two": (150,), "stick of three": (150,)}
"""Numbers of snapshots of the cases whose accuracy is measured."""
PAIRS, LINES = ((0, 2), (0, 4)), ((0, 1, 2), (1, 3, 4))
"""Subsets of the recorded wand's markers: two of them, and its two lines of three."""


@dataclass(frozen=True)
class Scene:
    """A capture with its ground truth."""

    factory: CameraRig
    rig: CameraRig
    detections: Detections  # in the order of snapshots
    fiducial: NDArray[np.int64]  # (M,) marker of each blob, -1 = false
    uv: Tensor  # (S, C, N, 2) without noise
    visible: Tensor  # (S, C, N)
    points: Tensor  # (S, N, 3) mm
    poses: RigidTransform  # (S,) rig_from_object
    obj: CalibrationObject = LIGHTS  # the target as it is given to imgcal


def simulate(
    markers: int, moments: int, drift: float, seed: int, stick: Sequence[float] = (), hidden: float = HIDDEN
) -> Scene:
    """Simulate a capture of a body in a room; one marker is a light that is carried around.

    Args:
        markers: number of markers on the body, whose positions are unknown.
        moments: number of snapshots.
        drift: of the factory values.
        seed: of all random values.
        stick: mm, known positions of markers on a line, which replaces the body.
        hidden: share of the blobs that cameras miss.
    """
    generator, random = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    physical = PhysicalDrift(0.5 * drift, 2.0 * drift, 0.01 * drift, 5.0 * drift, 0.005 * drift)
    spread = (physical.focal_length, physical.principal_point, physical.distortion)
    prior = RigPrior(*spread, float(np.deg2rad(physical.rotation_deg)), physical.position)
    factory = replace(imgcal.load_rig("room10"), prior=prior)
    rig = physical.apply(factory, generator)
    box = torch.tensor(BODY if markers > 1 else (0.0, 0.0, 0.0), dtype=torch.float64)
    body = (torch.rand(markers, 3, generator=generator, dtype=torch.float64) - 0.5) * box
    if stick:
        body = torch.tensor([[along, 0.0, 0.0] for along in stick], dtype=torch.float64)
    obj = CalibrationObject(body, torch.ones(len(body), 3).double(), name="stick")
    truth = simulate_volume(rig, obj, moments, generator, None)
    assert truth.visible is not None
    seen = truth.visible.numpy() & (random.random(truth.visible.shape) > hidden)
    snapshot, camera, fiducial = np.nonzero(seen)
    exact = truth.uv.numpy()[seen]
    false = FALSE * moments * rig.num_cameras
    size = rig.image_size[0].double().numpy() - 1
    uv = np.concatenate((exact + NOISE * random.standard_normal(exact.shape), random.random((false, 2)) * size))
    number = np.arange(false)
    snapshot = np.concatenate((snapshot, number % moments))
    camera = np.concatenate((camera, number // moments % rig.num_cameras))
    fiducial = np.concatenate((fiducial, np.full(false, -1)))
    order = np.lexsort((random.random(len(uv)), camera, snapshot))
    count = len(order)
    blobs = Detections(
        uv[order], np.full(count, NOISE), camera[order], snapshot[order], np.full(count, -1), np.full(count, np.nan),
        np.zeros(count, dtype=np.uint8), rig.camera_names, tuple(f"{moment:05d}" for moment in range(moments)),
    )  # fmt: skip
    poses = truth.rig_from_object
    known = obj if stick else LIGHTS
    return Scene(factory, rig, blobs, fiducial[order], truth.uv, truth.visible, poses.apply(body), poses, known)


def triangulation_error(rig: CameraRig, scene: Scene) -> float:
    """Median error (mm) of points triangulated from exact images, after a rigid alignment."""
    uv, seen, points = scene.uv.flatten(0, 0), scene.visible, scene.points
    uv, seen = uv.permute(0, 2, 1, 3).flatten(0, 1), seen.permute(0, 2, 1).flatten(0, 1)
    points = points.flatten(0, 1)
    rows = (seen.sum(1) >= 2).nonzero().flatten()
    rows = rows[torch.linspace(0, len(rows) - 1, min(POINTS, len(rows))).long()]
    there, truth = (
        Observations(uv[rows][:, :, None], torch.ones(len(rows), rig.num_cameras, 1).double(), seen[rows][..., None]),
        points[rows],
    )
    start = RigidTransform(torch.eye(3).double().expand(len(rows), 3, 3), truth)
    fixed = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
    found = estimate(there, rig, replace(LIGHTS, unknown_markers=False), start, prior_std=fixed).rig_from_object
    a, b = found.translation - found.translation.mean(0), truth - truth.mean(0)
    u, _, vt = torch.linalg.svd(a.T @ b)
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))]).double()) @ vt
    return float((a @ turn - b).norm(dim=1).median())


def with_labels(scene: Scene) -> imgcal.Estimate:
    """Estimate the rig from the same blobs with known correspondences."""
    right = np.flatnonzero(scene.fiducial >= 0)
    blobs, marker = scene.detections, scene.fiducial[right]
    is_stick, (moments, cameras, markers, _) = scene.obj is not LIGHTS, scene.uv.shape
    row, column = blobs.snapshot[right], marker
    if not is_stick:  # each marker in each snapshot is a row
        row, column = row * markers + marker, np.zeros_like(marker)
    shape = (moments, cameras, markers) if is_stick else (moments * markers, cameras, 1)
    uv, seen = np.zeros((*shape, 2)), np.zeros(shape, dtype=bool)
    uv[row, blobs.camera[right], column], seen[row, blobs.camera[right], column] = blobs.uv[right], True
    kept = ((seen.sum(1) >= 2).sum(1) >= 2) if is_stick else seen.sum((1, 2)) >= 3
    given = Observations(
        torch.from_numpy(uv[kept]), torch.full(shape, NOISE).double()[: int(kept.sum())], torch.from_numpy(seen[kept])
    )
    chosen = torch.from_numpy(kept)
    if is_stick:
        return estimate(given, scene.factory, scene.obj, scene.poses[chosen])
    points = scene.points.flatten(0, 1)[chosen]
    start = RigidTransform(torch.eye(3).double().expand(len(points), 3, 3), points)
    return estimate(given, scene.factory, replace(LIGHTS, unknown_markers=False), start)


def error_to_bound(rig: CameraRig, truth: CameraRig, told: imgcal.Estimate) -> float:
    """RMS of the rig's errors, relative to its first camera, each divided by its Cramér-Rao bound.

    Args:
        rig: to score.
        truth: the true rig.
        told: the estimate with the true labels, whose covariance is the bound.
    """
    error = relative_difference(rig, truth).flatten()
    std = relative_covariance(told).diagonal().clamp_min(0).sqrt()
    known = std > 1e-9
    return float((error[known] / std[known]).square().mean().sqrt())


def normalized_error(found: imgcal.Estimate, truth: CameraRig) -> float:
    """Mean square of the rig's error, relative to its first camera, over its covariance."""
    error, covariance = relative_difference(found.rig, truth).flatten(), relative_covariance(found)
    std = covariance.diagonal().clamp_min(0).sqrt()
    known = std > 1e-12
    scaled = (error / std.clamp_min(1e-30))[known]
    values, vectors = torch.linalg.eigh((covariance / (std[:, None] * std).clamp_min(1e-60))[known][:, known])
    along = (vectors.mT @ scaled).square() / values
    return float(along[values > 1e-9].mean())


def examine(scene: Scene) -> dict[str, Any]:
    """Calibrate a capture and compare with the truth."""
    result: dict[str, Any] = {"factory_mm": triangulation_error(scene.factory, scene)}
    started = time.process_time()
    try:
        found = imgcal.calibrate(scene.detections, scene.factory, scene.obj)
    except RefusedError as error:
        return result | {"status": "refused", "reason": str(error)[:160], "cpu_s": time.process_time() - started}
    seconds = time.process_time() - started
    labels = found.labelled_detections.fiducial
    truth, kept = scene.fiducial, labels >= 0
    key = scene.detections.snapshot * 1000 + labels
    _, group = np.unique(key[kept], return_inverse=True)
    main = np.array([np.bincount(truth[kept][group == g] + 1).argmax() - 1 for g in range(group.max() + 1)])
    wrong = (truth[kept] != main[group]) | (truth[kept] < 0)
    told = with_labels(scene)
    off, claimed = triangulation_error(found.rig, scene), found.predicted_error.median_mm
    is_wrong = off > WRONG_MM and off > WRONG_TIMES * claimed
    return result | {
        "status": "wrong" if is_wrong else "calibrated",
        "error_mm": off,
        "claimed_mm": claimed,
        "labels": int(kept.sum()),
        "labels_of": int((truth >= 0).sum()),
        "wrong_labels": int(wrong.sum()),
        "starts": None if found.lights is None else found.lights.starts,
        "nees": normalized_error(found.estimate, scene.rig),
        "to_bound": error_to_bound(found.rig, scene.rig, told),
        "told_mm": triangulation_error(told.rig, scene),
        "told_nees": normalized_error(told, scene.rig),
        "told_to_bound": error_to_bound(told.rig, scene.rig, told),
        "scale_sigma_percent": 100 * found.scale.sigma,
        "cpu_s": seconds,
        "seconds": dict(found.seconds),
    }


def campaign(seeds: int) -> Iterable[dict[str, Any]]:
    """Yield results for captures of all kinds, easy ones first."""
    for seed in range(seeds):
        for markers in COUNTS:
            for drift in DRIFTS:
                yield {
                    "part": "campaign",
                    "target": f"{markers} markers",
                    "moments": MOMENTS[markers],
                    "drift": drift,
                    "seed": seed,
                }


def moves(seeds: int) -> Iterable[dict[str, Any]]:
    """Yield captures in which one camera turns by some angle in the middle; zero = none does."""
    for seed in range(seeds):
        for markers, moments in MOVING.items():
            for degrees in TURNS:
                case = {"part": "moves", "target": f"{markers} marker", "moments": moments, "drift": 1.0}
                yield case | {"degrees": degrees, "seed": 200 + seed}


def examine_move(scene: Scene, degrees: float, seed: int) -> dict[str, Any]:
    """Turn one camera in the middle of a capture, calibrate, and see what is reported."""
    camera, first = seed % scene.rig.num_cameras, scene.uv.shape[0] // 2
    blobs = turned_from(scene, camera, first, degrees) if degrees else scene.detections
    try:
        found = imgcal.calibrate(blobs, scene.factory, scene.obj)
    except MovedError as error:
        right = degrees > 0 and [move.camera for move in error.moved] == [scene.rig.camera_names[camera]]
        return {"status": "named" if right else "false", "moved": [str(move) for move in error.moved]}
    except RefusedError as error:
        return {"status": "refused", "reason": str(error)[:160]}
    return {"status": "calibrated", "error_mm": triangulation_error(found.rig, scene)}


def turned_from(scene: Scene, camera: int, first: int, degrees: float) -> Detections:
    """Turn one camera from a moment on: its blobs are elsewhere, or out of view."""
    blobs, after = scene.detections, turned(scene.rig, camera, degrees)
    rows = np.flatnonzero((blobs.camera == camera) & (blobs.snapshot >= first) & (scene.fiducial >= 0))
    points = scene.points[blobs.snapshot[rows], scene.fiducial[rows]]
    uv = blobs.uv.copy()
    uv[rows] += (after.project(points).uv[camera] - scene.rig.project(points).uv[camera]).numpy()
    outside = ((uv < 0) | (uv > scene.rig.image_size[0].numpy() - 1)).any(1)
    return replace(blobs, uv=uv).select(np.flatnonzero(~outside))


def accuracy(seeds: int) -> Iterable[dict[str, Any]]:
    """Yield results for the cases that are compared with the estimate from labels."""
    for seed in range(seeds):
        for target, counts in TARGETS.items():
            for moments in counts:
                yield {"part": "accuracy", "target": target, "moments": moments, "drift": 1.0, "seed": 100 + seed}


def run(case: dict[str, Any]) -> dict[str, Any]:
    """Simulate and examine one case."""
    stick = STICKS.get(case["target"], ())
    markers = len(stick) or int(case["target"].split()[0])
    if case["part"] == "moves":
        scene = simulate(markers, case["moments"], case["drift"], case["seed"])
        return case | {"commit": commit()} | examine_move(scene, case["degrees"], case["seed"])
    return case | {"commit": commit()} | examine(simulate(markers, case["moments"], case["drift"], case["seed"], stick))


def bound(seeds: int) -> Iterable[dict[str, Any]]:
    """Yield, for each target, the errors of rigs drawn from the Cramér-Rao bound, with labels given.

    The bound is the covariance of the estimate that is given all labels. The first rows hide a quarter of the blobs, as
    everywhere else; the others hide none.
    """
    for hidden in (HIDDEN, 0.0):
        for target, counts in TARGETS.items():
            stick = STICKS.get(target, ())
            markers = len(stick) or int(target.split()[0])
            for moments in counts:
                rows = [_bound_of(simulate(markers, moments, 1.0, 100 + k, stick, hidden), k) for k in range(seeds)]
                drawn = np.concatenate([errors for errors, _, _ in rows])
                row = {
                    "target": f"{target} x {moments}",
                    "hidden": hidden,
                    "median_mm": float(np.median(drawn)),
                    "middle_90_percent_mm": np.quantile(drawn, (0.05, 0.95)).tolist(),
                    "told_mm": [told for _, told, _ in rows],
                    "told_nees": [nees for _, _, nees in rows],
                }
                print(row, flush=True)
                yield row


def _bound_of(scene: Scene, seed: int) -> tuple[NDArray[np.float64], float, float]:
    """Errors (mm) of rigs drawn from the bound around the true rig; error and normalized error of the estimate."""
    told = with_labels(scene)
    values, vectors = torch.linalg.eigh(camera_covariance(told, curved=False))
    half = vectors * values.clamp_min(0).sqrt()
    noise = torch.randn(DRAWN, len(half), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    steps = (noise @ half.mT).unflatten(1, (scene.rig.num_cameras, -1))
    errors = np.array([triangulation_error(scene.rig.retract(step), scene) for step in steps])
    return errors, triangulation_error(told.rig, scene), normalized_error(told, scene.rig)


def stream() -> dict[str, Any]:
    """Calibrate from the first half of the recorded wand without labels; score on the second with the whole wand."""
    reference, given = calibrated(), recording()
    labelled = reference.calibration.labelled_detections
    cases: dict[str, tuple[Detections, CalibrationObject]] = {}
    for marker in range(given.obj.num_fiducials):
        cases[f"marker {marker}"] = only(labelled, [marker]), part_of(given.obj, [marker])
    for first, second in PAIRS:
        cases[f"markers {first} and {second}"] = only(labelled, [first, second]), part_of(given.obj, [first, second])
    for line in LINES:
        cases[f"markers {list_names(map(str, line))} in a line"] = only(labelled, line), part_of(given.obj, line)
    cases["all as unknown markers"] = given.chosen(CALIBRATED), LIGHTS
    rows: dict[str, Any] = {"whole wand known": {"held_out_px": reference.score(reference.calibration.rig)[0]}}
    for name, (blobs, obj) in cases.items():
        try:
            found = imgcal.calibrate(blobs, given.factory, obj)
        except RefusedError as error:
            rows[name] = {"status": "refused", "reason": error.reason}
        else:
            rms, median = reference.score(found.rig)
            used = found.labelled.moment_counts[0]
            rows[name] = {"status": "ok", "snapshots": used, "held_out_px": rms, "median_px": median}
        print(name, rows[name], flush=True)
    return rows


def only(labelled: Detections, markers: Sequence[int]) -> Detections:
    """Keep the blobs of some markers and all false ones, and remove their labels.

    Blobs of the other markers are dropped, because their distances are too similar.
    """
    blobs = labelled.select(np.isin(labelled.fiducial, [*markers, -1]))
    return replace(blobs, fiducial=np.full(len(blobs), -1), flags=np.zeros_like(blobs.flags))


def part_of(obj: CalibrationObject, markers: Sequence[int]) -> CalibrationObject:
    """Make an object from some markers of another one."""
    rows = list(markers)
    return CalibrationObject(obj.points[rows], obj.colours[rows], name="stick" if len(rows) > 1 else "light")


def tables(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Count outcomes, and take medians."""
    result: dict[str, Any] = {}
    for row in rows:
        key = f"{row['target']} x {row['moments']}, drift {row['drift']:g}"
        outcomes = ["calibrated", "refused", "wrong"]
        if row["part"] == "moves":
            key, outcomes = (
                f"{row['target']} x {row['moments']}, {row['degrees']:g} deg",
                ["named", "false", *outcomes[:2]],
            )
        entry = result.setdefault(row["part"], {}).setdefault(key, dict.fromkeys(outcomes, 0) | {"rows": []})
        entry[row["status"]] += 1
        entry["rows"].append(row)
    for part in result.values():
        for entry in part.values():
            for name in ("error_mm", "claimed_mm", "factory_mm", "told_mm", "cpu_s"):
                values = [row[name] for row in entry["rows"] if name in row]
                if values:
                    entry[f"median_{name}"] = float(np.median(values))
            good = [row for row in entry["rows"] if "nees" in row]
            if good:
                entry["mean_nees"] = float(np.mean([row["nees"] for row in good]))
                entry["mean_told_nees"] = float(np.mean([row["told_nees"] for row in good]))
                entry["to_bound"] = rms([row["to_bound"] for row in good])
                entry["to_told"] = entry["to_bound"] / rms([row["told_to_bound"] for row in good])
            entry["wrong_labels"] = sum(row.get("wrong_labels", 0) for row in entry["rows"])
            entry["labels"] = sum(row.get("labels", 0) for row in entry["rows"])
    return result


def rms(values: Sequence[float]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True)
class Options:
    """Count captures of unknown markers that are calibrated, refused and wrong."""

    part: tyro.conf.Positional[Literal["campaign", "moves", "accuracy", "bound", "stream"]]
    seeds: int = SEEDS  #: captures per kind


def main() -> None:
    """Measure, and write the results."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    result = read_json(RESULT) if RESULT.is_file() else {}
    if options.part == "stream":
        write_json(RESULT, surroundings() | result | {"stream": stream()})
        return
    if options.part == "bound":
        write_json(RESULT, surroundings() | result | {"bound": list(bound(options.seeds))})
        return
    make_folder(DONE.parent)
    done = [json.loads(line) for line in DONE.read_text().splitlines()] if DONE.is_file() else []
    cases = {"campaign": campaign, "moves": moves, "accuracy": accuracy}[options.part]
    for case in cases(options.seeds):
        if any(case.items() <= row.items() for row in done):
            continue
        row = run(case)
        done.append(row)
        with DONE.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(row, flush=True)
    write_json(RESULT, surroundings() | result | tables(done))


if __name__ == "__main__":
    command(main)
