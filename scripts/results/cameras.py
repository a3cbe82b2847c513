"""Draw true and predicted cameras in 3D, to turn around in a browser: ``python -m scripts.results.cameras``.

Several random rigs on the hemisphere over the object: true cameras blue, predicted red, the first of each rig yellow.
Writes out/results/cameras.html, which needs nothing else (plotly is inside: some megabytes).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import plotly.graph_objects as go
import torch
import tyro
from torch import Tensor

from imgcal.errors import InputError
from imgcal.evaluation import BASELINES, Conditions, Given, Method, load_models, reprojection_error
from imgcal.evaluation.protocol import draw
from imgcal.io import load_object, load_rig, write_text
from imgcal.synthesis import RelativeDrift
from imgcal.training import experiment_of
from imgcal.types import CameraRig, Prediction
from scripts.output import ROOT, command, make_folder

AXIS = 60.0  # mm, length of the line that shows where a camera looks
TRUE, PREDICTED, FIRST, FIDUCIALS = "#2563eb", "#dc2626", "#facc15", "#333333"


@dataclass(frozen=True)
class Options:
    """Draw cameras in 3D."""

    model: Path | None = None  #: a trained network; none = the factory rig with the object's pose fitted
    refined: bool = False  #: refine what it predicts
    rig: str = "O10"  #: without a model
    object: str = "sphere64"  #: without a model
    count: int = 6  #: rigs
    seed: int = 0
    out: Path = ROOT / "out" / "results" / "cameras.html"  #: file to write


def main(arguments: list[str] | None = None) -> None:
    """Predict, draw, write."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if options.count < 1:
        raise InputError(f"--count: found {options.count}, expected at least 1")
    conditions, method, name = _chosen(options)
    sample = draw(conditions, options.count, torch.Generator().manual_seed(options.seed))
    given = sample.given()
    found = predict(method, given, options.refined)
    truth, cameras = sample.truth.cameras_from_object, found.cameras_from_object
    error = float(reprojection_error(cameras, truth, conditions.obj).mean())
    title = f"{conditions.rig.name}, {conditions.obj.name}: {name}, RE {error:.3g} px"
    make_folder(options.out.parent)
    write_text(options.out, scene(truth, cameras, conditions.obj.points, title).to_html(include_plotlyjs=True))
    print(f"{title}: {options.out}")


def predict(method: Method, given: Given, refined: bool) -> Prediction:
    """Predict, and refine if asked to."""
    found = method.predict(given)
    return method.refine(found, given) if refined and method.refine is not None else found


def scene(truth: CameraRig, predicted: CameraRig, fiducials: Tensor, title: str) -> go.Figure:
    """Draw cameras (B, C) in the object's frame, and the object (N, 3)."""
    traces = [_dots("fiducials", fiducials, FIDUCIALS, 3)]
    for name, cameras, colour, size in (("true", truth, TRUE, 6), ("predicted", predicted, PREDICTED, 4)):
        traces.append(_axes(name, cameras, colour))
        traces.append(_dots(f"{name} cameras", cameras.positions[:, 1:].flatten(0, 1), colour, size))
    traces.append(_dots("first cameras, true", truth.positions[:, 0], FIRST, 7))
    traces.append(_dots("first cameras, predicted", predicted.positions[:, 0], FIRST, 4, PREDICTED))
    layout = go.Layout(
        title={"text": title},
        scene={"aspectmode": "data", **{f"{axis}axis": {"title": {"text": f"{axis} (mm)"}} for axis in "xyz"}},
        margin={"l": 0, "r": 0, "b": 0, "t": 40},
    )
    return go.Figure(traces, layout)


def _chosen(options: Options) -> tuple[Conditions, Method, str]:
    if options.model is None:
        rig, obj = load_rig(options.rig), load_object(options.object)
        name = "factory, pose fitted"
        return Conditions(rig, obj, drift=RelativeDrift()), BASELINES[name], name
    [model] = load_models([options.model])
    name = experiment_of(model.checkpoint.experiment).name + (" + refinement" if options.refined else "")
    return model.conditions, model.method, name


def _dots(name: str, points: Tensor, colour: str, size: int, edge: str = "#ffffff") -> go.Scatter3d:
    x, y, z = points.round(decimals=2).T.tolist()
    marker = {"size": size, "color": colour, "line": {"color": edge, "width": 1}}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker)


def _axes(name: str, cameras: CameraRig, colour: str) -> go.Scatter3d:
    """Lines from the cameras along their optical axes; None separates them."""
    starts = cameras.positions.flatten(0, 1)
    ends = starts + AXIS * cameras.cam_from_rig.rotation[..., 2, :].flatten(0, 1)
    rows = torch.stack((starts, ends), dim=1).round(decimals=2).tolist()
    x, y, z = ([value for pair in rows for value in (pair[0][axis], pair[1][axis], None)] for axis in range(3))
    line = {"color": colour, "width": 2}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", name=f"{name} axes", line=line, hoverinfo="skip", showlegend=False)


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
