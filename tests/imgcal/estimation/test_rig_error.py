"""Errors of a rig: inverse, derivative, and invariance for the filter."""

import torch

import imgcal
from imgcal.estimation import displace, error_between, error_by_step, step_by_error
from imgcal.types import CameraRig

UNITS = torch.tensor((0.02,) * 3 + (10.0,) * 3 + (20.0,) * 4 + (0.02,) * 5, dtype=torch.float64)


def errors(cameras: int, seed: int) -> torch.Tensor:
    return UNITS * torch.randn(cameras, 15, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def drifted(seed: int) -> CameraRig:
    rig = imgcal.load_rig("T4")
    return rig.retract(errors(rig.num_cameras, seed))


def test_error_between_inverts_displaced() -> None:
    rig, error = drifted(0), errors(4, 1)
    torch.testing.assert_close(error_between(displace(rig, error), rig), error)
    assert error_between(rig, rig).abs().max() < 1e-12


def test_a_motion_of_the_whole_rig_is_the_same_error_for_all_cameras_and_moves_no_image() -> None:
    rig = drifted(2)
    whole = torch.zeros(4, 15, dtype=torch.float64)
    whole[:, :6] = torch.tensor([0.1, -0.2, 0.05, 30.0, -20.0, 10.0])
    moved = displace(rig, whole)
    points = torch.tensor([[0.0, 0.0, 850.0], [100.0, -50.0, 900.0]], dtype=torch.float64)
    turn = moved.cam_from_rig.rotation[0].mT @ rig.cam_from_rig.rotation[0]
    there = points @ turn.mT + whole[0, 3:6]
    torch.testing.assert_close(moved.project(there).uv, rig.project(points).uv)


def test_step_by_error_is_the_derivative_of_the_step() -> None:
    rig = drifted(3)

    def step(error: torch.Tensor) -> torch.Tensor:
        return displace(rig, error).local(rig)

    found = torch.autograd.functional.jacobian(step, 1e-6 * errors(4, 4))
    expected = torch.stack([found[c, :, c] for c in range(4)])
    torch.testing.assert_close(step_by_error(rig), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(error_by_step(rig), torch.linalg.inv(step_by_error(rig)))


def test_step_by_error_follows_steps_from_another_rig() -> None:
    factory = imgcal.load_rig("T4")
    offset = errors(4, 5)
    rig = factory.retract(offset)

    def step(error: torch.Tensor) -> torch.Tensor:
        return displace(rig, error).local(factory)

    found = torch.autograd.functional.jacobian(step, 1e-6 * errors(4, 6))
    expected = torch.stack([found[c, :, c] for c in range(4)])
    torch.testing.assert_close(step_by_error(rig, offset[:, :3]), expected, rtol=1e-4, atol=1e-4)
