"""Tiny networks with the interface of the real ones; `python -m tests.imgcal.training.toy train ...` trains them."""

import torch
from torch import nn

from imgcal import networks
from imgcal.cli.main import run as command
from imgcal.geometry.rotations import rotation_from_6d
from imgcal.geometry.transforms import RigidTransform
from imgcal.synthesis.colour_coding import ImageOptions
from imgcal.training import engine
from imgcal.training.engine import save
from imgcal.types.prediction import Prediction
from imgcal.types.rig import PARAMETERS

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


class Toy(nn.Module):
    """Two passes of one small network on the points; dropout draws from the default generator."""

    image_options: ImageOptions | None = None
    width = 24

    def __init__(self, config, factory, obj, drift_std):
        super().__init__()
        self.config, self.factory, self.obj = config, factory, obj
        self.register_buffer("prior_std", drift_std)
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
    image_options = ImageOptions(size=16, dot=1.0)


def save_and_compare(run, metrics):
    """Save, and make sure that all processes hold the same weights."""
    save(run, metrics)
    copies = run.accelerator.gather(run.plain.head.weight.detach()[None].clone())
    assert (copies == copies[0]).all()


if __name__ == "__main__":
    networks.build = Toy
    engine.save = save_and_compare
    command()
