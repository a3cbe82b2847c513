"""Does the filter of a rig match the batch estimate, and is an update fast enough?

Run as `python -m scripts.benchmarks.rig_over_time --out docs/benchmarks/rig_over_time.json`. Three questions: After 1,
10, 100 and 1,000 snapshots of a steady rig, how far are the filter's values and standard deviations from those of the
batch estimate? Over many steady and drifting runs, are its errors as large as predicted? How long does
`RigKeeper.update` take from blobs, with all snapshots so far and with only the last ones?
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import imgcal
from imgcal.estimation import EstimationOptions, camera_covariance, estimate, fit_pose, uncertainty_over
from imgcal.evaluation.true_error import normalized_error
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigFilter
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Detections, DriftRate, Observations, RigPrior
from scripts.benchmarks.rig_streams import Conditions, Stream
from scripts.output import ROOT, command, fill, markdown, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "rig_over_time.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
NOISE = 0.1  # px
STEADY = DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
WARMING = DriftRate(
    focal_length=2e-4 * 60**0.5, principal_point=0.0, distortion=0.0, rotation=np.deg2rad(0.01), position=0.0
)
"""Focal lengths drift by 0.02 % per minute, mounts by 0.01 degrees per hour."""
BETWEEN = 10.0  # s between snapshots in the runs for normalized errors
SQUARED = EstimationOptions(loss="squared", tolerance=1e-6)


@dataclass(frozen=True)
class Options:
    """Measure the filter of a rig."""

    rig: str = "O10"  #: rig for the comparison with the batch estimate
    counts: tuple[int, ...] = (1, 10, 100, 1000)
    runs: int = 200
    snapshots: int = 60  #: per run
    updates: int = 400  #: updates to time
    only: tuple[str, ...] = ("against batch", "normalized errors", "times")  #: parts; others are kept
    out: Path | None = None  #: a result file; docs/benchmarks/rig_over_time.json rewrites its tables in the page


def seen_by(
    rig: CameraRig, obj: imgcal.CalibrationObject, poses: RigidTransform, generator: torch.Generator
) -> Observations:
    """Simulate noisy observations (S, C, N), a tenth of them hidden."""
    image = rig.expand(len(poses.translation)).project_values(poses.apply(obj.points), obj.radius)
    uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
    seen = image.visible & (torch.rand(image.visible.shape, generator=generator) > 0.1)
    return Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen)


def part(observations: Observations, first: int, last: int) -> Observations:
    return Observations(*(x[first:last] for x in (observations.uv, observations.sigma, observations.seen)))


def carried(count: int, generator: torch.Generator, poses: RigidTransform) -> RigidTransform:
    """Draw poses of an object that is carried around in front of a rig."""
    shift = torch.tensor([90.0, 60.0, 60.0]) * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1)
    return RigidTransform(poses.rotation, poses.translation + shift)


def against_batch(options: Options) -> list[dict[str, float]]:
    """Compare the filter and the batch estimate on the same snapshots."""
    factory, obj = imgcal.load_rig(options.rig).to(torch.float64), imgcal.load_object("asymmetric8")
    generator, count = torch.Generator().manual_seed(1), max(options.counts)
    truth = simulate_truth(factory, obj, count, generator, PhysicalDrift())
    poses = carried(count, generator, truth.rig_from_object)
    observations = seen_by(truth.rig, obj, poses, generator)
    follows, rows = RigFilter(factory, obj, STEADY, SQUARED), []
    for s in range(count):
        follows.update(part(observations, s, s + 1), poses[s : s + 1], 1 / 60)
        if s + 1 not in options.counts:
            continue
        fit = estimate(part(observations, 0, s + 1), factory, obj, poses[: s + 1], options=SQUARED)
        std = camera_covariance(fit, curved=False).diagonal().sqrt()
        belief = follows.belief
        errors = [held_out(rig, truth.rig, obj, poses[:20]) for rig in (belief.rig, fit.rig)]
        ratio = belief.std().flatten() / std
        rows.append(
            {
                "snapshots": s + 1,
                "largest ratio of sd": float(torch.maximum(ratio, 1 / ratio).max()),
                "largest difference, sd": float((belief.rig.local(fit.rig).flatten() / std).abs().max()),
                "held-out RE, filter": errors[0],
                "held-out RE, batch": errors[1],
            }
        )
    return rows


def held_out(rig: CameraRig, truth: CameraRig, obj: imgcal.CalibrationObject, poses: RigidTransform) -> float:
    """RMS error (px) on exact images of an object in other poses, which are fitted with a fixed rig."""
    squared = []
    for s in range(len(poses.translation)):
        turned = poses.rotation[s].roll(1, 0)  # an unseen pose
        there = RigidTransform(turned[None], poses.translation[s : s + 1] * 1.03)
        image = truth.expand(1).project_values(there.apply(obj.points), obj.radius)
        seen = Observations(image.uv, torch.full(image.visible.shape, NOISE, dtype=torch.float64), image.visible)
        fit = fit_pose(seen, rig, obj.points, obj.radius, there, EstimationOptions(loss="squared"))
        squared.append(float(np.square(fit.residual).sum() / (2 * int(image.visible.sum()))))
    return float(np.sqrt(np.mean(squared)))


def normalized_errors(options: Options, rate: DriftRate) -> dict[str, list[float]]:
    """Squared error per degree of freedom at the end of each run, for the filter and, with a steady rig, for the batch.

    "Value by value" includes the motion of the whole rig, which images do not show, in the errors of the values.
    """
    factory, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    factory = replace(factory, prior=RigPrior())
    found: dict[str, list[float]] = {}
    for run in range(options.runs):
        generator = torch.Generator().manual_seed(1000 + run)
        truth = simulate_truth(factory, obj, options.snapshots, generator, PhysicalDrift())
        poses = carried(options.snapshots, generator, truth.rig_from_object)
        normal = torch.randn(factory.num_cameras, 15, generator=generator, dtype=torch.float64)
        rig = factory.retract(RigPrior().std(factory) * normal)
        follows, seen = RigFilter(factory, obj, rate, SQUARED), []
        for s in range(options.snapshots):
            if s:
                walk = rate.std(rig) * (BETWEEN / 3600) ** 0.5
                rig = rig.retract(walk * torch.randn(walk.shape, generator=generator, dtype=torch.float64))
            seen.append(seen_by(rig, obj, poses[s : s + 1], generator))
            follows.update(seen[-1], poses[s : s + 1], BETWEEN)
        believed = {"filter": (follows.belief.rig, follows.belief.covariance())}
        if rate == STEADY:
            parts = (torch.cat([getattr(one, name) for one in seen]) for name in ("uv", "sigma", "seen"))
            fit = estimate(Observations(*parts), factory, obj, poses, options=SQUARED)
            believed["batch"] = (fit.rig, camera_covariance(fit, curved=False))
        points = poses.apply(obj.points).flatten(0, 1)
        for name, (estimated, covariance) in believed.items():
            error = estimated.local(rig).flatten()
            by_value = float(error @ torch.linalg.solve(covariance, error)) / len(error)
            found.setdefault(name, []).append(normalized_error(uncertainty_over(estimated, covariance, points), rig))
            found.setdefault(f"{name}, value by value", []).append(by_value)
    return found


def times(options: Options) -> dict[str, dict[str, float]]:
    """Measure the CPU time (ms) of updates from blobs of O10, with several horizons in turn."""
    factory, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    stream = Stream(factory, obj, 1, Conditions(noise=0.07, hidden=0.0, clutter=0.0))
    shots: list[tuple[float, Detections]] = list(stream.snapshots(options.updates + 100))
    horizons = {"everything": None, "horizon 1": 1, "horizon 5": 5, "horizon 20": 20}
    taken: dict[str, list[float]] = {name: [] for name in horizons}
    with ExitStack() as stack:
        keepers = {n: stack.enter_context(imgcal.RigKeeper(factory, obj, horizon=h)) for n, h in horizons.items()}
        for number, (seconds, blobs) in enumerate(shots):
            for name, keeper in keepers.items():
                begin = time.thread_time()
                keeper.update(blobs, seconds)
                if number >= 100:
                    taken[name].append(1e3 * (time.thread_time() - begin))
    return {
        name: {"p50": float(np.median(ms)), "p99": float(np.quantile(ms, 0.99)), "best": min(ms)}
        for name, ms in taken.items()
    }


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables, by marker."""
    batch = [
        (f"{row['snapshots']:,}", *(f"{value:.3g}" for key, value in row.items() if key != "snapshots"))
        for row in result["against batch"]
    ]
    errors = [
        (
            f"{name}, {method}",
            f"{np.mean(values):.3f}",
            f"{np.quantile(values, 0.05):.2f} to {np.quantile(values, 0.95):.2f}",
            f"{len(values)}",
        )
        for name, found in result["normalized errors"].items()
        for method, values in found.items()
    ]
    rows = [(name, *(f"{ms[key]:.2f}" for key in ("p50", "p99", "best"))) for name, ms in result["times"].items()]
    return {
        "rig filter against batch": markdown(
            ("snapshots", "largest ratio of sd", "largest difference, sd", "held-out RE, px", "of the batch estimate"),
            batch,
        ),
        "rig filter errors": markdown(("rig", "squared error per dof", "5 % to 95 %", "runs"), errors),
        "keeper speed": markdown(("update from blobs, CPU ms", "p50", "p99", "best"), rows),
    }


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    questions: dict[str, Callable[[], Any]] = {
        "against batch": lambda: against_batch(options),
        "normalized errors": lambda: {
            "steady": normalized_errors(options, STEADY),
            "drifting": normalized_errors(options, WARMING),
        },
        "times": lambda: times(options),
    }
    known = json.loads(RESULT.read_text("utf-8")) if RESULT.exists() else {}
    known.pop("errors by class", None)
    result = known | surroundings() | {name: ask() for name, ask in questions.items() if name in options.only}
    if options.out is not None:
        write_json(options.out, result)
    texts = tables(result)
    if options.out is not None and options.out.resolve() == RESULT:
        fill(PAGE, texts)
    for text in texts.values():
        print(text, end="\n\n")


if __name__ == "__main__":
    command(main)
