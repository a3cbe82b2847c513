"""Repeat the paper's study of bundle adjustment: ``python -m scripts.results.bundle_adjustment``.

1,000 rigs O6 over cube8 with intrinsics wrong by up to 10 %, one snapshot each. Measures the RE of the factory rig,
after 1 and 25 iterations of imgcal's MAP solver and of a plain bundle adjustment, and of a network if its file is
given; and the seconds for each (for bundle adjustment, without its initialization).
Writes docs/results/bundle_adjustment.json and .png.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate, initial_pose
from imgcal.evaluation import BASELINES, Conditions, Given, network_method, reprojection_error
from imgcal.evaluation.protocol import Sample, draw
from imgcal.geometry import vector_from_rotation
from imgcal.io import load_object, read_rig
from imgcal.networks import load_network
from imgcal.refinement import make_observations, make_prediction
from imgcal.synthesis import PoseRange, RelativeDrift
from imgcal.types import CameraRig, Prediction, pack21
from scripts.output import BLUE, GREEN, GREY, RED, RESULTS, command, figure, surroundings, write_json

Array = NDArray[np.float64]

LEAST_RE = 1e-5  # pixels: smaller values are drawn here
NUMBERS = 15  # per camera in plain bundle adjustment: rotation vector, translation, f, principal point, distortion


@dataclass(frozen=True)
class Options:
    """Compare with bundle adjustment."""

    trials: int = 1000
    plain_trials: int = 200  #: trials of plain bundle adjustment, which is slow: the first ones
    iterations: tuple[int, int] = (1, 25)
    model: Path | None = None  #: network for O6, cube8 (table1-row09)
    out: Path = RESULTS  #: folder of bundle_adjustment.json and .png


@dataclass(frozen=True)
class Column:
    """One method: RE of each trial in pixels, and seconds."""

    re: list[float]
    seconds: list[float]

    def summary(self) -> dict[str, Any]:
        """Return plain values for the result file."""
        quartiles = np.quantile(self.re, (0.0, 0.25, 0.5, 0.75, 1.0)).tolist()
        took = {"seconds_p50": statistics.median(self.seconds)} if self.seconds else {}
        return {"trials": len(self.re), "mean_px": statistics.fmean(self.re), "quartiles_px": quartiles, **took}


def main(arguments: list[str] | None = None) -> None:
    """Run all trials, print and write the results."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    rig, obj = read_rig("O6"), load_object("cube8")
    conditions = Conditions(rig, obj, PoseRange.overhead(), RelativeDrift(0.1, 0.0))
    sample = draw(conditions, options.trials, torch.Generator().manual_seed(0))
    untouched = Prediction(rig.expand(options.trials), sample.truth.rig_from_object)
    columns = {
        "left alone, true pose": Column(_errors(untouched, sample), []),
        "left alone, pose fitted": _each(BASELINES["factory, pose fitted"].predict, sample),
        "start: pose by PnP": _each(pose_by_pnp, sample),
    }
    for count in options.iterations:
        columns[f"MAP, {_times(count)}"] = _map(sample, count)
    for count in options.iterations:
        columns[f"plain BA, {_times(count)}"] = _plain(sample, count, min(options.plain_trials, options.trials))
    if options.model is not None:
        method = network_method(load_network(options.model, rig, obj), batch=1)
        columns["network"] = _each(method.predict, sample)
        refine = method.refine
        assert refine is not None  # every network has a refinement
        columns["network + MAP"] = _each(lambda given: refine(method.predict(given), given).prediction, sample)
    result = surroundings() | {"columns": {name: column.summary() for name, column in columns.items()}}
    for name, row in result["columns"].items():
        print(f"{name:26s} {row['trials']:5d} trials, RE mean {row['mean_px']:.4f} px", row.get("seconds_p50", ""))
    write_json(options.out / "bundle_adjustment.json", result)
    draw_figure(columns, options.out / "bundle_adjustment.png")


def pose_by_pnp(given: Given) -> Prediction:
    """Return the factory rig and a pose by PnP over all cameras: the start of every bundle adjustment here."""
    observations = make_observations(given.uv, given.seen, given.sigma)
    return Prediction(given.factory.expand(len(given.uv)), initial_pose(observations, given.factory, given.obj)[:, 0])


def _times(iterations: int) -> str:
    return f"{iterations} iteration{'s' if iterations > 1 else ''}"


