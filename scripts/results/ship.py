"""Copy trained networks into data/models, which ships with the package: bf16 weights, named by kind, rig and object.

Usage: python -m scripts.results.ship out/runs/shipped-points-asymmetric8 out/runs/shipped-vit-asymmetric8 ...
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from imgcal.errors import InputError
from imgcal.evaluation import reprojection_error
from imgcal.networks import Checkpoint, load_checkpoint, save_checkpoint
from imgcal.synthesis import render_views, synthesize
from imgcal.training import RigExperiment, change_experiment, checkpoint_experiment
from imgcal.types import Views
from scripts.output import command, make_folder

MODELS = Path("data/models")
RIGS = 64  # on which both precisions are compared


@dataclass(frozen=True)
class Options:
    """Copy trained networks into the folder that the package ships."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]  #: folders of training runs of shipped-*
    out: Path = MODELS  #: folder of the shipped networks
    trust: tuple[str, ...] = ()  #: your own encoders, package.module:Class, that runs may name; their code is executed


def main(arguments: list[str]) -> None:
    """Write each network with bf16 weights, and print the loss of accuracy."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if not options.runs:
        raise InputError("found no folder of a training run, expected at least one")
    make_folder(options.out)
    for run in options.runs:
        trained = load_checkpoint(run / "model.safetensors", trusted=options.trust)
        experiment = portable(checkpoint_experiment(trained.experiment))
        kind = experiment.name.split("-")[1]
        path = options.out / f"{kind}-{experiment.rig}-{experiment.object}.safetensors"
        save_checkpoint(path, replace(trained, experiment=experiment), torch.bfloat16)
        before, after = error(trained), error(load_checkpoint(path, trusted=options.trust))
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, RE {before:.3f} px, in bf16 {after:.3f} px")


def portable(experiment: RigExperiment) -> RigExperiment:
    """Replace the path of a warm start by the name of its experiment or network."""
    start = experiment.training.init_from
    if start is None:
        return experiment
    names = [_name(path) for path in ([start] if isinstance(start, str) else start)]
    return change_experiment(experiment, f"training.init_from=[{', '.join(names)}]")


def _name(path: str) -> str:
    """Name of the run that made a file, or of a shipped network."""
    if "/" not in path and not path.endswith(".safetensors"):
        return path
    file = Path(path)
    return f"out/runs/{file.parent.name if file.stem == 'model' else file.stem}"


@torch.no_grad()
def error(checkpoint: Checkpoint) -> float:
    """Mean RE of a network on a few random rigs, exact points."""
    network, experiment = checkpoint.network, checkpoint.experiment
    factory, generator = checkpoint.rig.to(torch.float32), torch.Generator().manual_seed(0)
    drift, poses = experiment.drift, experiment.poses
    made = synthesize(factory, checkpoint.obj, RIGS, generator, drift=drift, pose_range=poses)
    uv, seen = made.projection.uv, made.projection.visible
    views = Views(uv=uv, seen=seen)
    options = network.image_options
    if options is not None:
        images = render_views(uv, seen, factory.image_size, checkpoint.obj, options, quantise=True)
        views = Views(images=images)
    predicted = network(views)[-1]
    truth = made.rig.from_object(made.rig_from_object)
    return float(reprojection_error(predicted.cameras_from_object, truth, checkpoint.obj).mean())


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
