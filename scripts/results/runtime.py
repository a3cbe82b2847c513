"""Measure the paper's runtime figure: ``python -m scripts.results.runtime`` writes docs/results/runtime.json and .png.

Left: one camera calibrated by OpenCV, over the numbers of images and of Levenberg-Marquardt iterations. Right: a whole
rig of 2 to 1024 cameras from one snapshot, by networks and by network + MAP refinement. Networks are untrained, since
the time does not depend on weights. Refinement starts with an error of 10 px, about that of a trained network.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor, nn

from imgcal import networks
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.networks import NetworkConfig
from imgcal.refinement import refine_points
from imgcal.synthesis import PhysicalDrift, Snapshots, synthesize
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views
from scripts.output import BLUE, GREEN, GREY, RED, RESULTS, command, figure, surroundings, write_json

DRIFT = PhysicalDrift()
NOISE = 0.05  # px, of OpenCV's points and of the refinement's


@dataclass(frozen=True)
class Options:
    """Measure calibration and inference times."""

    images: tuple[int, ...] = (10, 20, 50, 100, 200, 300, 1000, 3000)  #: numbers of images for OpenCV
    iterations: tuple[int, ...] = (
        1,
        2,
        5,
        10,
        20,
        30,
        50,
    )  #: for OpenCV, on `iteration_images` images
    iteration_images: int = 100
    cameras: tuple[int, ...] = tuple(2**i for i in range(1, 11))  #: numbers of cameras in our rigs
    limit: float = 20.0  #: s; a curve ends with the first point that takes longer
    repeats: int = 20  #: repetitions of our measurements, fewer for slow ones
    out: Path = RESULTS  #: folder of runtime.json and runtime.png


def main(arguments: list[str] | None = None) -> None:
    """Measure, print and write the results."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    result: dict[str, Any] = surroundings("cuda" if torch.cuda.is_available() else "cpu")
    views = opencv_views(max(*options.images, options.iteration_images))
    result["opencv_images"] = _curve(options.images, options.limit, lambda n: opencv(views, n))
    some = options.iteration_images
    result["opencv_iterations"] = _curve(options.iterations, options.limit, lambda n: opencv(views, some, n))
    result["iteration_images"] = some
    for device in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        rows = _curve(options.cameras, options.limit, lambda n, to=device: ours(n, to, options.repeats))  # type: ignore[misc]
        result[f"ours_{device}"] = rows
    write_json(options.out / "runtime.json", result)
    draw(result, options.out / "runtime.png")


@dataclass(frozen=True)
class CameraViews:
    """Views of one camera, for OpenCV."""

    points: NDArray[np.float32]  # (N, 3) mm
    uv: list[NDArray[np.float32]]  # (N, 2) pixels for each image
    size: tuple[int, int]
    matrix: NDArray[np.float64]  # factory camera matrix
    distortion: NDArray[np.float64]  # (5,) factory values


def opencv_views(images: int) -> CameraViews:
    """Simulate views of cube8 by one drifted camera of O10 from all over the hemisphere."""
    rig, obj, generator = read_rig("O10"), load_object("cube8"), torch.Generator().manual_seed(0)
    drifted = DRIFT.apply(rig, generator)
    made = synthesize(drifted, obj, images, generator, drift=None)
    uv = made.projection.uv[:, 0]
    uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
    (fx, fy), (cx, cy) = rig.focal_length[0].tolist(), rig.principal_point[0].tolist()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    width, height = rig.image_size[0].tolist()
    each = [one.numpy().astype(np.float32) for one in uv]
    return CameraViews(obj.points.numpy().astype(np.float32), each, (width, height), matrix, rig.distortion[0].numpy())


def opencv(views: CameraViews, images: int, iterations: int | None = None) -> dict[str, float]:
    """Calibrate one camera; with a given number of iterations, do not stop at convergence."""
    kind = cv2.TERM_CRITERIA_COUNT if iterations else cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS
    criteria = (kind, iterations or 30, 0.0 if iterations else float(np.finfo(np.float64).eps))  # OpenCV's default
    given = ([views.points] * images, views.uv[:images], views.size)

    def calibrate() -> float:
        start = (views.matrix.copy(), views.distortion.copy())
        return float(cv2.calibrateCamera(*given, *start, flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=criteria)[0])

    return {"s": median(calibrate, repeats=5), "rms_px": calibrate()}


