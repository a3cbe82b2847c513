"""Measure refinement: ``python scripts/benchmarks/bench_refinement.py`` prints tables, writes results/refinement.json.

Render-and-compare on 8-bit 224 px images, started from the truth disturbed in all parameters (a network's stand-in);
reprojection errors are the paper's RE, in sensor pixels. Then the same for points, and the time of both.
"""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from imgcal.estimation import Estimate
from imgcal.formats import load_object, load_rig
from imgcal.networks.prediction import Prediction, Views
from imgcal.networks.rendering import render_views
from imgcal.refinement import refine_images, refine_points
from imgcal.rotations import rotation_from_vector
from imgcal.synthesis import PoseRange, RelativeDrift, synthesize
from imgcal.transforms import RigidTransform

RIGS, MANY, CHUNK = 256, 2048, 64
STARTS = (5.0, 10.0, 20.0, 40.0, 80.0)
HEMISPHERE, OVERHEAD = PoseRange(), PoseRange.overhead()


@dataclass(frozen=True)
class Row:
    """One condition."""

    rig: str
    obj: str
    kappa: float
    poses: PoseRange
    missing: float = 0.0

    def __str__(self) -> str:
        where = "overhead" if self.poses == OVERHEAD else "hemisphere"
        gone = f", {100 * self.missing:.0f} % missing" if self.missing else ""
        return f"{self.rig} {self.obj}, kappa {100 * self.kappa:g} %, {where}{gone}"


class Scene:
    """Drifted rigs, their images, and disturbed predictions."""

    def __init__(self, row: Row, count: int) -> None:
        self.random = torch.Generator().manual_seed(0)
        self.factory, self.obj = load_rig(row.rig), load_object(row.obj)
        drift = RelativeDrift(row.kappa, row.kappa)
        self.spread = drift.std(self.factory)
        self.truth = synthesize(self.factory, self.obj, count, self.random, drift=drift, pose_range=row.poses)
        self.seen = torch.rand(self.truth.projection.visible.shape, generator=self.random) >= row.missing

    def images(self, rows: slice) -> Tensor:
        uv = self.truth.projection.uv[rows].float()
        return render_views(uv, self.seen[rows], self.factory.image_size, self.obj, quantise=True)

    def guess(self, error: float) -> Prediction:
        """Disturb pose and parameters until the reprojection error is `error`."""
        count = len(self.seen)
        step = torch.randn(count, *self.spread.shape, generator=self.random, dtype=torch.float64) * self.spread
        turn, shift = torch.randn(2, count, 3, generator=self.random, dtype=torch.float64).unbind(0)
        pose, centroid = self.truth.rig_from_object, self.obj.points.mean(0)
        centre = pose.apply(centroid[None])[:, 0]

        def at(share: Tensor) -> Prediction:
            rotation = rotation_from_vector(0.03 * turn * share[:, None]) @ pose.rotation
            translation = centre + 15 * shift * share[:, None] - rotation @ centroid
            return Prediction(self.truth.rig.moved(step * share[:, None, None]), RigidTransform(rotation, translation))

        share = torch.full((count,), 1e-3, dtype=torch.float64)
        for _ in range(5):
            share = (share * error / self.errors(at(share), slice(None))).clamp_max(3.0)
        return at(share)

    def errors(self, found: Prediction, rows: slice) -> Tensor:
        uv = found.rig.project(found.rig_from_object.apply(self.obj.points)).uv
        return (uv - self.truth.projection.uv[rows]).square().mean((1, 2, 3)).sqrt()

    def refined(self, guess: Prediction) -> tuple[Tensor, Tensor]:
        """Errors and whether converged, of render-and-compare."""
        errors, converged = [], []
        for first in range(0, len(self.seen), CHUNK):
            rows = slice(first, first + CHUNK)
            some = Prediction(guess.rig[rows], guess.rig_from_object[rows])
            estimate, _ = refine_images(some, self.images(rows), self.factory, self.obj, self.spread)
            errors.append(self.errors(_found(estimate), rows))
            converged.append(estimate.converged)
        return torch.cat(errors), torch.cat(converged)


def _found(estimate: Estimate) -> Prediction:
    return Prediction(estimate.rig, estimate.rig_from_object[:, 0])


def summary(errors: Tensor, converged: Tensor) -> dict[str, float]:
    return {
        "mean": round(float(errors.mean()), 5),
        "p99": round(float(errors.quantile(0.99)), 5),
        "max": round(float(errors.max()), 5),
        "share_within_0.1": float((errors <= 0.1).double().mean()),
        "share_within_0.5": float((errors <= 0.5).double().mean()),
        "share_converged": float(converged.double().mean()),
        "max_of_converged": round(float(errors[converged].max()), 5) if bool(converged.any()) else float("nan"),
    }


