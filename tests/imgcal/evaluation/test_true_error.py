from dataclasses import replace

import pytest
import torch

from imgcal.estimation import rigid_motion, uncertainty_over
from imgcal.evaluation.true_error import normalized_error, true_error
from imgcal.geometry import RigidTransform, rotation_from_vector

F64 = torch.float64


@pytest.fixture(scope="module")
def uncertainty(o10):
    generator = torch.Generator().manual_seed(0)
    points = 80 * torch.randn(50, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0.0, 850.0], dtype=F64)
    unit = torch.tensor([1e-3] * 3 + [1.0] * 3 + [2.0] * 4 + [2e-3] * 5, dtype=F64).repeat(10)
    return uncertainty_over(o10, torch.diag(unit**2), points)


def test_a_rig_in_another_frame_is_the_same_rig(o10, uncertainty):
    turn = rotation_from_vector(torch.tensor([[0.4, -1.2, 2.0]], dtype=F64))
    elsewhere = RigidTransform(turn, torch.tensor([[500.0, -90.0, 70.0]], dtype=F64))
    truth = replace(o10, cam_from_rig=o10.cam_from_rig @ elsewhere)
    px, mm = true_error(uncertainty, truth, uncertainty.points[:7] + 10)
    assert px.max() < 1e-7 and mm.max() < 1e-7


def test_a_larger_rig_is_not(o10, uncertainty):
    transform = o10.cam_from_rig
    truth = replace(o10, cam_from_rig=RigidTransform(transform.rotation, 1.01 * transform.translation))
    points = uncertainty.points + 5
    _, mm = true_error(uncertainty, truth, points)
    # All distances are a hundredth too short, about the middle of the points by which the rigs are compared.
    expected = 0.01 * (points - points.mean(0)).norm(dim=1)
    assert mm.median() == pytest.approx(float(expected.median()), rel=0.1)


def test_what_is_not_seen_has_no_error(o10, uncertainty):
    behind = torch.tensor([[0.0, 0.0, -500.0]], dtype=F64)
    px, mm = true_error(uncertainty, o10, behind)
    assert px.isnan().all() and mm.isnan().all()


def test_the_motion_of_the_whole_rig_counts_as_a_motion(o10, uncertainty):
    """A turn by 0.05 rad takes cameras 0.25 mm off their tangent: 25 times what they are said to be off."""
    motion = rigid_motion(o10, uncertainty.points.mean(0))
    tight = torch.tensor([1e-5] * 3 + [0.01] * 3 + [0.1] * 4 + [1e-4] * 5, dtype=F64).repeat(10).square().diag()
    wide = torch.tensor([0.05] * 3 + [20.0] * 3, dtype=F64).square().diag()
    believed = uncertainty_over(o10, tight + motion @ wide @ motion.mT, uncertainty.points)
    turn = rotation_from_vector(torch.tensor([[0.05, 0.0, 0.0]], dtype=F64))
    truth = replace(o10, cam_from_rig=o10.cam_from_rig @ RigidTransform(turn, torch.zeros(1, 3, dtype=F64)))
    plain = o10.local(truth).flatten()
    assert float(plain @ torch.linalg.solve(believed.covariance, plain)) > 1e3
    # One sigma of turn; about the middle of the points it is a shift, too, by 850 mm x 0.05, of 20 mm sigma.
    assert 150 * normalized_error(believed, truth) == pytest.approx(1 + (850 * 0.05 / 20) ** 2, rel=0.05)


def test_normalized_errors_of_errors_as_large_as_said_are_one(o10, uncertainty):
    generator = torch.Generator().manual_seed(3)
    std = 0.1 * uncertainty.covariance.diagonal().sqrt().view(10, 15)
    believed = uncertainty_over(o10, 0.01 * uncertainty.covariance, uncertainty.points)
    found = [
        normalized_error(believed, o10.retract(std * torch.randn(10, 15, generator=generator, dtype=F64)))
        for _ in range(40)
    ]
    assert sum(found) / 40 == pytest.approx(1, abs=0.06)
