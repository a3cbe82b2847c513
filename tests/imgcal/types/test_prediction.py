"""Inputs and outputs of networks: cameras in the object's frame, split and recombined."""

import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.types import Prediction, Views

B, C, N = 3, 10, 8


@pytest.fixture(scope="module")
def made(o10, asymmetric8):
    return synthesize(o10, asymmetric8, B, torch.Generator().manual_seed(0), drift=RelativeDrift(0.02, 0.02))


@pytest.fixture(scope="module")
def prediction(made) -> Prediction:
    log_sigma = torch.randn(B, C, N, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return Prediction(made.rig, made.rig_from_object, log_sigma)


def tensors(prediction: Prediction) -> list[torch.Tensor]:
    rig, pose = prediction.rig, prediction.rig_from_object
    return [rig.focal_length, rig.distortion, rig.cam_from_rig.rotation, pose.rotation, pose.translation]


def test_views_count_what_they_hold() -> None:
    assert len(Views(uv=torch.zeros(4, C, N, 2))) == len(Views(images=torch.zeros(4, C, 3, 2, 2))) == 4
    with pytest.raises(ValueError, match="neither points nor images"):
        len(Views())


def test_cameras_in_the_objects_frame_show_the_same(prediction, made, asymmetric8) -> None:
    uv = prediction.cameras_from_object.project(asymmetric8.points).uv
    torch.testing.assert_close(uv, made.projection.uv)


def test_cameras_are_split_into_a_rig_and_a_pose_that_show_the_same(prediction, o10, asymmetric8) -> None:
    cameras = prediction.cameras_from_object
    split = Prediction.from_cameras(cameras, o10)
    uv = split.rig.project(split.rig_from_object.apply(asymmetric8.points)).uv
    torch.testing.assert_close(uv, cameras.project(asymmetric8.points).uv)
    # The rig lies where the factory's does: no motion of all cameras together is left in it.
    each = split.rig.cam_from_rig.inverse() @ o10.cam_from_rig
    torch.testing.assert_close(each.rotation.mean(1), torch.eye(3).double().expand(B, 3, 3), rtol=0, atol=2e-3)


def test_the_factory_rig_is_split_exactly(o10) -> None:
    turn = rotation_from_vector(torch.tensor([[0.3, -0.7, 1.1], [2.0, 0.5, -0.2]]).double())
    pose = RigidTransform(turn, torch.tensor([[5.0, -3, 700], [0, 0, 900]]).double())
    split = Prediction.from_cameras(o10.expand(2).from_object(pose), o10)
    torch.testing.assert_close(split.rig_from_object.rotation, pose.rotation)
    torch.testing.assert_close(split.rig_from_object.translation, pose.translation)
    torch.testing.assert_close(split.rig.cam_from_rig.rotation, o10.cam_from_rig.rotation.expand(2, -1, -1, -1))


def test_rows_are_kept_joined_and_stacked(prediction) -> None:
    parts = [prediction[:1], prediction[torch.tensor([1, 2])]]
    assert parts[0].log_sigma.shape == (1, C, N)
    torch.testing.assert_close(parts[1].log_sigma, prediction.log_sigma[1:])
    for whole, joined in zip(tensors(prediction), tensors(Prediction.cat(parts)), strict=True):
        assert torch.equal(whole, joined)
    stacked = Prediction.stack([prediction, prediction])
    assert stacked.rig.focal_length.shape == (2, B, C, 2) and stacked.log_sigma is None


def test_a_detached_prediction_has_no_graph_and_another_type_the_same_values(prediction) -> None:
    step = torch.zeros(B, C, 15, dtype=torch.float64, requires_grad=True)
    live = Prediction(prediction.rig.retract(step), prediction.rig_from_object, prediction.log_sigma * (1 + step.sum()))
    assert live.rig.focal_length.requires_grad and live.log_sigma.requires_grad
    assert not any(x.requires_grad for x in (*tensors(live.detach()), live.detach().log_sigma))
    single = prediction.to(torch.float32)
    assert {x.dtype for x in (*tensors(single), single.log_sigma)} == {torch.float32}
    for one, other in zip(tensors(single), tensors(prediction), strict=True):
        torch.testing.assert_close(one.double(), other, rtol=1e-6, atol=1e-6)
