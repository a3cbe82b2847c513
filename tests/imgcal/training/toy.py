"""Tiny networks with the interface of the real ones; `python -m tests.imgcal.training.toy train ...` trains them."""

import shutil

import torch
from torch import nn

from imgcal.cli.main import run as command
from imgcal.cli.training_folder import train_in
from imgcal.geometry import RigidTransform, rotation_from_6d
from imgcal.networks import Network, Parameterization, factory, use_generators
from imgcal.synthesis import ImageOptions
from imgcal.training import engine, load_experiment
from imgcal.training.engine import save
from imgcal.types import PARAMETERS, Prediction

EXPERIMENT = """
format: imgcal-experiment/1
name: toy
rig: T4
object: asymmetric8
poses: {theta_deg: [0, 0], phi_deg: [0, 0]}
drift: {kappa_intrinsics: 0.01, kappa_extrinsics: 0.01}
network: {preset: points}
optimizer: {lr: 3.0e-3}
training:
  steps: 60
  batch_size: 12
  log_every: 10
  validate_every: 30
  validation_rigs: 30
  save_every: 20
  device: cpu
  threads: 1
"""


class Toy(Network):
    """Two passes of one small network on the points; dropout draws from the default generator.

    Nothing depends on `idle`.
    """

    takes: ImageOptions | None = None
    width = 24

    def __init__(self, config, factory, obj, drift_std, generator, images=None):
        super().__init__(Parameterization(factory, obj, drift_std), self.takes and (images or self.takes))
        self.register_buffer("prior_std", drift_std, persistent=False)
        self.idle = nn.Parameter(torch.zeros(2))
        with use_generators(generator):
            self.make_layers(factory, obj)

    def make_layers(self, factory, obj):
        inputs = (
            factory.num_cameras * obj.num_fiducials * 2 if self.image_options is None else factory.num_cameras * 3 * 4
        )
        self.trunk = nn.Sequential(nn.Linear(inputs, self.width), nn.Tanh(), nn.Dropout(0.1))
        self.head = nn.Linear(self.width, factory.num_cameras * PARAMETERS + 9)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def parameter_groups(self):
        return {"trunk": self.trunk.parameters(), "heads": self.head.parameters()}

    def forward(self, views):
        if self.image_options is None:
            inputs = (views.uv / 1000 - 0.5).flatten(1)
        else:
            inputs = nn.functional.adaptive_avg_pool2d(views.images.flatten(1, 2), 2).flatten(1)
        return tuple(self.decoded(self.head(self.trunk(scale * inputs)).float()) for scale in (0.5, 1.0))

    @torch.autocast("cpu", enabled=False)
    def decoded(self, numbers):
        steps = numbers[:, :-9].unflatten(1, (self.factory.num_cameras, PARAMETERS)) * self.prior_std
        sixd = numbers[:, -9:-3] + numbers.new_tensor([1.0, 0, 0, 0, -1, 0])
        shift = 10 * numbers[:, -3:] + numbers.new_tensor([0, 0, self.factory.working_distance])
        rig = self.factory.expand(len(numbers)).retract(steps)
        return Prediction(rig, RigidTransform(rotation_from_6d(sixd), shift))


class ToyOfImages(Toy):
    takes = ImageOptions(size=16, dot=1.0)


def experiments(folder):
    """Return a function that makes the toy's experiment with some values changed."""

    def make(*changes):
        path = folder / "toy.yaml"
        path.write_text(EXPERIMENT)
        return load_experiment(path, changes)

    return make


def train(experiment, folder, resume=False, should_stop=lambda: False):
    """Train in a folder, as the command does."""
    return train_in(folder, experiment, resume, should_stop)


def save_and_compare(run, told):
    """Save, keep a copy of the folder as it is now, and make sure that all processes hold the same weights."""
    save(run, told)
    if run.accelerator.is_main_process:
        shutil.copytree(told.folder, f"{told.folder}-{run.step}")
    copies = run.accelerator.gather(run.plain.head.weight.detach()[None].clone())
    assert (copies == copies[0]).all()


if __name__ == "__main__":
    factory.build = Toy
    engine.save = save_and_compare
    command()
