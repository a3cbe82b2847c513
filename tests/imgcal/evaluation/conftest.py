"""A small rig, an object, and random rigs whose views are corrupted."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
import torch
from torch import nn

from imgcal.evaluation import Conditions
from imgcal.evaluation.protocol import Sample, draw
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_rig
from imgcal.synthesis import Corruption, PoseRange, RelativeDrift
from imgcal.types import Prediction

Make = Callable[..., Conditions]


@pytest.fixture(scope="package", autouse=True)
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def conditions() -> Make:
    """Return a function that makes conditions: four cameras, eight fiducials."""

    def make(*, kappa: float = 0.02, rig: str = "T4", **corruption: float) -> Conditions:
        drift = RelativeDrift(kappa, kappa)
        return Conditions(read_rig(rig), load_object("asymmetric8"), drift=drift, corruption=Corruption(**corruption))

    return make


@pytest.fixture(scope="session")
def sample(conditions: Make) -> Callable[..., Sample]:
    """Return a function that draws some rigs."""

    def make(count: int = 5, seed: int = 0, **known: float) -> Sample:
        return draw(conditions(**known), count, torch.Generator().manual_seed(seed))

    return make


def disturbed(truth: Prediction, prior_std: torch.Tensor, scale: float = 0.1, seed: int = 1) -> Prediction:
    """A prediction that is off by a share of the drift, as a network's is."""
    generator = torch.Generator().manual_seed(seed)
    batch = len(truth.rig_from_object.translation)
    step = scale * torch.randn((batch, *prior_std.shape), generator=generator, dtype=prior_std.dtype) * prior_std
    shift = 10 * scale * torch.randn((batch, 3), generator=generator, dtype=prior_std.dtype)
    pose = truth.rig_from_object
    return Prediction(truth.rig.retract(step), RigidTransform(pose.rotation, pose.translation + shift))


class Fake(nn.Module):
    """A network that has learned one pose and no drift: the factory rig, looking straight down at the object."""

    image_options = None

    def __init__(self, conditions: Conditions) -> None:
        super().__init__()
        self.factory = conditions.rig.to(torch.float32)
        self.shift = nn.Parameter(torch.tensor([0.0, 0.0, conditions.rig.working_distance or 0.0]))
        self.calls: list[torch.dtype] = []

    def forward(self, views):
        self.calls.append(views.uv.dtype)
        batch = len(views)
        rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0])).expand(batch, 3, 3)
        prediction = Prediction(self.factory.expand(batch), RigidTransform(rotation, self.shift.expand(batch, 3)))
        return prediction, prediction


def straight_down(conditions: Conditions) -> Conditions:
    """Only the pose that `Fake` knows, but for the object's roll."""
    return replace(conditions, pose_range=PoseRange(theta_deg=(0, 0), phi_deg=(0, 0), alpha_deg=(0, 0)))