def _each(predict: Callable[..., Prediction], sample: Sample) -> Column:
    """Run a method on one rig at a time."""
    errors, seconds = [], []
    for row in range(len(sample)):
        one = slice(row, row + 1)
        given = sample.given(one)
        start = time.perf_counter()
        found = predict(given)
        seconds.append(time.perf_counter() - start)
        errors += _errors(found, sample, one)
    return Column(errors, seconds)


def _map(sample: Sample, iterations: int) -> Column:
    """Run imgcal's solver for a number of iterations, from the factory rig and a pose by PnP."""
    limits = EstimationOptions(loss="squared", max_iterations=iterations)
    errors, seconds = [], []
    for row in range(len(sample)):
        one = slice(row, row + 1)
        given = sample.given(one)
        observations = make_observations(given.uv, given.seen, given.sigma)
        pose = initial_pose(observations, given.factory, given.obj)
        start = time.perf_counter()
        found = estimate(observations, given.factory, given.obj, pose, prior_std=given.prior_std, options=limits)
        seconds.append(time.perf_counter() - start)
        errors += _errors(make_prediction(found), sample, one)
    return Column(errors, seconds)


def _plain(sample: Sample, iterations: int, trials: int) -> Column:
    """Run bundle adjustment as it is usually written: all parameters free, no prior, numerical derivatives."""
    errors, seconds = [], []
    for row in range(trials):
        given = sample.given(slice(row, row + 1))
        observations = make_observations(given.uv, given.seen, given.sigma)
        pose = initial_pose(observations, given.factory, given.obj)[:, 0]
        start = numbers_of(given.factory.expand(1).from_object(pose)[0])
        points, uv = given.obj.points.numpy(), given.uv[0].numpy()

        def residuals(x: Array, points: Array = points, uv: Array = uv) -> Array:
            return (_projected(x, points) - uv).ravel()

        began = time.perf_counter()
        # scipy also counts the evaluation at the start.
        found = least_squares(residuals, start, x_scale="jac", max_nfev=iterations + 1)
        seconds.append(time.perf_counter() - began)
        errors.append(float(np.sqrt(np.square(found.fun).mean())))  # exact points: their residual is the RE
    return Column(errors, seconds)


def numbers_of(cameras: CameraRig) -> Array:
    """Initial values of plain bundle adjustment: 15 numbers per camera, concatenated."""
    packed = pack21(cameras)
    turn: Tensor = vector_from_rotation(cameras.cam_from_rig.rotation)
    numbers: Array = torch.cat((turn, packed[..., 9:]), dim=-1).numpy().ravel()
    return numbers


def _projected(x: Array, points: Array) -> Array:
    """Project points (N, 3) into every camera: (C, N, 2) pixels."""
    images = []
    for turn, shift, (fx, fy, cx, cy), lens in (
        (camera[:3], camera[3:6], camera[6:10], camera[10:]) for camera in x.reshape(-1, NUMBERS)
    ):
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        images.append(cv2.projectPoints(points, turn, shift, matrix, lens)[0][:, 0])
    return np.stack(images)


def _errors(found: Prediction, sample: Sample, rows: slice = slice(None)) -> list[float]:
    truth = sample.truth.cameras_from_object[rows]
    errors: list[float] = reprojection_error(found.cameras_from_object, truth, sample.conditions.obj).tolist()
    return errors


def draw_figure(columns: dict[str, Column], path: Path) -> None:
    """Draw the RE of all trials as boxes, and the times."""
    colours = {"left": RED, "start": RED, "MAP": BLUE, "plain": GREY, "network": GREEN}
    with figure(path, panels=2, size=(8.5, 3.6)) as (left, right):
        values = [np.maximum(column.re, LEAST_RE) for column in columns.values()]
        boxes = left.boxplot(values, orientation="horizontal", patch_artist=True, flierprops={"markersize": 2})
        for box, name in zip(boxes["boxes"], columns, strict=True):
            box.set(color=next(colour for word, colour in colours.items() if name.startswith(word)), linewidth=3)
        for line in boxes["medians"]:
            line.set_color("white")
        left.set_yticks(range(1, len(columns) + 1), list(columns), fontsize=7)
        left.set(xscale="log", xlabel="RE (px)")
        left.invert_yaxis()
        timed = {name: statistics.median(column.seconds) for name, column in columns.items() if column.seconds}
        bars = right.barh(range(len(timed)), [1e3 * seconds for seconds in timed.values()])
        for bar, name in zip(bars, timed, strict=True):
            bar.set_color(next(colour for word, colour in colours.items() if name.startswith(word)))
        right.set_yticks(range(len(timed)), list(timed), fontsize=7)
        right.set(xscale="log", xlabel="ms a rig, median")
        right.invert_yaxis()


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