def ring(cameras: int) -> CameraRig:
    """Make a ring of any number of cameras like O10's first one."""
    base = read_rig("O10")
    angle = torch.arange(cameras, dtype=torch.float64) * (2 * torch.pi / cameras)
    turn = rotation_from_vector(torch.stack((0 * angle, 0 * angle, angle), dim=-1))
    place = base.cam_from_rig[0]
    cam_from_rig = RigidTransform(turn @ place.rotation @ turn.mT, turn @ place.translation)

    def repeated(tensor: Tensor) -> Tensor:
        return tensor[:1].repeat(cameras, 1)

    return replace(
        base,
        focal_length=repeated(base.focal_length),
        principal_point=repeated(base.principal_point),
        distortion=repeated(base.distortion),
        cam_from_rig=cam_from_rig,
        image_size=repeated(base.image_size),
        camera_names=tuple(f"cam{number + 1:04d}" for number in range(cameras)),
        name=f"ring{cameras}",
    )


def ours(cameras: int, device: str, repeats: int) -> dict[str, float]:
    """Time networks and refinement on one snapshot of one rig; medians in seconds."""
    rig, obj = ring(cameras), load_object("cube8")
    made = unhindered(rig, obj)
    prior_std = DRIFT.std(rig)
    uv, seen = made.projection.uv, torch.ones_like(made.projection.visible)
    views = Views(uv.to(device, torch.float32), seen.to(device))
    guess = nearby(made)
    given = Views(uv, seen)
    found = {}
    for preset in ("points", "paper-points"):
        network = networks.build(
            NetworkConfig(preset=preset), rig.to(torch.float32), obj, prior_std.float(), torch.Generator()
        )
        network = network.to(device).eval()
        found[f"{preset}_s"] = median(lambda net=network: forward(net, views), repeats)  # type: ignore[misc]
    found["refinement_s"] = median(lambda: refine_points(guess, given, rig, obj, prior_std, NOISE), repeats)
    found["points_refined_s"] = found["points_s"] + found["refinement_s"]
    return found


def unhindered(rig: CameraRig, obj: CalibrationObject) -> Snapshots:
    """Draw one rig with small drift that sees the whole object; the time is the same."""
    few = replace(DRIFT, principal_point=1.0, rotation_deg=0.05)
    return synthesize(rig, obj, 1, torch.Generator().manual_seed(0), drift=few)


def nearby(made: Snapshots) -> Prediction:
    """Start of a refinement: the object is shifted by a few millimetres, about 10 px in the images."""
    pose = made.rig_from_object
    return Prediction(made.rig, RigidTransform(pose.rotation, pose.translation + 5.0))


@torch.no_grad()
def forward(network: nn.Module, views: Views) -> None:
    """Predict one rig and wait for the result."""
    prediction: Prediction = network(views)[-1]
    prediction.to(torch.float64, "cpu")


def median(run: Callable[[], object], repeats: int, patience: float = 5.0) -> float:
    """Median time of `repeats` calls after a warm-up, fewer if they would take longer than `patience` (s)."""
    took: list[float] = []
    began = time.perf_counter()
    for number in range(repeats + 2):
        start = time.perf_counter()
        run()
        if number >= 2 or time.perf_counter() - began > patience:
            took.append(time.perf_counter() - start)
        if time.perf_counter() - began > patience:
            break
    return statistics.median(took)


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw all curves, the paper's three and ours."""
    with figure(path, panels=2, size=(8.5, 3.6)) as (left, right):
        images, rounds = result["opencv_images"], result["opencv_iterations"]
        left.plot([row["n"] for row in images], [row["s"] for row in images], "o-", color=RED, label="images")
        label = f"iterations, {result['iteration_images']} images"
        left.plot([row["n"] for row in rounds], [row["s"] for row in rounds], "o-", color=BLUE, label=label)
        left.set(xlabel="number", ylabel="seconds", xscale="log", yscale="log", title="OpenCV, 1 camera")
        left.legend(fontsize=7)
        curves = [("points_s", "our network", GREEN), ("points_refined_s", "our network + refinement", BLUE)]
        curves.append(("paper-points_s", "the paper's network", GREY))
        for device, style in (("cpu", "-"), ("cuda", "--")):
            rows = result.get(f"ours_{device}", [])
            for name, text, colour in curves if rows else ():
                seconds = [row[name] for row in rows]
                cameras = [row["n"] for row in rows]
                right.plot(cameras, seconds, style, color=colour, marker=".", label=f"{text}, {device}")
        right.set(xlabel="cameras", yscale="log", title="one rig, one snapshot")
        right.set_xscale("log", base=2)
        right.legend(fontsize=7)


def _curve(
    numbers: tuple[int, ...], limit: float, measure: Callable[[int], dict[str, float]]
) -> list[dict[str, float]]:
    """Measure until a point takes longer than the limit."""
    rows = []
    for number in numbers:
        began = time.perf_counter()
        row = measure(number)
        rows.append({"n": number, **row})
        print("  ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
        if time.perf_counter() - began > limit:
            break
    return rows


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
