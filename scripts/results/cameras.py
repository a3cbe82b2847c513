"""Draw true and predicted cameras in 3D, for a browser: ``python -m scripts.results.cameras``.

Several random rigs on the hemisphere over the object: true cameras blue, predicted ones red.
Writes out/results/cameras.html, a self-contained page.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import torch
import tyro
from torch import Tensor

from imgcal.errors import InputError
from imgcal.evaluation import BASELINES, Conditions, Given, Method, load_models, reprojection_error
from imgcal.evaluation.protocol import draw
from imgcal.io import load_object, read_rig, write_text
from imgcal.live_page import to_json
from imgcal.report import DrawnRig, rig_scene, rig_view_script
from imgcal.synthesis import RelativeDrift
from imgcal.training import checkpoint_experiment
from imgcal.types import CameraRig, Prediction
from scripts.output import ROOT, command, make_folder

PAGE = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
:root {{ --page: #fff; --ink: #1b1f24; --muted: #626b75; --line: #e1e4e7; }}
:root {{ --ghost: #2563eb; --after: #dc2626; --before: #aaa; }}
body {{ font: 15px sans-serif; margin: 20px; }} canvas {{ width: 100%; height: 88vh; }}
</style>
<h1>{title}</h1><p>Blue: true cameras. Red: predicted. Drag to turn, Ctrl and the wheel to zoom.</p>
<div><canvas tabindex="0"></canvas></div>
<script>{script}</script><script>new RigView(document.querySelector("canvas")).set({scene});</script>
</html>
"""


@dataclass(frozen=True)
class Options:
    """Draw cameras in 3D."""

    model: Path | None = None  #: a trained network; None = the factory rig with the object's pose fitted
    refined: bool = False  #: refine its prediction
    rig: str = "O10"  #: without a model
    object: str = "sphere64"  #: without a model
    count: int = 6  #: rigs
    seed: int = 0
    out: Path = ROOT / "out" / "results" / "cameras.html"  #: file to write


def main(arguments: list[str] | None = None) -> None:
    """Predict, draw and write the page."""
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
    write_text(options.out, drawn(truth, cameras, conditions.obj.points, title))
    print(f"{title}: {options.out}")


def predict(method: Method, given: Given, refined: bool) -> Prediction:
    """Predict, and refine if `refined`."""
    found = method.predict(given)
    return method.refine(found, given).prediction if refined and method.refine is not None else found


def drawn(truth: CameraRig, predicted: CameraRig, fiducials: Tensor, title: str) -> str:
    """Make a page of cameras (B, C) in the object's frame, and the object (N, 3)."""
    rigs = [DrawnRig("true", "--ghost", (_one_rig(truth),)), DrawnRig("predicted", "--after", (_one_rig(predicted),))]
    scene = to_json(rig_scene(rigs, fiducials[None].double().numpy()))
    return PAGE.format(title=escape(title), script=rig_view_script(), scene=scene)


def _one_rig(cameras: CameraRig) -> CameraRig:
    """Collect all cameras (B, C) in one rig; names include the rig's number."""
    count = cameras.batch_shape[0]
    flat = cameras.map_tensors(lambda tensor, axes: tensor.flatten(0, 1).unflatten(0, (1, -1)))[0]
    names = tuple(f"{rig + 1} {name}" for rig in range(count) for name in cameras.camera_names)
    return replace(flat, image_size=cameras.image_size.repeat(count, 1), camera_names=names)


def _chosen(options: Options) -> tuple[Conditions, Method, str]:
    if options.model is None:
        rig, obj = read_rig(options.rig), load_object(options.object)
        name = "factory, pose fitted"
        return Conditions(rig, obj, drift=RelativeDrift()), BASELINES[name], name
    [model] = load_models([options.model])
    name = checkpoint_experiment(model.checkpoint.experiment).name + (" + refinement" if options.refined else "")
    return model.conditions, model.method, name


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
