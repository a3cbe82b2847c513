"""From numbers to rigs: the paper's 18 numbers a camera, our offsets and poses, and cameras split into rig and pose."""

import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.networks import Parameterization
from imgcal.networks.parameterization import POSE_SHIFT
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.types import Prediction, pack21
from imgcal.types.parameter_vectors import pack18
from tests.imgcal.lensed import KINDS, lensed

DRIFT = RelativeDrift(0.03, 0.03)
B, C = 3, 4


@pytest.fixture
def parameterization():
    """In float64, to compare exactly."""
    rig = read_rig("T4")
    return Parameterization(rig, load_object("asymmetric8"), DRIFT.std(rig)).double()


@pytest.fixture
def truth(parameterization):
    made = synthesize(
        parameterization.factory, load_object("asymmetric8"), B, torch.Generator().manual_seed(1), drift=DRIFT
    )
    return Prediction(made.rig, made.rig_from_object)


def test_the_18_numbers_are_scaled_by_those_of_the_rig(parameterization, truth):
    numbers = pack18(truth.cameras_from_object)
    numbers[..., :6] -= numbers.new_tensor([1.0, 0, 0, 0, 1, 0])
    numbers[..., 6:9] /= parameterization.working_distance
    numbers[..., 9:11] /= parameterization.focal_length.mean()
    numbers[..., 11:13] /= parameterization.principal_point.mean(0)
    found = parameterization.absolute(numbers).cameras_from_object
    torch.testing.assert_close(pack21(found), pack21(truth.cameras_from_object))


@pytest.mark.parametrize("lens", KINDS)
def test_coefficients_that_a_lens_does_not_have_stay_zero(lens):
    rig = lensed(read_rig("T4"), lens)
    parameterization = Parameterization(rig, load_object("asymmetric8"), DRIFT.std(rig)).double()
    assert sum(parameterization.widths.values()) == 13 + rig.distortion.shape[-1]
    numbers = torch.ones(B, C, 13 + rig.distortion.shape[-1], dtype=torch.float64)
    found = parameterization.absolute(numbers).rig
    assert torch.equal(found.distortion, rig.has_coefficient.double().expand(B, -1, -1))
    assert found.lens_models == rig.lens_models


def test_cameras_of_the_factory_rig_are_split_into_that_rig_and_the_pose(parameterization, truth):
    pose = truth.rig_from_object
    found = Prediction.from_cameras(parameterization.factory.from_object(pose), parameterization.factory)
    torch.testing.assert_close(found.rig_from_object.rotation, pose.rotation)
    torch.testing.assert_close(found.rig_from_object.translation, pose.translation)
    assert found.rig.local(parameterization.factory).abs().max() < 1e-6


def test_splitting_leaves_cameras_where_they_are(parameterization, truth):
    found = Prediction.from_cameras(truth.cameras_from_object, parameterization.factory)
    torch.testing.assert_close(pack21(found.cameras_from_object), pack21(truth.cameras_from_object))


def test_offsets_are_in_units_of_the_spread_and_poses_are_about_the_centroid(parameterization):
    random = torch.Generator().manual_seed(2)
    offsets = torch.randn(B, C, 15, generator=random, dtype=torch.float64)
    pose = 0.1 * torch.randn(B, 9, generator=random, dtype=torch.float64)
    state = parameterization.start(offsets, pose)
    prediction = parameterization.prediction(state)
    torch.testing.assert_close(
        prediction.rig.local(parameterization.factory), offsets * parameterization.prior_std, atol=1e-8, rtol=1e-6
    )
    at = pose[:, 6:] * POSE_SHIFT + pose.new_tensor([0.0, 0.0, parameterization.working_distance])
    torch.testing.assert_close(prediction.rig_from_object.apply(parameterization.centroid[None])[:, 0], at)
    step = torch.randn(B, 6, generator=random, dtype=torch.float64)
    moved = parameterization.prediction(parameterization.move(state, -offsets, step))
    assert moved.rig.local(parameterization.factory).abs().max() < 1e-6
    there = moved.rig_from_object.apply(parameterization.centroid[None])[:, 0]
    torch.testing.assert_close(there, at + POSE_SHIFT * step[:, 3:])


def test_an_untrained_pose_is_a_level_object_at_the_working_distance(parameterization):
    pose = parameterization.prediction(
        parameterization.start(torch.zeros(B, C, 15).double(), torch.zeros(B, 9).double())
    ).rig_from_object
    overhead = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)).expand(B, 3, 3)
    torch.testing.assert_close(pose.rotation, overhead)


def test_positions_become_numbers_of_about_one(parameterization, truth):
    uv = truth.rig.project(truth.rig_from_object.apply(load_object("asymmetric8").points)).uv
    numbers = parameterization.normalize(uv)
    assert numbers.shape == uv.shape
    assert 0.3 < numbers.std() < 3


def test_some_rigs_of_a_batch(truth):
    turned = RigidTransform(
        rotation_from_vector(torch.eye(3, dtype=torch.float64)) @ truth.rig_from_object.rotation,
        truth.rig_from_object.translation,
    )
    whole = Prediction(truth.rig, turned, torch.arange(B * C * 8.0).view(B, C, 8))
    for rows in (slice(1, 3), torch.tensor([2, 0])):
        part = whole[rows]
        assert torch.equal(part.rig.focal_length, truth.rig.focal_length[rows])
        assert torch.equal(part.rig_from_object.rotation, turned.rotation[rows])
        assert torch.equal(part.log_sigma, whole.log_sigma[rows])
    assert truth[:1].log_sigma is None
