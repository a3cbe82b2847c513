"""The object's pose by a rig that is held, against the estimate with a prior of no width."""

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import EstimationOptions, estimate, fit_pose
from imgcal.geometry import RigidTransform
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations


@pytest.mark.parametrize("radius", [None, 8.0])
def test_the_pose_is_that_of_an_estimate_of_a_rig_that_is_held(radius) -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(2)
    truth = simulate_truth(factory, obj, 1, generator, PhysicalDrift())
    sizes = None if radius is None else torch.full((8,), radius, dtype=torch.float64)
    obj = imgcal.CalibrationObject(obj.points, obj.colours, radius=sizes)
    uv = truth.uv + 0.1 * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    uv[0, 2, 3] += 40.0  # a wrong label
    seen = torch.rand(uv.shape[:-1], generator=generator) > 0.2
    observations = Observations(uv, torch.full(seen.shape, 0.3, dtype=torch.float64), seen)
    guess = RigidTransform(truth.rig_from_object.rotation, truth.rig_from_object.translation + 15.0)
    options = EstimationOptions(loss="cauchy")
    expected = estimate(
        observations, factory, obj, guess, prior_std=torch.zeros(4, 15, dtype=torch.float64), options=options
    )
    found = fit_pose(observations, factory, obj.points, sizes, guess, options)
    torch.testing.assert_close(found.rig_from_object.rotation, expected.rig_from_object.rotation, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        found.rig_from_object.translation, expected.rig_from_object.translation, rtol=0, atol=0.05
    )
    torch.testing.assert_close(torch.from_numpy(found.residual)[None], expected.residual, rtol=0, atol=0.05)


def test_too_few_labels_are_refused() -> None:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    nothing = Observations(
        torch.zeros(1, 4, 8, 2).double(), torch.ones(1, 4, 8).double(), torch.zeros(1, 4, 8, dtype=torch.bool)
    )
    there = RigidTransform.identity(dtype=torch.float64).reshape(1)
    with pytest.raises(RefusedError, match="do not determine"):
        fit_pose(nothing, factory, obj.points, None, there)


def test_shapes_that_do_not_fit_are_refused() -> None:
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    seen = Observations(
        torch.zeros(1, 4, 8, 2).double(), torch.ones(1, 4, 8).double(), torch.ones(1, 4, 8, dtype=torch.bool)
    )
    guess = RigidTransform.identity(1, dtype=torch.float64)
    for points, radius, other in (
        (obj.points[:5], None, rig),
        (obj.points, torch.ones(1).double(), rig),
        (obj.points, None, rig.select([0, 1])),
        (obj.points, None, replace(rig, focal_length=rig.focal_length[:1])),
    ):
        with pytest.raises(InputError, match="shape"):
            fit_pose(seen, other, points, radius, guess)
