"""Rotations: oracles from scipy, group properties, derivatives, and the places where formulas break."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from imgcal.geometry import (
    cross_matrix,
    euler_from_rotation,
    geodesic_angle,
    left_jacobian,
    rotation_from_6d,
    rotation_from_euler,
    rotation_from_vector,
    sixd_from_rotation,
    vector_from_rotation,
)

ANGLES = (0.0, 1e-12, 1e-9, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 1.0, math.pi - 1e-3, math.pi - 1e-6, math.pi - 1e-9)
SHAPES = ((), (1,), (2, 3))


def axes(*shape: int, seed: int = 0) -> Tensor:
    draws = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(draws, dim=-1)


def rotations(*shape: int, seed: int = 0) -> Tensor:
    flat = Rotation.random(math.prod(shape), rng=seed).as_matrix()
    return torch.from_numpy(flat).reshape(*shape, 3, 3)


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_match_scipy(angle: float) -> None:
    vectors = angle * axes(20)
    expected = torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    matrices = rotation_from_vector(vectors)
    torch.testing.assert_close(matrices, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(vector_from_rotation(matrices), vectors, rtol=1e-8, atol=1e-14)


def test_logarithm_at_half_a_turn() -> None:
    directions = torch.cat((axes(50), torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)))
    matrices = 2 * directions[:, :, None] * directions[:, None, :] - torch.eye(3, dtype=torch.float64)
    vectors = vector_from_rotation(matrices)
    torch.testing.assert_close(vectors.norm(dim=-1), torch.full((56,), math.pi, dtype=torch.float64))
    torch.testing.assert_close(rotation_from_vector(vectors), matrices, rtol=0, atol=1e-14)


def test_exponential_is_a_group_homomorphism_along_an_axis() -> None:
    direction = axes(7)
    first, second = rotation_from_vector(0.3 * direction), rotation_from_vector(1.1 * direction)
    torch.testing.assert_close(first @ second, rotation_from_vector(1.4 * direction), rtol=0, atol=1e-14)
    torch.testing.assert_close(first.mT, rotation_from_vector(-0.3 * direction), rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.99e-4, 1.01e-4, 0.7, 3.0])
def test_gradients_of_exponential_and_logarithm(angle: float) -> None:
    vector = (angle * axes(2)).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_vector, vector)
    assert torch.autograd.gradcheck(lambda v: vector_from_rotation(rotation_from_vector(v)), vector)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.99e-4, 1.01e-4, 0.7, 3.0])
def test_left_jacobian_is_the_derivative_of_the_exponential(angle: float) -> None:
    vector = angle * axes(seed=3)

    def turned(step: Tensor) -> Tensor:
        return vector_from_rotation(rotation_from_vector(vector + step) @ rotation_from_vector(vector).mT)

    expected = torch.autograd.functional.jacobian(turned, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(left_jacobian(vector), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_sixd_round_trip_and_invariance(shape: tuple[int, ...]) -> None:
    matrices = rotations(*shape)
    sixd = sixd_from_rotation(matrices)
    assert sixd.shape == (*shape, 6)
    torch.testing.assert_close(rotation_from_6d(sixd), matrices)
    # Any scale, and any part of the first column in the second, leaves the rotation as it is.
    sheared = torch.cat((3 * sixd[..., :3], 0.5 * sixd[..., 3:] - 2 * sixd[..., :3]), dim=-1)
    torch.testing.assert_close(rotation_from_6d(sheared), matrices)


def test_sixd_of_any_numbers_is_a_rotation() -> None:
    sixd = torch.randn(200, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    matrices = rotation_from_6d(sixd)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3, dtype=torch.float64).expand(200, 3, 3))
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(200, dtype=torch.float64))
    assert torch.autograd.gradcheck(rotation_from_6d, sixd[:3].requires_grad_())


@pytest.mark.parametrize("shape", SHAPES)
def test_euler_angles_match_scipy(shape: tuple[int, ...]) -> None:
    matrices = rotations(*shape)
    angles = euler_from_rotation(matrices)
    assert angles.shape == (*shape, 3)
    expected = Rotation.from_matrix(matrices.reshape(-1, 3, 3).numpy()).as_euler("xyz")
    np.testing.assert_allclose(angles.reshape(-1, 3).numpy(), expected, atol=1e-12)
    torch.testing.assert_close(rotation_from_euler(angles), matrices)


@pytest.mark.parametrize("second", [math.pi / 2, -math.pi / 2])
def test_euler_angles_at_the_gimbal_lock(second: float) -> None:
    matrix = rotation_from_euler(torch.tensor([0.4, second, -0.9], dtype=torch.float64))
    angles = euler_from_rotation(matrix)
    assert float(angles[2]) == 0
    torch.testing.assert_close(rotation_from_euler(angles), matrix, rtol=0, atol=1e-12)


def test_geodesic_angle() -> None:
    base, direction = rotations(9), axes(9, seed=5)
    for angle in (0.0, 1e-9, 1e-3, 2.0, math.pi - 1e-6, math.pi):
        other = rotation_from_vector(angle * direction) @ base
        expected = torch.full((9,), angle, dtype=torch.float64)
        torch.testing.assert_close(geodesic_angle(base, other), expected, rtol=1e-6, atol=1e-7 if angle > 3 else 1e-14)
    torch.testing.assert_close(geodesic_angle(base, base.flip(0)), geodesic_angle(base.flip(0), base))


def test_geodesic_angle_has_finite_gradients_at_its_extremes() -> None:
    identity = torch.eye(3, dtype=torch.float64)
    for turn in (0.0, math.pi):
        vector = torch.tensor([turn, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
        geodesic_angle(rotation_from_vector(vector), identity).backward()
        assert torch.isfinite(vector.grad).all()


def test_geodesic_angle_is_accurate_in_float32() -> None:
    small = rotation_from_vector(torch.tensor([1e-4, 0.0, 0.0]))
    assert float(geodesic_angle(small, torch.eye(3))) == pytest.approx(1e-4, rel=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_cross_matrix(shape: tuple[int, ...]) -> None:
    a, b = axes(*shape), axes(*shape, seed=1)
    product = (cross_matrix(a) @ b[..., None]).squeeze(-1)
    torch.testing.assert_close(product, torch.linalg.cross(a, b))