def accuracy() -> dict[str, dict[str, float]]:
    rows = [Row("O10", obj, kappa, HEMISPHERE) for obj in ("cube8", "asymmetric8") for kappa in (0.025, 0.05, 0.1)]
    rows += [Row("O10", "cube8", kappa, OVERHEAD) for kappa in (0.025, 0.05, 0.1)]
    rows += [Row("O6", obj, 0.025, OVERHEAD) for obj in ("cube8", "asymmetric8")]
    rows += [Row("O6", "cube8", 0.1, HEMISPHERE), Row("O10", "asymmetric8", 0.05, HEMISPHERE, missing=0.2)]
    found = {}
    for row in rows:
        scene = Scene(row, RIGS)
        for start in STARTS:
            found[f"{row}, start {start:g} px"] = _printed(f"{row}, start {start:g} px", scene, start)
    many = Row("O10", "asymmetric8", 0.05, HEMISPHERE)
    for start in (20.0, 200.0):
        name = f"{many}, start {start:g} px, {MANY} rigs"
        found[name] = _printed(name, Scene(many, MANY), start)
    return found


def _printed(name: str, scene: Scene, start: float) -> dict[str, float]:
    result = summary(*scene.refined(scene.guess(start)))
    print(
        f"{name:75s} RE mean {result['mean']:.4f} p99 {result['p99']:.4f} max {result['max']:.4f}, "
        f"converged {result['share_converged']:.4f}",
        flush=True,
    )
    return result


def points() -> dict[str, float]:
    """Mean RE of refined points, exact ones and noisy ones."""
    found = {}
    for kappa in (0.025, 0.05, 0.1):
        scene = Scene(Row("O10", "cube8", kappa, HEMISPHERE), RIGS)
        guess, uv = scene.guess(10.0), scene.truth.projection.uv
        noise = torch.randn(uv.shape, generator=scene.random, dtype=uv.dtype)
        for sigma, given in ((0.01, uv), (0.1, uv + 0.1 * noise)):
            estimate = refine_points(guess, Views(given), scene.factory, scene.obj, scene.spread, sigma)
            name = f"kappa {100 * kappa:g} %, {'exact' if sigma < 0.1 else '0.1 px noise'}"
            found[name] = round(float(scene.errors(_found(estimate), slice(None)).mean()), 5)
            print(f"points, O10 cube8, hemisphere, {name}: RE mean {found[name]}")
    return found


def speed() -> dict[str, dict[str, float]]:
    """Milliseconds a rig, from a start of 20 px."""
    scene = Scene(Row("O10", "asymmetric8", 0.05, HEMISPHERE), CHUNK)
    images, guess, given = scene.images(slice(None)), scene.guess(20.0), (scene.factory, scene.obj, scene.spread)
    views = Views(scene.truth.projection.uv)
    cases: dict[str, tuple[int, Callable[[slice], object]]] = {}
    for count in (1, 8, CHUNK):
        cases[f"images, batches of {count}"] = (
            count,
            lambda s: refine_images(Prediction(guess.rig[s], guess.rig_from_object[s]), images[s], *given),
        )
        cases[f"points, batches of {count}"] = (
            count,
            lambda s: refine_points(
                Prediction(guess.rig[s], guess.rig_from_object[s]), Views(views.uv[s]), *given, 0.1
            ),
        )
    found = {}
    for threads in sorted({1, os.cpu_count() or 1}):
        torch.set_num_threads(threads)
        for name, (count, run) in cases.items():
            times = []
            for repeat in range(-3, max(5, CHUNK // count)):
                first = repeat * count % CHUNK
                start = time.perf_counter()
                run(slice(first, first + count))
                if repeat >= 0:
                    times.append(1e3 * (time.perf_counter() - start) / count)
            low, median, high = statistics.quantiles(times, n=4)
            found[f"{name}, {threads} threads"] = {
                "median_ms": round(median, 3),
                "quartiles_ms": [round(low, 3), round(high, 3)],
                "best_ms": round(min(times), 3),
            }
            print(f"{name}, {threads} threads: {median:.2f} ms a rig (best {min(times):.2f})")
    return found


def machine() -> str:
    """Name the processor and the versions, not the host."""
    models = [x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name")]
    name = models[0].split(":")[1].strip() if models else platform.processor()
    return f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}, torch {torch.__version__}"


def main() -> None:
    """Run, print and write the results."""
    load = round(os.getloadavg()[0], 2)  # well above zero: others use the machine, and times are long for that
    print(machine(), "load average", load)
    result = {"machine": machine(), "load_average": load, "speed": speed()}
    torch.set_num_threads(1)
    result |= {"points_re_px": points(), "images_re_px": accuracy()}
    target = Path(__file__).parent / "results" / "refinement.json"
    target.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
