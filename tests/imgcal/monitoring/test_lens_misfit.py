"""A lens that differs from its model beyond the labels that determined it is told from a camera that has moved."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.monitoring import RigFilter
from imgcal.monitoring.case import Case
from imgcal.monitoring.explanations import weigh
from imgcal.monitoring.lens_misfit import MISFIT, LensMisfit, widen_distortion
from imgcal.types import DriftRate, Observations, RigPrior

CAMERA, NOISE, MIDDLE = 2, 0.1, 0.5
"""The camera with the lens; px; the part of its image's half width in which it has seen the object."""


def seen(rig, poses, obj, generator):
    image = rig.expand(len(poses.translation)).project_values(poses.apply(obj.points), obj.radius)
    uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
    return Observations(uv, torch.full(image.visible.shape, NOISE, dtype=torch.float64), image.visible)


def far(rig, poses, obj):
    """Largest distance from the middle of the camera's image, in half widths: (S,)."""
    uv = rig.expand(len(poses.translation)).project_values(poses.apply(obj.points), obj.radius).uv[:, CAMERA]
    size = rig.image_size[CAMERA].double()
    return ((uv - size / 2) / (size / 2)).norm(dim=-1).amax(-1)


@pytest.fixture(scope="module")
def followed():
    """A filter whose camera has seen the object in the middle of its image only."""
    rig, obj, generator = read_rig("room10"), load_object("asymmetric8"), torch.Generator().manual_seed(3)
    rig = replace(rig.to(torch.float64), prior=RigPrior(distortion=0.1))
    count = 3000
    place = torch.tensor([3000.0, 3000.0, 1500.0]) * (2 * torch.rand(count, 3, generator=generator).double() - 1)
    poses = RigidTransform(rotation_from_vector(torch.randn(count, 3, generator=generator).double()),
                           place.double() + torch.tensor([0.0, 0.0, 1200.0]).double())  # fmt: skip
    away = far(rig, poses, obj)
    visible = rig.expand(count).project_values(poses.apply(obj.points), obj.radius).visible[:, CAMERA].all(-1)
    follows = RigFilter(rig, obj, DriftRate(0.0, 0.0, 0.0, 0.0, 0.0))
    middle = np.flatnonzero((visible & (away < MIDDLE)).numpy())[:60]
    edge = np.flatnonzero((visible & (away > 1.2)).numpy())
    for s in middle:
        follows.update(seen(rig, poses[s : s + 1], obj, generator), poses[s : s + 1], 1 / 60)
    return rig, obj, generator, follows.belief, poses, edge


def weakest(belief):
    """The direction of the distortion (K,) that the snapshots determine worst, one standard deviation long."""
    width = belief.rig.num_parameters
    own = slice(CAMERA * width + 10, (CAMERA + 1) * width)
    values, vectors = torch.linalg.eigh(torch.cholesky_inverse(belief.factor)[own, own])
    return values[-1].sqrt() * vectors[:, -1] * belief.unit[CAMERA, 10:]


def verdict(followed, step):
    """Weigh three snapshots near the border of the image, taken after a step (C, K) of the cameras."""
    rig, obj, generator, belief, poses, edge = followed
    snapshots = [(seen(rig.retract(step), poses[s : s + 1], obj, generator), poses[s : s + 1]) for s in edge[:3]]
    return weigh(Case(belief, snapshots, [1 / 60] * 3, 3, cameras=(CAMERA,)))


def test_a_lens_that_differs_beyond_what_was_seen_has_not_moved(followed) -> None:
    step = torch.zeros_like(followed[3].unit)
    step[CAMERA, 10:] = 5 * weakest(followed[3])
    found = verdict(followed, step)
    assert found.best.name == LensMisfit.name
    assert found.best.evidence > found.evidence("moved") + 5
    step = torch.zeros_like(followed[3].unit)
    step[CAMERA, 0] = np.deg2rad(0.1)
    assert verdict(followed, step).best.name == "moved"


def test_only_the_distortion_of_that_camera_is_less_certain(followed) -> None:
    belief = followed[3]
    ratio = widen_distortion(belief, [CAMERA]).std() / belief.std()
    other = torch.ones_like(ratio, dtype=torch.bool)
    other[CAMERA, 10:] = False
    assert torch.allclose(ratio[other], torch.ones(()).double(), rtol=1e-4)
    assert torch.allclose(ratio[CAMERA, 10:], torch.tensor(MISFIT).double(), rtol=1e-4)
